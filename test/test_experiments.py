# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The experiments: their frame with a cheap one, and each of the paper's with a few runs."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from mapmerge_ros.cli import experiment as command
from mapmerge_ros.cli.main import main
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.experiments import (
    Check,
    Experiment,
    ExperimentError,
    Summary,
    Table,
    run_experiment,
)
from mapmerge_ros.experiments.baselines import procrustes_average, rmse_to
from mapmerge_ros.experiments.catalogue import EXPERIMENTS
from mapmerge_ros.experiments.report import results_json, results_markdown, write_results
from mapmerge_ros.geometry import Similarity

pytest.importorskip('pycolmap')
figure_module = pytest.importorskip('matplotlib.figure')


def draw_number(seed, run):
    """Stand-in for an experiment; run 2 fails as a known error does."""
    if run == 2:
        raise DegenerateGeometry('on a line')
    return {'number': np.random.default_rng([seed, run]).random(), 'nothing': np.nan}


def interrupt_at_three(seed, run):
    if run == 3:
        raise KeyboardInterrupt
    return {'number': float(run)}


def fail(seed, run):
    raise DegenerateGeometry('on a line')


def die(seed, run):
    os._exit(1)


def summarise(results):
    mean = results.column('number').mean()
    table = Table('Mean', ('of', '#value'), (('a|b', f'{mean:.3f}'),))
    return Summary((table,), (Check('it is small', '< 1', f'{mean:.3f}', mean < 1.0),))


def empty_figure(results):
    return figure_module.Figure()


CHEAP = Experiment('cheap', 'A cheap one', 5, draw_number, summarise, empty_figure)


def test_results_do_not_depend_on_the_number_of_processes():
    one, two = (run_experiment(CHEAP, seed=7, jobs=jobs) for jobs in (1, 2))
    assert [v['number'] for v in one.values] == [v['number'] for v in two.values]
    assert one.failures == two.failures
    other = run_experiment(CHEAP, seed=8)
    assert other.values[0]['number'] != one.values[0]['number']


def test_a_run_that_fails_counts_as_ended_and_as_not_held():
    results = run_experiment(CHEAP)
    assert results.complete
    assert [(f.run, f.reason) for f in results.failures] == [(2, 'on a line')]
    assert results.share(np.ones(4, bool)) == pytest.approx(0.8)


def test_an_interrupted_run_keeps_what_it_has_and_says_so():
    results = run_experiment(replace(CHEAP, run_one=interrupt_at_three))
    assert [v['number'] for v in results.values] == [0.0, 1.0, 2.0]
    assert not results.complete
    content = json.loads(results_json(CHEAP, results, summarise(results)))
    assert content['complete'] is False
    assert content['runs'] == 5
    assert 'INCOMPLETE: 3 of 5' in results_markdown(CHEAP, results, summarise(results))


def test_json_is_strict_and_markdown_escapes(tmp_path):
    results = run_experiment(CHEAP)
    paths = write_results(tmp_path, CHEAP, results, summarise(results))
    assert [path.name for path in paths] == ['cheap.json', 'cheap.md', 'cheap.png']
    content = json.loads(paths[0].read_text())
    assert content['results'][0]['nothing'] is None
    assert content['summary']['checks'][0]['holds'] is True
    assert r'a\|b' in paths[1].read_text()
    assert paths[2].read_bytes().startswith(b'\x89PNG')


@pytest.mark.parametrize(
    'run_one, jobs, words', [(fail, 1, 'all 5 runs failed: on a line'), (die, 2, 'process died')]
)
def test_nothing_to_show_is_one_error(run_one, jobs, words):
    with pytest.raises(ExperimentError, match=words):
        run_experiment(replace(CHEAP, run_one=run_one), jobs=jobs)


@pytest.mark.parametrize('asked', [{'runs': 0}, {'jobs': 0}])
def test_zero_is_refused(asked):
    with pytest.raises(ExperimentError, match='is below 1'):
        run_experiment(CHEAP, **asked)


RUNS = {'gamma': 3, 'early-stop': 1, 'loop-closure': 2}


