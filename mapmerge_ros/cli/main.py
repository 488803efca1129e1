# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge`: one parser per command, and one line for what a user can cause."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from threadpoolctl import threadpool_limits

from mapmerge_ros import __version__
from mapmerge_ros.cli.options import UsageError
from mapmerge_ros.errors import MapMergeError

COMMANDS = {
    'compress': 'COLMAP models to compressed sub-maps',
    'replay': 'recordings to one merged map, with report',
    'refine': 'rounds of merging and linearising again, with the models at hand',
    'info': 'what is inside a recording',
    'record': 'sub-maps, requests and results of running nodes to a recording',
    'salvage': 'what can still be read of a damaged recording, as a whole one',
    'simulate': 'drones over a yard as a recording, with truth',
    'demo': 'the real nodes on real topics, and the result checked',
    'experiment': "the paper's experiments and ours, with figures",
}
"""What each does; its module of this name knows the options."""

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


def build_parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """
    Parser of all commands, with the options of the one that the arguments name.

    Modules of the others are not even imported: a user waits for that.
    """
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
    named = next((word for word in arguments if not word.startswith('-')), None)
    for command, summary in COMMANDS.items():
        if command == named:
            module = importlib.import_module(f'mapmerge_ros.cli.{command}')
            module.add_parser(subparsers, summary)
        else:
            subparsers.add_parser(command, help=summary)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code."""
    arguments = sys.argv[1:] if argv is None else argv
    args = build_parser(arguments).parse_args(arguments)
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
