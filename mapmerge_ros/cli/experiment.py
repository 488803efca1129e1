# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge experiment`: the paper's experiments and ours, with tables, figures and checks."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable
from pathlib import Path

from mapmerge_ros.cli import console, options
from mapmerge_ros.cli.options import Subparsers, UsageError
from mapmerge_ros.cli.outputs import output_folder
from mapmerge_ros.experiments import Experiment, Results, Summary, run_experiment
from mapmerge_ros.experiments.catalogue import EXPERIMENTS
from mapmerge_ros.experiments.figures import require_matplotlib
from mapmerge_ros.experiments.report import checks_table, coverage, write_results
from mapmerge_ros.experiments.runner import Outcome

EXIT_INTERRUPTED = 130


class _List(argparse.Action):
    """Print the names and leave, as `--help` does: no experiment has to be named."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object, **__: object) -> None:
        table = console.table('name', '#runs', 'what it shows')
        for experiment in EXPERIMENTS.values():
            table.add_row(experiment.name, str(experiment.runs), experiment.title)
        console.stdout().print(table)
        parser.exit()


def add_parser(subparsers: Subparsers, summary: str) -> None:
    """Register the command."""
    parser = options.add_command(
        subparsers,
        'experiment',
        summary,
        "Run one of the paper's experiments or of ours. NAME.json (every run), NAME.png and\n"
        'NAME.md go to the output folder, the table and the checks to the screen. The same\n'
        'seed gives the same result, whatever the number of processes. An interrupted run\n'
        'leaves what it has, marked as incomplete.',
        '  mapmerge experiment --list\n'
        '  mapmerge experiment gamma\n'
        '  mapmerge experiment early-stop --runs 50 --jobs 2 --out out/quick',
    )
    add = parser.add_argument
    add('name', metavar='NAME', help=', '.join(EXPERIMENTS))
    add('--list', action=_List, nargs=0, help='show the experiments and exit')
    add('--runs', type=int, metavar='N', help='default: see --list')
    add('--seed', type=options.natural, default=0, metavar='N', help='default: 0')
    add(
        '--out',
        type=Path,
        default=Path('out/experiments'),
        metavar='DIR',
        help='folder for the results (default: %(default)s)',
    )
    cores = os.cpu_count() or 1
    add('--jobs', type=int, default=cores, metavar='N', help='processes (default: one per core)')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run, write, print."""
    experiment = _chosen(args)
    require_matplotlib()
    with output_folder(args.out) as folder:

        def progress(outcomes: Iterable[Outcome]) -> Iterable[Outcome]:
            return console.progress(outcomes, experiment.name, args.runs or experiment.runs)

        results = run_experiment(
            experiment, runs=args.runs, seed=args.seed, jobs=args.jobs, progress=progress
        )
        summary = experiment.summarise(results)
        paths = write_results(folder, experiment, results, summary)
    _show(experiment, results, summary)
    console.stdout().print(' '.join(map(str, paths)), soft_wrap=True)
    if results.complete:
        return 0
    print(
        f'mapmerge: interrupted: {paths[0]} has {results.ended} of {results.asked} runs and is '
        'marked as incomplete',
        file=sys.stderr,
    )
    return EXIT_INTERRUPTED


def _chosen(args: argparse.Namespace) -> Experiment:
    if args.name not in EXPERIMENTS:
        known = ', '.join(EXPERIMENTS)
        raise UsageError(f'{args.name}: no such experiment: choose from {known}')
    for option, value in (('--runs', args.runs), ('--jobs', args.jobs)):
        if value is not None and value < 1:
            raise UsageError(f'{option}: {value} is below 1')
    return EXPERIMENTS[args.name]


def _show(experiment: Experiment, results: Results, summary: Summary) -> None:
    screen = console.stdout()
    screen.print(f'{experiment.title}: {coverage(results)}', soft_wrap=True)
    for table in (*summary.tables, checks_table(summary.checks)):
        shown = console.table(*table.columns, title=table.title)
        for row in table.rows:
            shown.add_row(*row)
        screen.print(shown)
    for note in summary.notes:
        screen.print(note, soft_wrap=True)
