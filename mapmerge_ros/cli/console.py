# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where a command writes: tables to stdout, progress and warnings to stderr."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track
from rich.table import Table

from mapmerge_ros.io.summary import noise_sigma
from mapmerge_ros.submap import SubMap

T = TypeVar('T')

PIPE_WIDTH = 160
"""Columns when stdout is no terminal: a reason shall stay on one line for grep."""


def stdout() -> Console:
    """Console for results."""
    width = None if sys.stdout.isatty() else PIPE_WIDTH
    return Console(file=sys.stdout, width=width, highlight=False, markup=False, emoji=False)


def table(*columns: str, title: str = '') -> Table:
    """Plain table; columns that begin with '#' hold numbers."""
    made = Table(box=SIMPLE_HEAD, title=title or None, title_justify='left', pad_edge=False)
    for column in columns:
        is_number = column.startswith('#')
        made.add_column(
            column.lstrip('#'),
            justify='right' if is_number else 'left',
            no_wrap=is_number,
            overflow='fold',
        )
    return made


def sigma(submap: SubMap) -> str:
    """Noise of a sub-map for a table; `~` where it is estimated from its own residuals."""
    value = noise_sigma(submap)
    if math.isnan(value):
        return '–'
    return f'{value:.3g}' if submap.sigma else f'~{value:.3g}'


def compressed(submap: SubMap) -> str:
    """Return the number of compressed landmarks for a table."""
    return str(submap.compressed_count) if submap.compressed_count else 'announced'


def warn(text: str) -> None:
    """One line to stderr; the work goes on."""
    print(f'mapmerge: warning: {text}', file=sys.stderr)


def progress(items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Items with a progress bar on stderr, which only a terminal gets to see."""
    if not sys.stderr.isatty():
        yield from items  # rich 13, though disabled, ends with an empty line
        return
    console = Console(file=sys.stderr)
    yield from track(items, description, total=total, console=console, transient=True)


@contextmanager
def working(description: str) -> Iterator[None]:
    """Sign of life on stderr, which only a terminal gets to see, for work of one piece."""
    console = Console(file=sys.stderr)
    if not sys.stderr.isatty():
        yield
        return
    with console.status(description):
        yield
