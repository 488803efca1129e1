# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of what a fusion keeps waiting, with a job that is seen through."""

import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))

from waiting import waits_s


def test_waits_are_all_of_the_time_that_a_job_takes():
    done = []

    def job():
        time.sleep(0.05)
        done.append(True)

    took_s, waits = waits_s(job)
    assert done
    assert took_s >= 0.05
    assert sum(waits) == pytest.approx(took_s, rel=0.5)
    assert min(waits) > 0.0
