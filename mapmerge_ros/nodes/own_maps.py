# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""All maps of one robot: what it makes of bundles, of requests and of the global map."""

from __future__ import annotations

from collections.abc import Iterator

from mapmerge_ros.bundle import MapName
from mapmerge_ros.errors import DegenerateGeometry, InvalidValue
from mapmerge_ros.io import (
    InvalidMessage,
    NamedBundle,
    decode_bundle,
    decode_bundle_name,
    decode_submap,
)
from mapmerge_ros.nodes.own_map import Done, OwnMap, work
from mapmerge_ros.nodes.way_back import Corrected, correct
from mapmerge_ros.submap import Request


def is_newer(new: MapName, old: MapName) -> bool:
    """As with sub-maps: a SLAM that was restarted counts anew, and has seen more."""
    return new.revision > old.revision or new.stamp_ns > old.stamp_ns


class OwnMaps:
    """
    The maps by their name.

    `decode`, `prepare`, `answer`, `answer_again` and `correct` take long and change nothing that
    the owner's thread reads; the owner takes over what they made.
    """

    def __init__(self, robot_id: str, first_revision: int) -> None:
        """`robot_id` empty: of whatever robot a bundle is."""
        self._robot_id = robot_id
        self._first_revision = first_revision
        self._maps: dict[str, OwnMap] = {}
        self.global_map: bytes | None = None
        """The last one in which a map of this robot is"""

    def __getitem__(self, map_id: str) -> OwnMap:
        return self._maps[map_id]

    def __iter__(self) -> Iterator[str]:
        return iter(self._maps)

    def get(self, map_id: str) -> OwnMap | None:
        """Return a map, None if it is not of this robot."""
        return self._maps.get(map_id)

    def decode(self, raw: bytes) -> NamedBundle | None:
        """
        Bundle of a message; None if it is not of this robot, or older than what is known.

        Raises
        ------
        InvalidMessage
            What is wrong with it.

        """
        # Most of what is not wanted came on both topics: its name says so at no cost.
        return decode_bundle(raw) if self.wants(decode_bundle_name(raw)) else None

    def wants(self, name: MapName) -> bool:
        """Whether a bundle of this name is of this robot, and newer than what is known."""
        if self._robot_id not in ('', name.robot_id):
            return False
        known = self._maps.get(name.map_id)
        return known is None or is_newer(name, known.named.name)

    def prepare(self, named: NamedBundle) -> OwnMap:
        """
        Make the next revision of a bundle, above all that are known.

        It is compressed to what was asked of the bundle before it, and bare where nothing was,
        or where too little of that is left.

        Raises
        ------
        InvalidMessage
            Its numbers cannot be computed with.

        """
        name = named.name
        revision, known = max(self._first_revision, name.revision), self._maps.get(name.map_id)
        if known is not None:
            revision = max(revision, known.newest + 1)
        try:
            own = OwnMap(named, revision)
            # A SLAM that counts anew may well have given the ids to other points.
            if known is not None and name.revision > known.named.name.revision:
                own.carry_on(known)
        except (InvalidValue, DegenerateGeometry) as err:
            raise InvalidMessage(f'bundle {name.map_id!r}: {err}') from err
        return own

    def take(self, own: OwnMap) -> str:
        """Put a map in the place of an older one; its name."""
        map_id = own.announced.map_id
        known = self._maps.get(map_id)
        if known is not None and own.newest <= known.newest:
            own.start_at(known.newest + 1)
        self._maps[map_id] = own
        return map_id

    def answer(self, request: Request) -> Done:
        """Compress what a request asks for."""
        return work(self._maps[request.map_id].job(request))

    def answer_again(self, corrected: Corrected) -> Done | None:
        """Compress the same landmarks, linearised where the fusion has them."""
        own = self._maps[corrected.map_id]
        return None if own.asked is None else work(own.job(own.asked, corrected.bundle))

    def correct(self, raw: bytes) -> list[tuple[NamedBundle, Corrected]]:
        """
        Every map of this robot that is inside a global map, in agreement with it.

        Raises
        ------
        InvalidMessage
            The global map breaks its contract.

        """
        global_map = decode_submap(raw)
        found = []
        for source in global_map.sources:
            own = self._maps.get(source.map_id)
            if own is None or not own.sent(source.revision):
                continue
            try:
                corrected = correct(own.bundle, own.announced, global_map)
            except DegenerateGeometry:
                continue  # it keeps the path that it has
            if corrected is not None:
                found.append((own.named, corrected))
        if found:
            self.global_map = raw
        return found