@pytest.mark.parametrize('name', RUNS)
def test_experiments_of_the_paper(name, tmp_path, capsys):
    arguments = ['experiment', name, '--runs', str(RUNS[name]), '--jobs', '1']
    assert main([*arguments, '--out', str(tmp_path)]) == 0
    assert 'holds' in capsys.readouterr().out
    content = json.loads((tmp_path / f'{name}.json').read_text())
    assert content['complete']
    assert len(content['results']) == RUNS[name]
    assert not content['failures']
    assert (tmp_path / f'{name}.png').stat().st_size < 100_000


def test_merging_maps_that_were_stopped_early_equals_the_full_bundle():
    values = EXPERIMENTS['early-stop'].run_one(3, 0)
    ours, paper = np.array(values['ours']), np.array(values['paper'])
    near = np.array(values['single']) <= 3.0 * values['converged']
    assert near.sum() >= 5
    # 30 of 100 landmarks are merged, the full bundle has them all: equal in the mean only.
    assert (ours[near] <= 1.05 * values['full']).all()
    assert (ours[near] <= 1.01 * ours[-1]).all()
    assert ours[0] < 0.3 * paper[0]


def test_the_loop_closes_as_well_as_in_the_full_bundle():
    values = EXPERIMENTS['loop-closure'].run_one(0, 0)
    assert values['wide_accepted']
    assert values['wide_to_full'] < 0.1 * values['wide_full']
    assert values['wide_ours'] < values['wide_open']
    sizes = values['wide_sizes']
    assert sizes[0][1:] == [sizes[0][1], 660, 23, 30]
    assert sizes[-1][3:] == [92, 60]


def test_procrustes_recovers_what_has_no_noise():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3))
    ids = [np.arange(12, dtype=np.uint64), np.arange(7, 20, dtype=np.uint64)]
    frames = [Similarity.exp(rng.normal(size=7)) for _ in ids]
    maps = [frame.apply(points[own.astype(int)]) for frame, own in zip(frames, ids, strict=True)]
    every, found = procrustes_average(ids, maps)
    assert every.tolist() == list(range(20))
    assert rmse_to(points, found) < 1e-12


def test_list(capsys):
    with pytest.raises(SystemExit) as stop:
        main(['experiment', '--list'])
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in EXPERIMENTS)


WRONG = (['nonsense'], ['gamma', '--runs=0'], ['gamma', '--runs=-1'], ['gamma', '--jobs=0'])


@pytest.mark.parametrize('arguments', WRONG)
def test_wrong_usage_is_one_line(arguments, capsys):
    assert main(['experiment', *arguments]) == 2
    assert capsys.readouterr().err.count('\n') == 1


def test_a_folder_that_cannot_be_written(tmp_path, capsys):
    (tmp_path / 'file').write_text('')
    assert main(['experiment', 'gamma', '--runs', '1', '--out', str(tmp_path / 'file')]) == 1
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    assert str(tmp_path / 'file') in error


def test_matplotlib_is_asked_for_before_the_work(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    monkeypatch.setattr(command, 'run_experiment', pytest.fail)
    assert main(['experiment', 'gamma', '--runs', '1', '--out', str(tmp_path)]) == 1
    assert 'pip install' in capsys.readouterr().err


def test_an_interrupted_command_says_where_the_rest_is(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(EXPERIMENTS, 'gamma', replace(CHEAP, run_one=interrupt_at_three))
    assert main(['experiment', 'gamma', '--jobs', '1', '--out', str(tmp_path)]) == 130
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    assert '3 of 5 runs' in error
    assert json.loads((tmp_path / 'cheap.json').read_text())['complete'] is False


SCRIPT = """
import signal
import sys
from mapmerge_ros.cli import console, main

# A shell starts what runs in the background with interrupts ignored, tests among it.
signal.signal(signal.SIGINT, signal.default_int_handler)

def tell(outcomes, *_):
    for outcome in outcomes:
        yield outcome
        print('taken', flush=True)  # the first one is in the results by now

console.progress = tell
sys.exit(main.main(sys.argv[1:]))
"""


def test_an_interrupt_of_all_processes_is_one_line(tmp_path):
    arguments = ['gamma', '--runs', '10000', '--jobs', '2', '--out', str(tmp_path)]
    process = subprocess.Popen(
        [sys.executable, '-c', SCRIPT, 'experiment', *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout.readline() == 'taken\n'
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert errors.count('\n') == 1
    assert 'marked as incomplete' in errors
    assert json.loads((tmp_path / 'gamma.json').read_text())['complete'] is False
