# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What an experiment is, and what it says."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.errors import MapMergeError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Values: TypeAlias = Mapping[str, Any]
"""What one run measured: numbers, flags, texts, and lists and mappings of those."""


class ExperimentError(MapMergeError):
    """The experiment cannot be run; the message says what to change."""


@dataclass(frozen=True, slots=True)
class Failure:
    """A run that ended with a known error."""

    run: int
    reason: str


@dataclass(frozen=True, slots=True)
class Check:
    """One claim, with what was asked and what was seen."""

    text: str
    asked: str
    seen: str
    holds: bool


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text; columns that begin with '#' hold numbers."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class Summary:
    """What the runs of an experiment say together."""

    tables: tuple[Table, ...]
    checks: tuple[Check, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """All runs of an experiment that have ended, in the order of their numbers."""

    asked: int
    """Runs that were asked for"""
    seed: int
    values: tuple[Values, ...]
    """Of the runs that ended well"""
    failures: tuple[Failure, ...] = ()

    @property
    def ended(self) -> int:
        """Runs that ended, well or not."""
        return len(self.values) + len(self.failures)

    @property
    def complete(self) -> bool:
        """Whether every run that was asked for has ended."""
        return self.ended == self.asked

    def column(self, name: str) -> Floats:
        """One value of every run that ended well, (runs, ...)."""
        return np.array([values[name] for values in self.values], dtype=np.float64)

    def share(self, held: Mask) -> float:
        """Share of all ended runs for which something held; a failed run is one where not."""
        return float(np.count_nonzero(held)) / max(self.ended, 1)


@dataclass(frozen=True, slots=True)
class Experiment:
    """
    One experiment; its functions are module-level ones, so that other processes find them.

    `run_one(seed, run)` depends on its two arguments only; `summarise` and `draw` have to bear
    any number of runs from one on, since a run may have been interrupted.
    """

    name: str
    title: str
    runs: int
    """Unless the user says otherwise"""
    run_one: Callable[[int, int], Values]
    summarise: Callable[[Results], Summary]
    draw: Callable[[Results], Figure]
