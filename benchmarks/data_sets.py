# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Real data sets: folders with sessions and the gold bundle of all of them."""

from __future__ import annotations

from pathlib import Path

from mapmerge_ros.errors import MapMergeError


def data_sets(data: Path) -> list[Path]:
    """
    Folders in `data` that have a gold bundle, by name.

    Raises
    ------
    MapMergeError
        There is none.

    """
    folders = sorted(path.parent for path in data.glob('*/gold'))
    if not folders:
        raise MapMergeError(f'{data}: no data set with a gold bundle')
    return folders
