# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
How long another thread waits for the interpreter while a fusion runs.

    python benchmarks/waiting.py --sizes S3 S4

The fusion runs in a thread of its own, as in the node; another one, like the executor, wishes to
do something every millisecond. Large products leave it the interpreter (`mapmerge_ros.blas`);
what is left is Python's own switch of threads, every 5 ms.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits
from workloads import DRONES, cached

from mapmerge_ros.fusion import fuse

PAUSE_S = 1e-3


def waits_s(job: Callable[[], Any]) -> tuple[float, list[float]]:
    """Seconds that a job takes in a thread, and those between two turns of this one meanwhile."""
    thread, waits = threading.Thread(target=job), list[float]()
    begin = last = time.perf_counter()
    thread.start()
    while thread.is_alive():
        time.sleep(PAUSE_S)
        now = time.perf_counter()
        waits.append(now - last)
        last = now
    return last - begin, waits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--sizes', nargs='+', default=['S3', 'S4'], choices=DRONES, metavar='S3')
    parser.add_argument('--cache', type=Path, default=Path('build/workloads'))
    args = parser.parse_args()
    print(
        '| drones | all of `fuse` [s] | longest wait [ms] | 99 % of all [ms] |\n|---|---|---|---|'
    )
    with threadpool_limits(1):
        fuse(cached('S1', args.cache).submaps)  # libraries are loaded
        for name in args.sizes:
            submaps = cached(name, args.cache).submaps
            took_s, waits = waits_s(lambda submaps=submaps: fuse(submaps))
            longest_ms, usual_ms = 1e3 * max(waits), 1e3 * float(np.quantile(waits, 0.99))
            print(f'| {DRONES[name]} | {took_s:.1f} | {longest_ms:.0f} | {usual_ms:.0f} |')


if __name__ == '__main__':
    main()
