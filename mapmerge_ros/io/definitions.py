# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a bag's own definition of a message is ours."""

from __future__ import annotations

from functools import lru_cache

from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

from mapmerge_ros.io.typestore import MSGS_VERSION, type_hash, typestore

_IDL_SEPARATOR = '=' * 80 + '\n'


def foreign_definition(connection: Connection) -> str:
    """Why messages of this connection cannot be read, in one line; empty if they can."""
    definition = connection.msgdef
    reason = _reason(connection.msgtype, definition.format, definition.data, connection.digest)
    if not reason:
        return ''
    return (
        f'topic {connection.topic} has another definition of {connection.msgtype}: {reason}; '
        f're-record with mapmerge_msgs {MSGS_VERSION}'
    )


@lru_cache(maxsize=64)
def _reason(name: str, kind: MessageDefinitionFormat, text: str, digest: str) -> str:
    """Parsing takes 20 ms, and all robots send the same text."""
    try:
        return _difference(name, kind, text, digest)
    except TypesysError as err:
        return f'it cannot be parsed ({" ".join(str(err).split())[:80]})'


def _difference(name: str, kind: MessageDefinitionFormat, text: str, digest: str) -> str:
    if kind == MessageDefinitionFormat.NONE:
        same = digest in ('', type_hash(name))
        return '' if same else f'its hash is {digest[:20]}…'
    theirs, ours = _embedded_types(name, kind, text), typestore().fielddefs
    for inner in _reachable(name):
        if inner not in theirs:
            return f'it lacks {inner}'
        reason = _field_difference(dict(theirs[inner][1]), dict(ours[inner][1]))
        if reason:
            return reason if inner == name else f'{inner}: {reason}'
        if [field for field, _ in theirs[inner][1]] != [field for field, _ in ours[inner][1]]:
            return f'{inner}: another order of fields'
    return ''


def _field_difference(theirs: dict[str, FieldDesc], ours: dict[str, FieldDesc]) -> str:
    missing = [name for name in ours if name not in theirs]
    unknown = [name for name in theirs if name not in ours]
    changed = [name for name in ours if name in theirs and ours[name] != theirs[name]]
    parts = (('missing', missing), ('unknown', unknown), ('other type', changed))
    return ', '.join(f'{word}: {" ".join(names)}' for word, names in parts if names)


def _embedded_types(name: str, kind: MessageDefinitionFormat, text: str) -> Typesdict:
    if kind == MessageDefinitionFormat.MSG:
        return get_types_from_msg(text, name)
    types: Typesdict = {}
    for section in text.split(_IDL_SEPARATOR):
        body = section.split('\n', 1)[1] if section.startswith('IDL: ') else section
        if body.strip():
            types.update(get_types_from_idl(body))
    return types


def _reachable(typename: str) -> list[str]:
    """Return the type and all types inside it."""
    found = [typename]
    for name in found:  # grows while it is read
        for _, description in typestore().fielddefs[name][1]:
            inner = _inner_type(description)
            if inner and inner not in found:
                found.append(inner)
    return found


def _inner_type(description: FieldDesc) -> str:
    if description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return _inner_type(description[1][0])
    return str(description[1]) if description[0] == Nodetype.NAME else ''
