# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What benchmarks print, and where it stands in a document."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from threadpoolctl import threadpool_limits

from mapmerge_ros.errors import MapMergeError


def published(make: Callable[[], Iterable[str]], document: Path | None, mark: str) -> int:
    """
    Print lines as they are made, with one BLAS thread, and put them into their document, if any.

    Return the exit code of the command: 1 for a known error, which is printed as one line.
    """
    made = []
    try:
        if document:
            _around(document, mark)  # hours before it is needed
        with threadpool_limits(1):
            for line in make():
                print(line, flush=True)
                made.append(line)
        if document:
            put(document, mark, '\n'.join(made))
    except MapMergeError as err:
        print(err, file=sys.stderr)
        return 1
    return 0


def put(document: Path, mark: str, text: str) -> None:
    """
    Replace what stands between `<!-- mark -->` and `<!-- end of mark -->`.

    Raises
    ------
    MapMergeError
        The document has no such place.

    """
    before, after = _around(document, mark)
    document.write_text(f'{before}{text}\n{after}')


def _around(document: Path, mark: str) -> tuple[str, str]:
    """What stands before the place and what after it, marks included."""
    begin, end = f'<!-- {mark} -->\n', f'<!-- end of {mark} -->'
    before, found_begin, rest = document.read_text().partition(begin)
    _, found_end, after = rest.partition(end)
    if not (found_begin and found_end):
        raise MapMergeError(f'{document} has no place marked {mark!r}')
    return before + begin, end + after
