# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The experiments of the paper and ours: reproducible by seed, with figures, tables and checks."""

from mapmerge_ros.experiments.result import (
    Check,
    Experiment,
    ExperimentError,
    Failure,
    Results,
    Summary,
    Table,
    Values,
)
from mapmerge_ros.experiments.runner import run_experiment

__all__ = [
    'Check',
    'Experiment',
    'ExperimentError',
    'Failure',
    'Results',
    'Summary',
    'Table',
    'Values',
    'run_experiment',
]
