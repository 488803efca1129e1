# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files that are written as a whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from mapmerge_ros.errors import MapMergeError


class OutputError(MapMergeError):
    """A file cannot be written."""


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """
    Binary file that appears under its name when the block has ended without an error.

    Raises
    ------
    OutputError
        The folder is missing or not writable, the disk is full.

    """
    path = Path(path)
    # Beside the target: a rename is atomic only within one file system.
    part = path.with_name(f'.{path.name}.{os.getpid()}.part')
    try:
        with part.open('wb') as stream:
            yield stream
        part.replace(path)
    except OSError as err:
        _remove(part)
        if err.filename not in (None, str(part)):  # somebody else's file
            raise
        remedy = 'create its folder first' if isinstance(err, FileNotFoundError) else ''
        reason = err.strerror or str(err)
        raise OutputError(': '.join(filter(None, (str(path), reason, remedy)))) from err
    except BaseException:
        _remove(part)
        raise


def _remove(part: Path) -> None:
    try:
        part.unlink(missing_ok=True)
    except OSError:
        return  # the reason why it could not be written is the one to report
