# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Names of robots, from the folders of their maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mapmerge_ros.cli.options import UsageError


def robot_names(models: Sequence[Path]) -> list[str]:
    """
    Name of each folder, with as many of its parents as tell all of them apart.

    Raises
    ------
    UsageError
        The same folder twice.

    """
    parts = [_telling_parts(model) for model in models]
    for k, own in enumerate(parts):
        if own in parts[:k]:
            raise UsageError(f'{models[k]}: given twice')
    for depth in range(1, max(map(len, parts)) + 1):
        names = ['_'.join(own[-depth:]) for own in parts]
        if len(set(names)) == len(names):
            return names
    return [f'{name}_{k}' for k, name in enumerate(names)]


def _telling_parts(model: Path) -> tuple[str, ...]:
    """Parts of the path, without the `sparse/0` that COLMAP puts at its end."""
    parts = model.resolve().parts[1:] or ('map',)
    if len(parts) > 2 and parts[-2] == 'sparse':
        return parts[:-2] if parts[-1] == '0' else (*parts[:-2], parts[-1])
    return parts[:-1] if len(parts) > 1 and parts[-1] == 'sparse' else parts
