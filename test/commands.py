# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a command of `mapmerge` left and printed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from mapmerge_ros.cli.main import main


def summary_of(folder: Path | str) -> Any:
    return json.loads((Path(folder) / 'summary.json').read_text())


def complaint(capsys: pytest.CaptureFixture[str], *argv: str | Path) -> str:
    """The one line that a failing command prints."""
    assert main([str(arg) for arg in argv]) == 1
    printed = capsys.readouterr()
    assert printed.out == ''
    assert printed.err.startswith('mapmerge: ')
    assert printed.err.count('\n') == 1
    assert not [path for path in Path.cwd().rglob('*') if path.name.endswith('.part')]
    return printed.err
