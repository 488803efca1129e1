# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What `ament_pep257` says, with the exceptions that setup.cfg gives reasons for."""

from pathlib import Path

import pytest

linter = pytest.importorskip('ament_pep257.main', reason='ament_pep257 is not installed')
ROOT = Path(__file__).parents[1]
CHECKED = ('setup.py', 'mapmerge_ros', 'launch', 'test', 'benchmarks', 'docs')
EXCEPT = ('D401', 'D417')


@pytest.mark.pep257
@pytest.mark.linter
def test_pep257(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert linter.main([*CHECKED, '--add-ignore', *EXCEPT]) == 0
