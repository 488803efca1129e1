# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fields of messages, read with every check that only the wire needs, and written for any class.

Messages of rosbags hold numpy arrays, messages built by ROS hold `array.array`; both are read
through the buffer protocol, no element is touched by the interpreter.
"""

from __future__ import annotations

import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from mapmerge_ros.errors import InvalidValue, MapMergeError
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.submap import Descriptors, DescriptorType

Array = npt.NDArray[Any]

MAX_MESSAGE_BYTES: Final = 128 * 2**20
"""
Largest message that is looked at.

R of 2700 landmarks fills it; their merge needs a dense matrix of half a gigabyte. A larger
message is a mistake or an attack, and would take the memory from all other robots' maps.
"""

_NS = 1_000_000_000


class InvalidMessage(MapMergeError):
    """A message from outside breaks its contract; the text names the map and the field."""


class Factory(Protocol):
    """Makes a message of the named type; fields are numpy arrays, numbers, text, messages."""

    def __call__(self, typename: str, /, **fields: Any) -> Any:
        """Return the message."""
        ...


def class_factory(find: Callable[[str], type[Any]]) -> Factory:
    """
    Factory of messages whose classes ROS has built.

    `find` maps a type name (`std_msgs/msg/Header`) to its class, which takes `array.array` for
    sequences of numbers: any other type is copied number by number there.
    """

    def make(typename: str, /, **fields: Any) -> Any:
        return find(typename)(**{name: _native(value) for name, value in fields.items()})

    return make


def _native(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    numbers = array.array(_TYPECODES[value.dtype])
    numbers.frombytes(np.ascontiguousarray(value).data.cast('B') if value.size else b'')
    return numbers


_TYPECODES = {np.dtype(code): code for code in ('B', 'H', 'I', 'Q', 'f', 'd')}


@contextmanager
def refusing(what: str, name: Any) -> Iterator[None]:
    """Turn an InvalidValue into an InvalidMessage that says which map it is about."""
    try:
        yield
    except InvalidValue as err:
        raise InvalidMessage(f'{what} {str(name)[:80]!r}: {err}') from err


def check_size(size_bytes: int) -> None:
    """Refuse a message that is too large to be looked at."""
    if size_bytes > MAX_MESSAGE_BYTES:
        raise InvalidValue(
            f'{size_bytes / 2**20:.0f} MiB, the limit is {MAX_MESSAGE_BYTES // 2**20} MiB: '
            'compress fewer landmarks'
        )


def array_bytes(msg: Any, names: tuple[str, ...]) -> int:
    """Bytes in the named arrays."""
    return sum(np.asarray(getattr(msg, name)).nbytes for name in names)


def numbers(msg: Any, name: str, dtype: npt.DTypeLike) -> Array:
    """Array (n,) of a field, in the byte order of this machine."""
    return np.asarray(getattr(msg, name), dtype=dtype)


def rows(msg: Any, name: str, dtype: npt.DTypeLike, width: int, count: int | None = None) -> Array:
    """Array (count, width) of a field; `count` None is any."""
    values = numbers(msg, name, dtype)
    if len(values) % width or count not in (None, len(values) // width):
        wanted = f'{width} x {"n" if count is None else count}'
        raise InvalidValue(f'{name}: expected {wanted} values, got {len(values)}')
    return values.reshape(-1, width)


def text(msg: Any, name: str) -> str:
    """Text of a field; names end up in logs, tables and file names."""
    value = str(getattr(msg, name))
    if not value.isprintable():
        raise InvalidValue(f'{name}: a control character in {value[:80]!r}')
    return value


def gauge(msg: Any) -> Gauge:
    """Gauge of a message."""
    try:
        return Gauge(int(msg.gauge))
    except ValueError as err:
        raise InvalidValue(f'gauge: {msg.gauge} is none of 7, 6, 4, 0') from err


def descriptors(msg: Any, count: int) -> Descriptors:
    """Descriptors of `count` landmarks."""
    try:
        kind = DescriptorType(int(msg.descriptor_type))
    except ValueError as err:
        raise InvalidValue(f'descriptor_type: {msg.descriptor_type} is none of 0, 1, 2') from err
    values, size = numbers(msg, 'descriptors', np.uint8), int(msg.descriptor_size)
    if len(values) != count * size:
        raise InvalidValue(
            f'descriptors: expected {count} rows of {size} bytes, got {len(values)} bytes'
        )
    return Descriptors(kind, values.reshape(count, size))


def stamp_ns(stamp: Any, name: str = 'header.stamp') -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    if not 0 <= int(stamp.nanosec) < _NS:
        raise InvalidValue(f'{name}: {stamp.nanosec} nanoseconds are more than a second')
    return int(stamp.sec) * _NS + int(stamp.nanosec)


def make_stamp(make: Factory, nanoseconds: int) -> Any:
    """builtin_interfaces/Time of nanoseconds; its seconds have 32 bits."""
    sec, nanosec = divmod(nanoseconds, _NS)
    if not -(2**31) <= sec < 2**31:
        raise InvalidValue(f'stamp_ns: {nanoseconds} does not fit a ROS time')
    return make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)


def make_header(make: Factory, nanoseconds: int, frame_id: str) -> Any:
    """std_msgs/Header of a stamp and a frame."""
    stamp = make_stamp(make, nanoseconds)
    return make('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)


def wire(name: str, values: Any, dtype: npt.DTypeLike) -> Array:
    """Flat array of the type on the wire."""
    with np.errstate(over='ignore'):
        flat = np.ascontiguousarray(values, dtype=dtype).ravel()
    if flat.dtype.kind == 'f' and not np.isfinite(flat).all():
        raise InvalidValue(f'{name}: a value does not fit {flat.dtype}')
    return flat


def uint32(name: str, value: int) -> int:
    """Check that a number fits its field."""
    if not 0 <= value < 2**32:
        raise InvalidValue(f'{name}: {value} does not fit 32 bits')
    return value
