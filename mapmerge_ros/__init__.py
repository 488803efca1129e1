# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Merge compressed visual maps of several robots, with a test that says whether to believe it."""

__version__ = '0.1.0'
