# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Files of a COLMAP model, checked before its library sees them.

The library trusts the counts inside .bin files: a truncated one makes it loop for ever, and not
even an interrupt stops it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Final

from mapmerge_ros.errors import MapMergeError

NAMES: Final = ('cameras', 'images', 'points3D')

ParameterCount = Callable[[int], int]
"""Number of parameters of the camera model with this number; ValueError if there is none."""


class ModelError(MapMergeError):
    """A model cannot be read; the message names the folder or the file."""


def check_files(folder: Path, parameter_count: ParameterCount) -> None:
    """
    Check that a folder holds a whole model.

    Raises
    ------
    ModelError
        No such folder, a missing, unreadable or truncated file.

    """
    if not folder.is_dir():
        raise ModelError(f'{folder}: no such folder: check the path')
    missing = {
        suffix: [name + suffix for name in NAMES if not (folder / (name + suffix)).is_file()]
        for suffix in ('.bin', '.txt')
    }
    if all(missing.values()):
        inner = folder / 'sparse' / '0'
        remedy = f'did you mean {inner}?' if inner.is_dir() else 'give the folder that holds them'
        best = min(missing.values(), key=len)
        raise ModelError(f'{folder}: not a COLMAP model: {", ".join(best)} missing: {remedy}')
    if not missing['.bin']:
        for name in (*NAMES, 'rigs', 'frames'):
            _check_structure(folder / f'{name}.bin', parameter_count)


def _check_structure(path: Path, parameter_count: ParameterCount) -> None:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return  # rigs and frames: older versions have none
    except OSError as err:
        raise ModelError(f'{path}: {err.strerror}') from err
    walk = _Walk(path, data, parameter_count)
    try:
        (count,) = walk.read('<Q')
        for _ in range(count):
            getattr(walk, path.stem)()
    except (struct.error, ValueError, OverflowError) as err:
        raise ModelError(f'{path}: truncated or damaged: export the model again') from err
    if walk.at != len(data):
        raise ModelError(f'{path}: {len(data) - walk.at} bytes too many: export the model again')


class _Walk:
    """Steps over the records of a .bin file; a method per file name, one record each."""

    def __init__(self, path: Path, data: bytes, parameter_count: ParameterCount) -> None:
        self.at = 0
        self._path, self._data = path, data
        self._parameter_count = parameter_count

    def read(self, layout: str) -> tuple[int, ...]:
        values = struct.unpack_from(layout, self._data, self.at)
        self.at += struct.calcsize(layout)
        return values

    def _skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self._data):
            raise ValueError('beyond the end')

    def cameras(self) -> None:
        _, model, _, _ = self.read('<IiQQ')
        try:
            count = self._parameter_count(model)
        except ValueError as err:
            raise ModelError(
                f'{self._path}: truncated or damaged, or of a newer COLMAP: no camera model has '
                f'number {model}'
            ) from err
        self._skip(8 * count)

    def images(self) -> None:
        self._skip(4 + 7 * 8 + 4)  # id, pose, camera
        self._skip(self._data.index(b'\0', self.at) + 1 - self.at)  # name
        self._skip(24 * self.read('<Q')[0])  # x y point

    def points3D(self) -> None:
        self._skip(8 + 3 * 8 + 3 + 8)  # id, xyz, colour, error
        self._skip(8 * self.read('<Q')[0])  # track

    def rigs(self) -> None:
        _, sensors = self.read('<II')
        if sensors:
            self._skip(8)  # reference sensor
        for _ in range(1, sensors):
            has_pose = self.read('<iIB')[2]
            self._skip(7 * 8 if has_pose else 0)

    def frames(self) -> None:
        self._skip(4 + 4 + 7 * 8)  # id, rig, pose
        self._skip(16 * self.read('<I')[0])  # sensor, image
