# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a parameter is: a name, a default, a description, a range, and when it may change."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from enum import Enum
from textwrap import fill
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from mapmerge_ros.errors import InvalidValue

Value = bool | int | float | str

INDENT = '      '


class Change(Enum):
    """When a parameter may be changed."""

    NEVER = 'only at the start'
    UNCONFIGURED = 'only while the node is unconfigured'
    ALWAYS = 'at any time'


@dataclass(frozen=True, slots=True)
class Setting:
    """A parameter of a node; its type is that of the default."""

    name: str
    default: Value
    description: str
    low: float = 0.0
    high: float = 0.0
    """Range of a number; low = high = 0 is none"""
    choices: tuple[str, ...] = ()
    """Allowed texts; none = any"""
    change: Change = Change.NEVER
    is_pattern: bool = False
    """Whether it is a regular expression"""


def declare(node: Any, setting: Setting) -> Any:
    """
    Declare one parameter and return its value, of the type of its default.

    Raises
    ------
    InvalidValue
        It is of another type, out of its range, or none of its choices.

    """
    value = node.declare_parameter(setting.name, setting.default, _descriptor(setting)).value
    return checked(setting, value)


def unknown(node: Any) -> list[str]:
    """Say of parameters that were given at the start and that the node does not have."""
    has = {*node._parameters}
    lines = []
    for name in sorted(node._parameter_overrides.keys() - has):
        if name.startswith('qos_overrides.'):
            continue
        alike = get_close_matches(name, has, 1)
        hint = f': {alike[0]} is meant?' if alike else ''
        lines.append(f'there is no parameter {name}, what was given for it is ignored{hint}')
    return lines


def described(settings: Iterable[Setting]) -> str:
    """One paragraph for each, as `--help` shows it."""
    return '\n'.join(
        f'  {item.name} (default {item.default!r})\n'
        + fill(item.description, 78, initial_indent=INDENT, subsequent_indent=INDENT)
        for item in settings
    )


def read(node: Any, settings: Iterable[Setting]) -> dict[str, Any]:
    """Return the values of declared parameters by name."""
    return {item.name: checked(item, node.get_parameter(item.name).value) for item in settings}


def checked(setting: Setting, value: Any) -> Any:
    """
    Return a value of the type of the default; a whole number may stand for a float.

    Raises
    ------
    InvalidValue
        It is of another type, out of its range, or none of its choices.

    """
    wanted = type(setting.default)
    if wanted is float and type(value) is int:
        value = float(value)
    matches = type(value) is wanted  # bool is an int to isinstance
    if not matches:
        raise InvalidValue(f'{setting.name}: {value!r} is not of type {wanted.__name__}')
    if setting.low != setting.high and not setting.low <= value <= setting.high:
        raise InvalidValue(
            f'{setting.name}: {value} is not between {setting.low:g} and {setting.high:g}'
        )
    if setting.choices and value not in setting.choices:
        raise InvalidValue(f'{setting.name}: {value!r} is none of {", ".join(setting.choices)}')
    if setting.is_pattern:
        try:
            re.compile(value)
        except re.error as err:
            raise InvalidValue(f'{setting.name}: not a regular expression: {err}') from err
    return value


def _descriptor(setting: Setting) -> Any:
    constraints = [' | '.join(setting.choices), f'may change {setting.change.value}']
    descriptor = ParameterDescriptor(
        description=setting.description,
        additional_constraints='; '.join(filter(None, constraints)),
        read_only=setting.change is Change.NEVER,
        # `-p merge_period:=2` is an integer to the parser: it is converted, not refused.
        dynamic_typing=isinstance(setting.default, float),
    )
    if setting.low == setting.high:
        return descriptor
    if isinstance(setting.default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(setting.low), to_value=float(setting.high))
        ]
    else:
        descriptor.integer_range = [
            IntegerRange(from_value=int(setting.low), to_value=int(setting.high), step=1)
        ]
    return descriptor
