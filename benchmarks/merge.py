# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
The merge against the full bundle, from 4 to 1024 drones: time, memory, error to the truth.

    python benchmarks/merge.py [--sizes S1 S2 …] [--repeats 5] [--markdown FILE] [--figure FILE]

Each measurement runs in a process of its own with one BLAS thread, its repeats one after the
other; medians of CPU seconds. The first run of all makes the workloads (S5: some minutes).
`--quick` measures a fleet of four drones, once.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from documents import put
from merge_compression import compression
from merge_kinds import KINDS
from merge_steps import Values
from merge_tables import draw, tables
from own_process import memory_growth, run_apart
from workloads import DRONES, Workload, cached, workload

from mapmerge_ros.fusion import fuse

MARK = 'tables of benchmarks/merge.py'

COMPRESSION = 'compression'
"""A kind that is not about a size"""

NOT_OF: dict[str, tuple[str, ...]] = {
    'S3': ('dense',),
    'S4': ('dense',),
    'S5': ('dense', 'bundle', 'whole', 'local', 'accuracy'),
}
"""What takes too long or too much memory."""

ONCE = {('bundle', 'S3'), ('bundle', 'S4'), ('known', 'S5'), ('local', 'S4')}
"""What takes minutes is measured once."""


def run(kind: str, name: str, folder: Path, repeats: int) -> Values:
    """Measure in this process; memory is the growth of its peak, data included."""
    fuse(cached('S1', folder).submaps[:2])  # libraries are loaded and warm
    with memory_growth() as memory:
        load = cached(name, folder, bundles=kind in ('bundle', 'accuracy'))
        values = KINDS[kind](load, repeats)
    return {**values, **memory}


def measure(kind: str, name: str, folder: Path, repeats: int) -> Values:
    """One kind of measurement in a process of its own."""
    repeats = 1 if (kind, name) in ONCE else repeats
    arguments = ['--run', kind, '--sizes', name, '--cache', str(folder)]
    return run_apart(__file__, *arguments, '--repeats', str(repeats))


def quick(load: Workload | None = None) -> dict[str, Values]:
    """Every kind of measurement once, of four drones, in this process; memory is left out."""
    load = load or workload('S2', drones=4)
    return {kind: measured(load, 1) for kind, measured in KINDS.items()}


def all_of(sizes: list[str], folder: Path, repeats: int) -> dict[str, Any]:
    """Every measurement of some sizes, and of the compression."""
    results: dict[str, Any] = {'drones': {name: DRONES[name] for name in sizes}, 'sizes': {}}
    for name in sizes:
        cached(name, folder)
        results['sizes'][name] = found = {}
        for kind in KINDS:
            if kind not in NOT_OF.get(name, ()):
                found[kind] = measure(kind, name, folder, repeats)
                print(json.dumps({name: {kind: found[kind]}}), file=sys.stderr, flush=True)
    arguments = ['--run', COMPRESSION, '--repeats', str(repeats)]
    results[COMPRESSION] = run_apart(__file__, *arguments)
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--sizes', nargs='+', default=list(DRONES), choices=DRONES, metavar='S1')
    parser.add_argument('--repeats', type=int, default=5)
    parser.add_argument('--cache', type=Path, default=Path('build/workloads'))
    parser.add_argument('--quick', action='store_true')
    parser.add_argument('--json', type=Path, help='all values')
    parser.add_argument('--markdown', type=Path, help='page whose tables at the end are renewed')
    parser.add_argument('--figure', type=Path, help='time and memory over the number of drones')
    parser.add_argument('--run', choices=(*KINDS, COMPRESSION), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.run == COMPRESSION:
        print(json.dumps(compression(args.repeats)))
        return
    if args.run:
        print(json.dumps(run(args.run, args.sizes[0], args.cache, args.repeats)))
        return
    if args.quick:
        print(json.dumps(quick(), indent=1))
        return
    results = all_of(args.sizes, args.cache, args.repeats)
    print(tables(results))
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + '\n')
    if args.markdown:
        put(args.markdown, MARK, f'\n{tables(results)}\n')
    if args.figure:
        draw(results, args.figure)


if __name__ == '__main__':
    main()
