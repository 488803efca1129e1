# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Results as files: JSON with every run, the figure, the tables as Markdown."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mapmerge_ros import __version__
from mapmerge_ros.experiments.figures import save
from mapmerge_ros.experiments.result import Check, Experiment, Results, Summary, Table
from mapmerge_ros.experiments.runner import plain
from mapmerge_ros.io import replacing


def write_results(
    folder: Path, experiment: Experiment, results: Results, summary: Summary
) -> tuple[Path, ...]:
    """
    Write NAME.json, NAME.png and NAME.md into an existing folder.

    Raises
    ------
    OutputError
        One of them cannot be written.

    """
    paths = tuple(folder / f'{experiment.name}.{ending}' for ending in ('json', 'md', 'png'))
    with replacing(paths[0]) as stream:
        stream.write(results_json(experiment, results, summary).encode())
    with replacing(paths[1]) as stream:
        stream.write(results_markdown(experiment, results, summary).encode())
    save(experiment.draw(results), paths[2])
    return paths


def results_json(experiment: Experiment, results: Results, summary: Summary) -> str:
    """Everything, the runs last; numbers that are not finite become null."""
    content = plain(
        {
            'experiment': experiment.name,
            'title': experiment.title,
            'version': __version__,
            'seed': results.seed,
            'runs': results.asked,
            'complete': results.complete,
            'summary': asdict(summary),
            'failures': [asdict(failure) for failure in results.failures],
            'results': list(results.values),
        }
    )
    return json.dumps(_finite(content), indent=1, ensure_ascii=False, allow_nan=False) + '\n'


def results_markdown(experiment: Experiment, results: Results, summary: Summary) -> str:
    """Tables and checks as Markdown."""
    lines = [f'# {experiment.title}', '', coverage(results), '']
    for table in (*summary.tables, checks_table(summary.checks)):
        lines += [*_markdown_table(table), '']
    lines += [f'* {note}' for note in summary.notes]
    return '\n'.join(lines).rstrip() + '\n'


def coverage(results: Results) -> str:
    """How many runs there are, and whether any is missing."""
    text = f'{results.ended} runs, seed {results.seed}'
    if not results.complete:
        text = f'INCOMPLETE: {results.ended} of {results.asked} runs, seed {results.seed}'
    if results.failures:
        first = results.failures[0]
        text += f'; {len(results.failures)} failed (run {first.run}: {first.reason})'
    return text


def checks_table(checks: tuple[Check, ...]) -> Table:
    """The claims, as a table."""
    rows = tuple((c.text, c.asked, c.seen, 'yes' if c.holds else 'NO') for c in checks)
    return Table('Checks', ('claim', 'asked', 'seen', 'holds'), rows)


def _markdown_table(table: Table) -> Iterator[str]:
    yield f'**{table.title}**'
    yield ''
    yield _markdown_row(tuple(column.lstrip('#') for column in table.columns))
    yield '|' + '|'.join('--:' if name.startswith('#') else '---' for name in table.columns) + '|'
    yield from map(_markdown_row, table.rows)


def _markdown_row(cells: tuple[str, ...]) -> str:
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |'


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
