# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Numbers of a report, each with the place in the summary that it comes from."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from markupsafe import Markup

from mapmerge_ros.io.wording import readable_bytes

LEAST_P = 1e-300
"""Smaller ones are zero in the arithmetic of computers, but not in truth."""


def short(value: float | None) -> str:
    """Four digits; a dash for what is not known."""
    return '–' if value is None else f'{value:.4g}'


def p_value(value: float) -> str:
    """Return e.g. '= 0.085' or '< 1e-300', in one piece."""
    return f'=\u00a0{value:.2g}' if value >= LEAST_P else f'<\u00a0{LEAST_P:g}'


def _seconds(value: float) -> str:
    return f'{1000.0 * value:.3g} ms' if value < 1.0 else f'{value:.3g} s'


_FORMATS: Mapping[str, Callable[[Any], str]] = {
    'short': lambda value: str(value) if isinstance(value, int) else short(value),
    'plain': str,
    'p': lambda value: p_value(value).removeprefix('=\u00a0'),
    'bytes': readable_bytes,
    'seconds': _seconds,
    'percent': lambda value: f'{value:.2%}',
    'std': lambda value: f'{value:.2g}',
}


def looked_up(summary: Mapping[str, Any], path: str) -> Any:
    """Value of `sub_maps.0.bytes`."""
    found: Any = summary
    for key in path.split('.'):
        found = found[int(key)] if isinstance(found, list) else found[key]
    return found


def value(summary: Mapping[str, Any], path: str, form: str = 'short') -> Markup:
    """Markup of a number that says where it comes from, so that others can check it."""
    found = looked_up(summary, path)
    return Markup('<data data-key="{}" value="{}">{}</data>').format(
        path, json.dumps(found), _FORMATS[form](found)
    )
