# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures: matplotlib without a screen, one look for all experiments."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mapmerge_ros.experiments.result import ExperimentError
from mapmerge_ros.io import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OURS, PAPER, PROCRUSTES = '#0b6e4f', '#c44536', '#e09f3e'
FULL, SINGLE, NEUTRAL = '#1d3557', '#7d8597', '#ced4da'

DPI = 100
"""A figure 9 inches wide stays below 100 kB and fills a page."""


def new_figure(columns: int = 1, width: float = 9.0, height: float = 4.0) -> Figure:
    """
    Empty figure with `columns` axes side by side [inch].

    Raises
    ------
    ExperimentError
        matplotlib is not installed.

    """
    require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, layout='constrained')
    figure.subplots(1, columns)
    for axes in figure.axes:
        axes.spines[['top', 'right']].set_visible(False)
        axes.grid(alpha=0.25)
    return figure


def require_matplotlib() -> None:
    """Say what to install before the long work, not after."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as err:
        raise ExperimentError(
            'figures need matplotlib: pip install mapmerge_ros[experiments]'
        ) from err


def label(axes: Axes, x: str, y: str, title: str = '') -> None:
    """Name the axes, show the legend if there is something to tell apart."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title, loc='left', fontsize='medium')
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize='small')


def save(figure: Figure, path: Path) -> None:
    """
    Write a PNG, the same bytes for the same figure.

    Raises
    ------
    OutputError
        It cannot be written.

    """
    with replacing(path) as stream:
        figure.savefig(stream, format='png', metadata={'Software': None})
