# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The life of a process with one node: started, spun, and ended by a signal without a word."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from inspect import cleandoc
from pathlib import Path
from typing import Any, Protocol

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.utilities import remove_ros_args
from threadpoolctl import threadpool_limits

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.nodes.settings import Setting, described, unknown

WAKE_S = 0.5
"""Longest wait for a message before the node asks whether it shall end."""


USAGE = """\
usage: {name} [--ros-args [-r FROM:=TO] [-p NAME:=VALUE] [--params-file FILE]]

{about}

parameters:"""


class ClosableNode(Protocol):
    """A node that has something to end before it goes."""

    def close(self) -> None:
        """End threads and files."""
        ...

    def get_logger(self) -> Any:
        """Where it writes."""
        ...

    def destroy_node(self) -> None:
        """End what the middleware holds."""
        ...


def run_node(
    make: Callable[[], ClosableNode],
    args: Sequence[str] | None = None,
    settings: Sequence[Setting] = (),
) -> int:
    """
    Spin a node until SIGINT or SIGTERM, with one BLAS thread; the exit code of the process.

    `settings` are its parameters, for who asks for help.
    """
    own = remove_ros_args(sys.argv if args is None else ['', *args])[1:]
    if {'-h', '--help'} & set(own):
        about = cleandoc(sys.modules[make.__module__].__doc__ or '')
        usage = USAGE.format(name=Path(sys.argv[0]).stem, about=about)
        print(f'{usage}\n{described(settings)}')
        return 0
    if own:
        remedy = 'parameters: --ros-args -p NAME:=VALUE'
        print(f'unexpected: {" ".join(own)}; {remedy}', file=sys.stderr)
        return 2
    with threadpool_limits(1):
        return _run(make, args)


def _run(make: Callable[[], ClosableNode], args: Sequence[str] | None) -> int:
    # rclpy ends the spin at both signals; Python's own answer would cut a callback short.
    signal.signal(signal.SIGINT, _keep_calm)
    rclpy.init(args=None if args is None else list(args))
    node: ClosableNode | None = None
    try:
        node = make()
        for line in unknown(node):
            node.get_logger().warning(line)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        # A signal between two waits wakes nobody: look again before long.
        while rclpy.ok():
            executor.spin_once(timeout_sec=WAKE_S)
    except ExternalShutdownException:
        return 0
    except (MapMergeError, ParameterException) as err:
        print(' '.join(str(err).split()), file=sys.stderr)
        return 1
    except Exception:
        if rclpy.ok():
            raise
        return 0  # a callback was about to publish when the context ended
    finally:
        if node is not None:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _keep_calm(signum: int, frame: Any) -> None:
    """Leave the signal to rclpy."""
