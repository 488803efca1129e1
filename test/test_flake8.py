# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What `ament_flake8` says, with the exceptions of setup.cfg."""

from pathlib import Path

import pytest

linter = pytest.importorskip('ament_flake8.main', reason='ament_flake8 is not installed')
ROOT = Path(__file__).parents[1]
CHECKED = ('setup.py', 'mapmerge_ros', 'launch', 'test', 'benchmarks', 'docs')


@pytest.mark.flake8
@pytest.mark.linter
def test_flake8():
    paths = [str(ROOT / name) for name in CHECKED]
    code, errors = linter.main_with_errors(['--config', str(ROOT / 'setup.cfg'), *paths])
    assert code == 0, '\n'.join(errors)
