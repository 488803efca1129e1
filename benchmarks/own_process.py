# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements in a process of their own: one BLAS thread, memory that nothing else has used."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mapmerge_ros.errors import MapMergeError

THREADS = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1')


def run_apart(script: str, *arguments: str) -> dict[str, Any]:
    """Values that a script prints as the last line, in JSON."""
    done = subprocess.run(
        [sys.executable, script, *arguments],
        env={**os.environ, **THREADS},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        command = ' '.join((Path(script).name, *arguments))
        raise MapMergeError(f'{command} failed: {done.stderr.strip()[-2000:]}')
    return dict(json.loads(done.stdout.splitlines()[-1]))


@contextmanager
def memory_growth() -> Iterator[dict[str, float]]:
    """Fill `growth_mb` and `peak_mb`: the peak of this process' memory while the block runs."""
    found: dict[str, float] = {}
    gc.collect()
    Path('/proc/self/clear_refs').write_text('5')  # the peak so far is forgotten
    before = _resident_mb('VmRSS')
    yield found
    found['peak_mb'] = _resident_mb('VmHWM')
    found['growth_mb'] = found['peak_mb'] - before


def _resident_mb(entry: str) -> float:
    """Memory of this process: VmRSS, or VmHWM (peak)."""
    for line in Path('/proc/self/status').read_text().splitlines():
        if line.startswith(entry):
            return int(line.split()[1]) / 1024.0
    raise MapMergeError('the memory of a process is read from /proc: this runs on Linux only')
