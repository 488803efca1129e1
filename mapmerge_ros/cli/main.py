# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge`: one parser per command, and one line for what a user can cause."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from threadpoolctl import threadpool_limits

from mapmerge_ros import __version__
from mapmerge_ros.cli import compress, demo, experiment, info, record, refine, replay, simulate
from mapmerge_ros.cli.options import UsageError
from mapmerge_ros.errors import MapMergeError

COMMANDS = (compress, replay, refine, info, record, simulate, demo, experiment)

EXIT_ERROR, EXIT_USAGE, EXIT_INTERRUPTED = 1, 2, 130

DESCRIPTION = """\
Merge the visual maps of several robots into one, and test whether to believe it.

  mapmerge compress   maps of robots  ->  a recording of compressed sub-maps
  mapmerge replay     recordings      ->  one map, with report
"""

EPILOG = """\
exit codes: 0 a result was written, whatever its verdict; 1 the input cannot be used,
2 wrong usage. `mapmerge COMMAND --help` shows options and examples.
"""


def build_parser() -> argparse.ArgumentParser:
    """Parser of all commands."""
    parser = argparse.ArgumentParser(
        prog='mapmerge',
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--version', action='version', version=f'mapmerge {__version__}')
    subparsers = parser.add_subparsers(
        dest='command', metavar='COMMAND', title='commands', required=True
    )
    for command in COMMANDS:
        command.add_parser(subparsers)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code."""
    args = build_parser().parse_args(argv)
    try:
        # Two BLAS threads on small matrices cost ten times as much as one.
        with threadpool_limits(1):
            return int(args.run(args))
    except UsageError as err:
        return _fail(err, EXIT_USAGE)
    except MapMergeError as err:
        return _fail(err, EXIT_ERROR)
    except BrokenPipeError:
        # The reader of stdout (`head`) has gone; Python would complain once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_ERROR
    except KeyboardInterrupt:
        return _fail('interrupted', EXIT_INTERRUPTED)


def _fail(reason: Exception | str, code: int) -> int:
    print(f'mapmerge: {" ".join(str(reason).split())}', file=sys.stderr)
    return code


if __name__ == '__main__':
    sys.exit(main())
