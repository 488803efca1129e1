# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests on real topics; ROS is imported only where one of them is asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from mapmerge_ros.cli.processes import Children, free_domain
from mapmerge_ros.submap import SubMap

if TYPE_CHECKING:
    from ros_processes import Observer


def pytest_configure() -> None:
    """Compute in one BLAS thread: two cost ten times as much on a busy machine."""
    import scipy.linalg  # noqa: F401 - its BLAS is not that of numpy
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, user_api='blas')


@pytest.fixture(scope='session')
def drones_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of four drones."""
    from ros_processes import make_recording

    return make_recording(tmp_path_factory.mktemp('recording'))


@pytest.fixture(scope='session')
def drones(drones_recording: Path) -> tuple[SubMap, ...]:
    """The sub-maps of it."""
    from ros_processes import load

    return load(drones_recording)


@pytest.fixture
def children(tmp_path: Path) -> Iterator[Children]:
    """Processes in a domain of their own that end with the test."""
    with Children(free_domain(), tmp_path / 'logs') as started:
        yield started


@pytest.fixture
def observer(children: Children) -> Iterator[Observer]:
    """A node of this process in the same domain."""
    from ros_processes import observing

    with observing(children.domain) as node:
        yield node


@pytest.fixture
def fusion_node(observer: Observer) -> Iterator[Callable[..., Any]]:
    """Make fusion nodes in this process, of parameters by name; to be spun with the observer."""
    from ros_processes import rclpy

    from mapmerge_ros.nodes.fusion_node import FusionNode

    made: list[Any] = []

    def make(**values: Any) -> Any:
        overrides = [rclpy.Parameter(name, value=value) for name, value in values.items()]
        made.append(FusionNode(parameter_overrides=overrides))
        return made[-1]

    yield make
    for node in made:
        node.close()
        node.destroy_node()


@pytest.fixture
def nodes(observer: Observer, fusion_node: Callable[..., Any]) -> list[Any]:
    """A fusion node in this process that merges only when asked, and its observer."""
    return [fusion_node(merge_period=3600.0), observer]
