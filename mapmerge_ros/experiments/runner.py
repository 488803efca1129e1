# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Runs of an experiment over processes; the number of processes leaves no trace."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np
from threadpoolctl import threadpool_limits

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.experiments.result import Experiment, ExperimentError, Failure, Results, Values

Outcome: TypeAlias = tuple[int, Values | Failure]
Progress: TypeAlias = Callable[[Iterable[Outcome]], Iterable[Outcome]]


def run_experiment(
    experiment: Experiment,
    *,
    runs: int | None = None,
    seed: int = 0,
    jobs: int = 1,
    progress: Progress = iter,
) -> Results:
    """
    Run an experiment; an interrupt (SIGINT) ends it early, with what there is.

    `progress` is given the outcomes as they come and hands them on.

    Raises
    ------
    ExperimentError
        Not a single run ended well, or a process died.

    """
    asked = experiment.runs if runs is None else runs
    if asked < 1:
        raise ExperimentError(f'runs: {asked} is below 1')
    if jobs < 1:
        raise ExperimentError(f'jobs: {jobs} is below 1')
    outcomes: dict[int, Values | Failure] = {}
    try:
        for run, outcome in progress(_outcomes(experiment, asked, seed, min(jobs, asked))):
            outcomes[run] = outcome
    except KeyboardInterrupt:
        if not outcomes:
            raise
    ordered = [outcomes[run] for run in sorted(outcomes)]
    failures = tuple(outcome for outcome in ordered if isinstance(outcome, Failure))
    values = tuple(outcome for outcome in ordered if not isinstance(outcome, Failure))
    if not values:
        reason = failures[0].reason
        raise ExperimentError(f'{experiment.name}: all {len(failures)} runs failed: {reason}')
    return Results(asked, seed, values, failures)


def _outcomes(experiment: Experiment, runs: int, seed: int, jobs: int) -> Iterator[Outcome]:
    if jobs == 1:
        yield from (_run(experiment.run_one, seed, run) for run in range(runs))
        return
    # A forked child would share locks with threads that it does not have.
    context = multiprocessing.get_context('spawn')
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker)
    try:
        with _interrupts_held():
            tasks = [pool.submit(_run, experiment.run_one, seed, run) for run in range(jobs)]
        tasks += [pool.submit(_run, experiment.run_one, seed, run) for run in range(jobs, runs)]
        finished = as_completed(tasks)
        while True:
            # An interrupt amid the locks of the pool could leave one taken: it waits for a result.
            with _interrupts_held():
                task = next(finished, None)
            if task is None:
                break
            yield task.result()
    except BrokenProcessPool as err:
        raise ExperimentError(
            f'{experiment.name}: a process died, out of memory perhaps: fewer --jobs need less'
        ) from err
    except BaseException:
        for worker in set(multiprocessing.active_children()) - others:
            worker.kill()  # they write nothing; to SIGTERM, Ceres answers with a stack trace
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """
    Processes that are started in the block never see SIGINT; this one sees it afterwards.

    The terminal sends it to all processes; the first one decides what to do.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker() -> None:
    os.environ['OMP_NUM_THREADS'] = '1'


def _run(run_one: Callable[[int, int], Values], seed: int, run: int) -> Outcome:
    # Also for determinism: sums over two threads are not those over one.
    with threadpool_limits(1):
        try:
            return run, {name: plain(value) for name, value in run_one(seed, run).items()}
        except MapMergeError as err:
            return run, Failure(run, str(err))


def plain(value: Any) -> Any:
    """Return arrays, numpy scalars and tuples as what JSON has."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value
