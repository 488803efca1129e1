# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What descriptors and geometry alone find in real sub-maps, and what they never join.

    python benchmarks/association.py ../shared/data --markdown docs/association.md

True ids score the result; nothing of them is used to find it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from association_gold import gold
from association_growth import growth
from association_links import links
from association_negatives import no_false_join
from association_pairs import load_sets, pairs
from documents import put
from threadpoolctl import threadpool_limits

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.submap import SubMap

PARTS = ('pairs', 'links', 'no false join', 'gold', 'growth')
Sets = dict[str, list[SubMap]]


def main(argv: list[str] | None = None) -> int:
    """Print the tables, and write them into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', type=Path, help='folder with one folder per data set')
    parser.add_argument('--markdown', type=Path, help='document whose tables are replaced')
    parser.add_argument('--only', choices=PARTS)
    args = parser.parse_args(argv)
    sets = load_sets(args.data)
    if not sets:
        print(f'{args.data}: no data set with descriptors', file=sys.stderr)
        return 1
    parts: dict[str, Callable[[], str]] = {
        'pairs': lambda: pairs(sets, args.data),
        'links': lambda: links(sets, args.data),
        'no false join': lambda: no_false_join(sets),
        'gold': lambda: gold(sets, args.data),
        'growth': growth,
    }
    try:
        with threadpool_limits(1):
            for name, part in parts.items():
                if args.only in (None, name):
                    report(name, part(), args.markdown)
    except MapMergeError as err:
        print(err, file=sys.stderr)
        return 1
    return 0


def report(name: str, text: str, document: Path | None) -> None:
    """Print one part, and put it into its place in the document."""
    print(f'{name}\n\n{text}\n')
    if document:
        put(document, name, text)


if __name__ == '__main__':
    sys.exit(main())
