# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whole fleets: robots that come in any order, leave and begin again; two fleets at once."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from ros_processes import (
    FUSION,
    ROBOT,
    Observer,
    load,
    make_recording,
    observing,
    spin_for,
    spin_until,
)
from submaps import true_world_submaps
