# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes of their own, on this machine only, ended by whoever started them."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

GRACE_S = 3.0
"""Time to end by itself after SIGINT; nodes need a few tenths of a second."""

FIRST_PORT, PORTS_PER_DOMAIN = 7410, 250
"""Where the first participant of DDS domain 0 listens (DDS-RTPS, 9.6.2)."""

DOMAINS = 100
"""Domains 1 to 100: the ports of higher ones may be taken for outgoing connections."""


class Children:
    """Processes that end with the block, in whatever way it is left."""

    def __init__(self, domain: int, logs: Path) -> None:
        self.domain = domain
        self._environment = {**os.environ, **local_environment(domain)}
        self._logs = logs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Children:
        self._logs.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def start(
        self,
        name: str,
        module: str,
        parameters: Mapping[str, object],
        remappings: Mapping[str, str] | None = None,
    ) -> subprocess.Popen[bytes]:
        """Run a module of nodes; what it prints goes to NAME.log."""
        arguments = ['--disable-external-lib-logs']
        for key, value in parameters.items():
            arguments += ['-p', f'{key}:={json.dumps(value)}']
        for key, topic in (remappings or {}).items():
            arguments += ['-r', f'{key}:={topic}']
        with self.log(name).open('wb') as log:
            self._processes[name] = subprocess.Popen(
                [sys.executable, '-m', module, '--ros-args', *arguments],
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        return self._processes[name]

    def log(self, name: str) -> Path:
        """File with what a process has printed."""
        return self._logs / f'{name}.log'

    def ended(self) -> str:
        """Say which process has ended too early, with its last words; empty if none has."""
        for name, process in self._processes.items():
            if process.poll() is not None:
                words = self.log(name).read_text(errors='replace').strip().splitlines()
                last = words[-1] if words else 'no word'
                return f'{name} ended with code {process.returncode}: {last}'
        return ''

    def stop(self, grace_s: float = GRACE_S) -> dict[str, int]:
        """End all of them; the exit code of each."""
        for process in self._processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        deadline_s = time.monotonic() + grace_s
        for process in self._processes.values():
            try:
                process.wait(max(deadline_s - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        codes = {name: process.returncode for name, process in self._processes.items()}
        self._processes.clear()
        return codes


def local_environment(domain: int) -> dict[str, str]:
    """Variables that keep ROS on this machine and in one domain."""
    return {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def free_domain() -> int:
    """Return a domain that nobody on this machine is in; other for every process at a time."""
    start = 37 * os.getpid()  # processes that start together begin far from each other
    domains = [(start + k) % DOMAINS + 1 for k in range(DOMAINS)]
    return next(filter(_is_free, domains), domains[0])


def _is_free(domain: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', FIRST_PORT + PORTS_PER_DOMAIN * domain))
        except OSError:
            return False
    return True
