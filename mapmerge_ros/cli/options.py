# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of option values, and the parser of one command."""

from __future__ import annotations

import argparse
import math
from typing import TypeAlias

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.geometry import Gauge

Subparsers: TypeAlias = 'argparse._SubParsersAction[argparse.ArgumentParser]'


class UsageError(MapMergeError):
    """The options do not go together; exit code 2."""


def add_command(
    subparsers: Subparsers, name: str, summary: str, description: str, examples: str
) -> argparse.ArgumentParser:
    """Parser of one command, its examples under the options."""
    return subparsers.add_parser(
        name,
        help=summary,
        description=description,
        epilog=f'examples:\n{examples}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def positive_int(text: str) -> int:
    """Whole number from 1."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f'{text!r} is not a whole number from 1')
    return int(text)


def natural(text: str) -> int:
    """Whole number from 0."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f'{text!r} is not a whole number from 0')
    return int(text)


def positive(text: str) -> float:
    """Finite number above 0."""
    value = _number(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f'{text!r} is not a number above 0')
    return value


def non_negative(text: str) -> float:
    """Finite number from 0."""
    value = _number(text)
    if not (math.isfinite(value) and value >= 0.0):
        raise argparse.ArgumentTypeError(f'{text!r} is not a number from 0')
    return value


def probability(text: str) -> float:
    """Number between 0 and 1, both excluded."""
    value = _number(text)
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(f'{text!r} is not between 0 and 1')
    return value


def gauge(text: str) -> Gauge:
    """7, 6 or 4."""
    if text not in ('7', '6', '4'):
        raise argparse.ArgumentTypeError(
            f'{text!r} is not 7 (monocular), 6 (metric) or 4 (visual-inertial)'
        )
    return Gauge(int(text))


def name(text: str) -> str:
    """Text that is not empty."""
    if not text.strip():
        raise argparse.ArgumentTypeError('it is empty')
    return text.strip()


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text!r} is not a number') from None
