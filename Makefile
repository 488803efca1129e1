# Two commands on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -q
# One BLAS thread: two on small matrices cost ten times as much on a busy machine.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo test check unit colcon readme install install-test bag clean

demo: install
	$(BIN)/mapmerge demo --out out/demo

test: check unit readme colcon

check: install-test
	$(BIN)/ruff check .
	$(BIN)/mypy

unit: install-test
	$(BIN)/python -m pytest

readme: install-test
	$(BIN)/python test/run_readme.py README.md

# The interface package as a ROS workspace would build it, beside the pip build of the .venv.
colcon: $(VENV)/.colcon
	. $(BIN)/activate && $(BIN)/colcon --log-base build/colcon/log build \
	    --base-paths . msg_schemas --build-base build/colcon/build \
	    --install-base build/colcon/install --event-handlers console_direct-
	. $(BIN)/activate && . build/colcon/install/setup.sh && \
	    $(BIN)/python test/check_workspace.py build/colcon/install

install: $(VENV)/.installed
install-test: $(VENV)/.tested

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

# The package index is the only thing that is needed from outside.
$(VENV)/.installed: setup.py pyproject.toml $(wildcard msg_schemas/*/*.??? msg_schemas/*.*) | $(VENV)/bin/python
	@echo 'installing into $(VENV): about two minutes'
	$(PIP) install -e '.[colmap,ros]' ./msg_schemas
	@touch $@

$(VENV)/.tested: $(VENV)/.installed $(wildcard test/interfaces/*/*.*)
	$(PIP) install -e '.[colmap,experiments,ros,test]' ./test/interfaces/tf2_msgs
	@touch $@

$(VENV)/.colcon: $(VENV)/.installed msg_schemas/requirements-colcon.txt
	$(PIP) install -r msg_schemas/requirements-colcon.txt
	@touch $@

# The shipped recording and its truth; bags/README.md says what is in it.
bag: install
	$(BIN)/mapmerge simulate bags/four_drones.mcap

clean:
	rm -rf $(VENV) build out
