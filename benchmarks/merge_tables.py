# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables and the figure of `merge.py`."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

HEAD = (
    ('', 'size'),
    ('drones', 'drones'),
    ('shared', 'landmarks'),
    ('message [kB]', 'message'),
    ('observations [kB]', 'observations'),
    ('merge [s]', 'merge'),
    ('exponent', 'exponent'),
    ('one replaced [s]', 'rewarm'),
    ('cold : replaced', 'cold_to_warm'),
    ('full bundle [s]', 'bundle'),
    ('bundle : merge', 'ratio'),
    ('both as near', 'near_ratio'),
    ('within 1 % [s]', 'nearly'),
    ('memory merge [MB]', 'memory'),
    ('memory bundle : merge', 'memory_ratio'),
)

SECOND = (
    ('', 'size'),
    ('merge', 'rmse'),
    ('merge : bundle', 'rmse_ratio'),
    ('merge : bundle, many draws', 'pooled_ratio'),
    ('apart : error of bundle', 'apart'),
    ('apart, after a round', 'apart_after'),
    ('merge : bundle, after a round', 'ratio_after'),
    ('Procrustes : bundle', 'procrustes_ratio'),
    ('Procrustes [s]', 'procrustes'),
    ('dense merge [s]', 'dense'),
    ('std and R̄ [s]', 'known'),
    ('memory with them [MB]', 'known_memory'),
    ('tests of all landmarks [s]', 'local'),
    ('tests : merge', 'local_ratio'),
    ('scan for objects [s]', 'scan'),
    ('all of `fuse` [s]', 'whole'),
    ('steps', 'steps'),
    ('steps, one replaced', 'warm_steps'),
)

COMPRESSION = (
    ('session', 'size'),
    ('landmarks', 'landmarks'),
    ('chosen', 'choice'),
    ('compression [ms]', 'ms'),
    ('dense QR [s]', 'dense_cpu_s'),
    ('dense : compression', 'ratio'),
    ("difference of R'R", 'difference'),
)


def tables(results: dict[str, Any]) -> str:
    """Markdown of all results."""
    rows = rows_of(results)
    return '\n'.join(
        [
            *_table(HEAD, rows),
            '',
            f'Exponent of the time from S2 on: {_exponent_from_second(rows)}.',
            '',
            'Error to the truth (RMSE of the shared landmarks, m), other methods, other parts:',
            '',
            *_table(SECOND, rows),
            '',
            *compression_table(results['compression']['choices']),
        ]
    )


def compression_table(choices: list[dict[str, Any]]) -> list[str]:
    """Sessions compressed beside dense QR; the worst of them in a sentence."""
    rows = [
        {
            'size': f'{one["keyframes"]} key frames, {one["points"]} points',
            **one,
            'ms': one['cpu_s'] * 1e3,
            'ratio': one['dense_cpu_s'] / one['cpu_s'],
        }
        for one in choices
    ]
    smallest = min(row['ratio'] for row in rows)
    worst = max(row['difference'] for row in rows)
    return [
        f'Compression of a session: at least {smallest:.0f} times faster than dense QR; '
        f"R'R differs by at most {worst:.1e} of its largest entry.",
        '',
        *_table(COMPRESSION, rows),
    ]


def rows_of(results: dict[str, Any]) -> list[dict[str, Any]]:
    """One row of numbers per size; what was not measured is missing."""
    rows: list[dict[str, Any]] = []
    for size, found in results['sizes'].items():
        merge = found['merge']
        row = {
            'size': size,
            'drones': results['drones'][size],
            'landmarks': merge['landmarks'],
            'message': merge['message_bytes'] / 1e3,
            'merge': merge['cpu_s'],
            'memory': merge['growth_mb'],
            'rmse': merge['rmse_m'],
            'steps': merge['iterations'],
        }
        if rows:
            row['exponent'] = _exponent(rows[-1], row)
        for kind in ('rewarm', 'bundle', 'procrustes', 'dense', 'known', 'local', 'whole'):
            if kind in found:
                row[kind] = found[kind]['cpu_s']
        if 'rewarm' in found:
            row['cold_to_warm'] = row['merge'] / row['rewarm']
            row['warm_steps'] = found['rewarm']['iterations']
        if 'local' in found:
            row['local_ratio'] = row['local'] / row['merge']
            row['scan'] = found['local']['scan_cpu_s']
        if 'accuracy' in found:
            accuracy = found['accuracy']
            row['pooled_ratio'] = f'{accuracy["ratio"]:.4f} ({accuracy["draws"]})'
            row['apart'] = accuracy['apart']
            row['apart_after'] = accuracy['apart_after_a_round']
            row['ratio_after'] = f'{accuracy["ratio_after_a_round"]:.5f}'
        if 'known' in found:
            row['known_memory'] = found['known']['growth_mb']
        if 'bundle' in found:
            row |= _beside(found, row)
        rows.append(row)
    return rows


