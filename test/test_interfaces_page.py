# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of all topics, services and parameters is what the running nodes have today."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from ros_processes import rclpy

from mapmerge_ros.nodes.frames import MISSING, TFMessage

DOCS = Path(__file__).parents[1] / 'docs'


@pytest.mark.skipif(TFMessage is None, reason=MISSING)
def test_the_page_is_that_of_the_running_nodes() -> None:
    assert not rclpy.ok()
    code = 'import generate_interfaces as made; print(made.page(), end="")'
    paths = [str(DOCS), str(DOCS.parent), *filter(None, [os.environ.get('PYTHONPATH')])]
    done = subprocess.run(
        [sys.executable, '-c', code],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    made = done.stdout[done.stdout.index('<!--') :]
    assert made == (DOCS / 'interfaces.md').read_text(), 'make interfaces, and commit the page'
