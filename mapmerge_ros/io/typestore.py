# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The message types as rosbags knows them, from the same texts that ROS builds."""

from __future__ import annotations

from functools import lru_cache
from importlib import resources
from typing import Any, Final

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

MSGS_VERSION: Final = '0.1.0'
"""Version of the package mapmerge_msgs that these texts belong to."""

SUBMAP: Final = 'mapmerge_msgs/msg/SubMap'
BUNDLE: Final = 'mapmerge_msgs/msg/Bundle'
REQUEST: Final = 'mapmerge_msgs/msg/LandmarkRequest'

_SEPARATOR = '=' * 80 + '\n'


@lru_cache(maxsize=1)
def message_texts() -> dict[str, str]:
    """Type name to the text of its .msg file, for all of mapmerge_msgs."""
    folder = resources.files('mapmerge_ros.io') / 'schemas'
    return {
        f'mapmerge_msgs/msg/{entry.name[:-4]}': entry.read_text(encoding='utf-8')
        for entry in sorted(folder.iterdir(), key=lambda entry: entry.name)
        if entry.name.endswith('.msg')
    }


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """All message types of ROS 2 Jazzy and of mapmerge_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: Typesdict = {}
    for name, text in message_texts().items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


def create(typename: str, /, **fields: Any) -> Any:
    """Make a message of rosbags' own class; arrays are numpy arrays. A `Factory`."""
    return typestore().types[typename](**fields)


@lru_cache(maxsize=64)
def schema_text(typename: str) -> str:
    """
    Definition of a type and of all types inside it, as a recorder embeds it.

    Our own texts stay as they are written: their comments hold the units and the frames.
    """
    head, *rest = typestore().generate_msgdef(typename, ros_version=2)[0].split(_SEPARATOR)
    sections = [_own_text(typename, head)]
    for section in rest:
        title, body = section.split('\n', 1)
        package, name = title.removeprefix('MSG: ').split('/')
        sections.append(f'{title}\n{_own_text(f"{package}/msg/{name}", body)}')
    return _SEPARATOR.join(sections)


def _own_text(typename: str, generated: str) -> str:
    text = message_texts().get(typename, generated)
    return text if text.endswith('\n') else text + '\n'


@lru_cache(maxsize=64)
def type_hash(typename: str) -> str:
    """RIHS01 hash of a type, as ROS 2 computes it."""
    return typestore().hash_rihs01(typename)