def _beside(found: dict[str, Any], row: dict[str, Any]) -> dict[str, Any]:
    """Ratios to the full bundle; its error counts only where it has converged."""
    bundle = found['bundle']
    ratios = {
        'observations': bundle['observation_bytes'] / 1e3,
        'ratio': bundle['cpu_s'] / row['merge'],
        'nearly': bundle['nearly_s'],
        'memory_ratio': bundle['growth_mb'] / row['memory'],
    }
    if bundle['converged']:
        ratios['near_ratio'] = bundle['near_share'] * ratios['ratio']
        ratios['rmse_ratio'] = row['rmse'] / bundle['rmse_m']
        ratios['procrustes_ratio'] = found['procrustes']['rmse_m'] / bundle['rmse_m']
    else:
        ratios['bundle'] = f'{bundle["cpu_s"]:.0f}, not converged'
        ratios['ratio'] = f'more than {ratios["ratio"]:.0f}'
    return ratios


def _exponent(low: dict[str, Any], high: dict[str, Any]) -> float:
    return float(np.log(high['merge'] / low['merge']) / np.log(high['drones'] / low['drones']))


def _exponent_from_second(rows: list[dict[str, Any]]) -> str:
    large = [row for row in rows if row['drones'] >= 16]
    return f'n^{_exponent(large[0], large[-1]):.2f}' if len(large) > 1 else 'not measured'


def _table(head: tuple[tuple[str, str], ...], rows: list[dict[str, Any]]) -> list[str]:
    lines = ['| ' + ' | '.join(title for title, _ in head) + ' |', '|---' * len(head) + '|']
    for row in rows:
        lines.append('| ' + ' | '.join(_cell(row.get(key, '')) for _, key in head) + ' |')
    return lines


def _cell(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    if value >= 100.0:
        return f'{value:.0f}'
    return f'{value:.4f}' if 0.9 < value < 1.1 else f'{value:.3g}'


def draw(results: dict[str, Any], path: Path) -> None:
    """Time and memory over the number of drones, with growth exponents."""
    import matplotlib as mpl

    mpl.use('Agg')
    import matplotlib.pyplot as plt

    rows = rows_of(results)
    figure, (times, memory) = plt.subplots(1, 2, figsize=(9, 3.6), layout='constrained')
    for key, label in (
        ('merge', 'merge'),
        ('rewarm', 'one replaced'),
        ('known', 'std and R̄'),
        ('dense', 'dense merge'),
        ('bundle', 'full bundle (Ceres)'),
    ):
        some = [row for row in rows if isinstance(row.get(key), float)]
        times.loglog([r['drones'] for r in some], [r[key] for r in some], 'o-', label=label)
    for low, high in pairwise(rows):
        middle = np.sqrt(low['drones'] * high['drones']), np.sqrt(low['merge'] * high['merge'])
        times.annotate(f'n^{high["exponent"]:.2f}', middle, fontsize=8)
    times.set(xlabel='drones', ylabel='CPU time [s]')
    times.legend(fontsize=8)
    memory.loglog([r['drones'] for r in rows], [r['memory'] for r in rows], 'o-', label='merge')
    beside = [row for row in rows if 'memory_ratio' in row]
    memory.loglog(
        [row['drones'] for row in beside],
        [row['memory'] * row['memory_ratio'] for row in beside],
        'o-',
        label='full bundle (Ceres)',
    )
    memory.set(xlabel='drones', ylabel='growth of the peak memory [MB]')
    memory.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
