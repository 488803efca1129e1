# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a result can be written: asked before the long work, not after."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mapmerge_ros.io import OutputError


def check_file(path: Path, suffix: str) -> None:
    """
    Check that a file of this name can be written.

    Raises
    ------
    OutputError
        Its folder is missing or not writable, it is a folder, or it ends otherwise.

    """
    if path.suffix != suffix:
        raise OutputError(f'{path}: the name of the output has to end in {suffix}')
    if path.is_dir():
        raise OutputError(f'{path}: is a folder: give the name of a file')
    _check_writable(path.parent, path)


@contextmanager
def output_folder(folder: Path) -> Iterator[Path]:
    """
    Folder that exists and is writable; if the block fails, one made here is gone again.

    Raises
    ------
    OutputError
        It cannot be made or written to.

    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as err:
        raise OutputError(f'{folder}: is a file: choose another --out') from err
    except OSError as err:
        raise OutputError(f'{folder}: {err.strerror}: choose another --out') from err
    try:
        _check_writable(folder, folder)
        yield folder
    except BaseException:
        for path in missing:
            _remove_if_empty(path)
        raise


def _remove_if_empty(folder: Path) -> None:
    try:
        folder.rmdir()
    except OSError:
        return  # somebody has put something there


def _check_writable(folder: Path, named: Path) -> None:
    try:
        with tempfile.TemporaryFile(dir=folder):
            return
    except FileNotFoundError as err:
        raise OutputError(f'{named}: the folder {folder} is missing: create it first') from err
    except OSError as err:
        raise OutputError(f'{named}: {err.strerror}: choose another place') from err


def ros_name(text: str) -> str:
    """Text as one token of a ROS topic: letters, digits, single underscores, no digit first."""
    token = re.sub(r'_+', '_', re.sub(r'[^A-Za-z0-9]', '_', text)).strip('_')
    if not token or token[0].isdigit():
        return f'robot_{token}'.rstrip('_')
    return token
