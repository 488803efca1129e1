# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The nodes of the demo as processes, and what they say on their topics."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from mapmerge_ros.cli.demo_check import Arrived, states_of
from mapmerge_ros.cli.outputs import ros_name
from mapmerge_ros.cli.processes import Children, free_domain
from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.fusion import Fusion
from mapmerge_ros.io import decode_submap
from mapmerge_ros.io.wording import readable_bytes
from mapmerge_ros.submap import SubMap

FUSION_NODE = 'fusion_node'


class DemoError(MapMergeError):
    """The demo cannot run, or something in it has ended too early."""


@dataclass(frozen=True, slots=True)
class Stage:
    """What is played, and where."""

    recording: Path
    rate: float
    """Times as fast as recorded"""
    timeout_s: float
    domain: int | None
    """ROS domain; None = a free one"""
    logs: Path
    """Folder"""


class Heard:
    """The newest of each message of a fusion node; callbacks for any kind of node."""

    def __init__(self, on_status: Callable[[Heard], None] | None = None) -> None:
        self.global_map: SubMap | None = None
        self.alignments: Any = None
        """AlignmentArray"""
        self.status: Any = None
        """FusionStatus"""
        self._on_status = on_status

    @property
    def is_complete(self) -> bool:
        """Whether the messages at hand are all about one merge."""
        return (
            self.global_map is not None
            and self.status is not None
            and self.alignments is not None
            and self.alignments.header.stamp == self.status.header.stamp
            and self.global_map.revision == self.status.revision
        )

    def take_map(self, raw: bytes) -> None:
        """Take a serialised SubMap."""
        self.global_map = decode_submap(raw)

    def take_alignments(self, message: Any) -> None:
        """Take an AlignmentArray."""
        self.alignments = message

    def take_status(self, message: Any) -> None:
        """Take a FusionStatus, the last message about a merge."""
        self.status = message
        if self._on_status:
            self._on_status(self)

    def arrived(self) -> Arrived | None:
        """Return all about one merge, None if something is missing."""
        if self.global_map is None or not self.is_complete:
            return None
        states = {x.map_id: (x.revision, x.state) for x in self.alignments.alignments}
        return Arrived(self.global_map, self.status, states)


Listen = Callable[[int, str, Heard], AbstractContextManager[Callable[[], None]]]
"""Given domain, fusion node and where to put it: a context with a function that receives."""


def play_live(stage: Stage, fusion: Fusion, listen: Listen, screen: Console) -> Arrived:
    """
    Start robots and fusion node, and wait until every sub-map is where the replay has it.

    Raises
    ------
    DemoError
        A process has ended too early, or the time is over.

    """
    robots = sorted({item.submap.robot_id for item in fusion.alignments})
    domain = free_domain() if stage.domain is None else stage.domain
    screen.print(f'{len(robots)} robots and a fusion node, ROS domain {domain}, this machine only')
    heard = Heard(_Narrator(screen))
    with Children(domain, stage.logs) as children:
        children.start('fusion', 'mapmerge_ros.nodes.fusion_node', {})
        for robot_id in robots:
            children.start(
                ros_name(robot_id),
                'mapmerge_ros.nodes.robot_node',
                {'recording': str(stage.recording), 'robot_id': robot_id, 'rate': stage.rate},
                {'__node': f'robot_{ros_name(robot_id)}'},
            )
        with listen(domain, f'/{FUSION_NODE}', heard) as receive:
            return _wait(heard, receive, children, fusion, stage.timeout_s)


def _wait(
    heard: Heard,
    receive: Callable[[], None],
    children: Children,
    fusion: Fusion,
    timeout_s: float,
) -> Arrived:
    expected = states_of(fusion)
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        receive()
        arrived = heard.arrived()
        if arrived is not None and arrived.states == expected:
            return arrived
        if ended := children.ended():
            raise DemoError(ended)
    count = len(heard.alignments.alignments) if heard.alignments else 0
    raise DemoError(
        f'{count} of {len(expected)} sub-maps heard after {timeout_s:g} s, and not all are as in '
        f'the replay: see {children.log("fusion")}'
    )


class _Narrator:
    """Says what is new in every merge."""

    def __init__(self, screen: Console) -> None:
        self._screen = screen
        self._known: set[str] = set()
        self._started_s = time.monotonic()

    def __call__(self, heard: Heard) -> None:
        """Report the newest status."""
        status, array = heard.status, heard.alignments
        names = {item.map_id for item in array.alignments} if array else set()
        for name in sorted(names - self._known):
            self._say(f'{name} heard')
        self._known |= names
        self._say(
            f'{status.merged} of {status.sub_maps} sub-maps merged, '
            f'{status.landmarks} landmarks, ã/dof {_ratio(status)}, p = {status.p_value:.2g}, '
            f'{1000 * status.total_s:.0f} ms, {readable_bytes(status.bytes_in)} in'
        )

    def _say(self, text: str) -> None:
        elapsed_s = time.monotonic() - self._started_s
        self._screen.print(f'{elapsed_s:5.1f} s  {text}', soft_wrap=True)


def _ratio(status: Any) -> str:
    return f'{status.variance_factor:.2f} σ²' if status.dof else '–'
