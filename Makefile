# Two commands on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -q
# One BLAS thread: two on small matrices cost ten times as much on a busy machine.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo test check unit oldest colcon docs interfaces readme install install-test bag clean

demo: install
	$(BIN)/mapmerge demo --out out/demo

test: check unit oldest readme docs colcon

check: install-test
	$(BIN)/ruff check .
	$(BIN)/mypy

# Two processes, each test file in one of them: many tests wait for nodes.
PYTEST := -m pytest -n 2 --dist loadfile
unit: install-test
	$(BIN)/python $(PYTEST)

# The engine with the oldest libraries that setup.py allows, without ROS; with Ceres, or what is tested on simulated
# maps is left out. NumPy 1.26 has wheels up to Python 3.12.
OLDEST := build/oldest
oldest:
	@if $(PYTHON) -c 'import sys; sys.exit(sys.version_info >= (3, 13))'; \
	then $(MAKE) --no-print-directory $(OLDEST)/.installed && $(OLDEST)/bin/python $(PYTEST); \
	else echo 'oldest: not with Python 3.13 or newer'; fi

$(OLDEST)/.installed: setup.py test/constraints-oldest.txt
	$(PYTHON) -m venv $(OLDEST)
	$(OLDEST)/bin/python -m pip --disable-pip-version-check -q install \
	    -c test/constraints-oldest.txt -e '.[experiments]' mcap-ros2-support pytest pytest-xdist
	@touch $@

readme: install-test
	$(BIN)/python test/run_readme.py README.md

# The site, in build/docs; every warning is an error.
docs: $(VENV)/.documented
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs build/docs

# The page of all topics, services and parameters, from the nodes themselves.
interfaces: install-test
	$(BIN)/python docs/generate_interfaces.py

# Both packages as a ROS workspace builds and checks them, beside the pip build of the .venv. Of the
# tests only the linters: `unit` has run all of them.
COLCON := build/colcon
colcon: $(VENV)/.colcon
	. $(BIN)/activate && $(BIN)/colcon --log-base $(COLCON)/log build \
	    --base-paths . msg_schemas --build-base $(COLCON)/build \
	    --install-base $(COLCON)/install --event-handlers console_direct-
	. $(BIN)/activate && . $(COLCON)/install/setup.sh && \
	    $(BIN)/python test/check_workspace.py $(COLCON)/install
	. $(BIN)/activate && $(BIN)/colcon --log-base $(COLCON)/log test \
	    --base-paths . msg_schemas --build-base $(COLCON)/build \
	    --install-base $(COLCON)/install --event-handlers console_direct- \
	    --pytest-args -m linter --return-code-on-test-failure
	$(BIN)/colcon --log-base $(COLCON)/log test-result --all --test-result-base $(COLCON)/build

install: $(VENV)/.installed
install-test: $(VENV)/.tested

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

# The package index is the only thing that is needed from outside.
$(VENV)/.installed: setup.py pyproject.toml $(wildcard msg_schemas/*/*.* msg_schemas/*.*) | $(VENV)/bin/python
	@echo 'installing into $(VENV): about two minutes'
	$(PIP) install -e '.[colmap,ros]' ./msg_schemas
	@touch $@

$(VENV)/.tested: $(VENV)/.installed $(wildcard test/interfaces/*/*.*)
	$(PIP) install -e '.[colmap,experiments,ros,test]' ./test/interfaces/tf2_msgs
	@touch $@

$(VENV)/.colcon: $(VENV)/.tested msg_schemas/requirements-colcon.txt
	$(PIP) install -r msg_schemas/requirements-colcon.txt
	@touch $@

$(VENV)/.documented: $(VENV)/.installed
	$(PIP) install -e '.[docs]'
	@touch $@

# The shipped recording and its truth; bags/README.md says what is in it.
bag: install
	$(BIN)/mapmerge simulate bags/four_drones.mcap

clean:
	rm -rf $(VENV) build out
