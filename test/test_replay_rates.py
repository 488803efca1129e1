# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A replay gives the same summary at any rate, whether it is stopped on the way or not."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import random_bundle

from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.io import write_submaps

S = 1_000_000_000
SPAN_S = 2.0
"""Between the first message and the last: as long as a replay at rate 1 takes at least"""


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four robots, twice each: about every quarter of a second there is something new."""
    path, rows = tmp_path_factory.mktemp('bag') / 'site.mcap', []
    for k in range(8):
        bundle = random_bundle(0, points=40, noise_px=0.0)
        rng = np.random.default_rng(k)
        noisy = bundle.observations_px + 0.3 * rng.normal(size=bundle.observations_px.shape)
        own = replace(bundle, observations_px=noisy).transformed(
            Similarity.exp(rng.normal(size=7))
        )
        name = MapName(f'd{k % 4}/0', f'd{k % 4}', 1 + k // 4, k * S, id_space='site')
        at_ns = int(k * SPAN_S / 7 * S)
        rows.append((f'/d{k % 4}/submap', at_ns, compress(own, name, own.point_ids[:20])))
    write_submaps(path, rows)
    return path


def summary(bag: Path, out: Path, rate: str, is_paused: bool) -> dict[str, Any]:
    """Summary of a replay in a process of its own, without its times."""
    command = [sys.executable, '-m', 'mapmerge_ros.cli.main', 'replay', str(bag)]
    command += ['--out', str(out), '--rate', rate, '--merge-period', '0.3']
    start_s = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ) as process:
        while is_paused and process.poll() is None:
            time.sleep(0.2)
            process.send_signal(signal.SIGSTOP)
            time.sleep(0.2)
            process.send_signal(signal.SIGCONT)
        assert process.wait(60) == 0
    if rate == '1':
        assert time.monotonic() - start_s > SPAN_S
    found: dict[str, Any] = json.loads((out / 'summary.json').read_text())
    del found['timing_s']
    return found


def test_rate_and_pauses_change_nothing(bag: Path, tmp_path: Path) -> None:
    found = [
        summary(bag, tmp_path / f'{rate}_{is_paused}', rate, is_paused)
        for rate in ('1', '10', 'max')
        for is_paused in (False, True)
    ]
    assert [item['revision'] for item in found[0]['sub_maps']] == [2, 2, 2, 2]
    assert found[0]['messages'] == {'accepted': 8, 'refused': []}
    assert all(other == found[0] for other in found[1:])
