# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How long steps with one matrix are trusted, before another one is made."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Trust:
    """What is known beforehand of the steps that a matrix makes."""

    worth: float
    """Steps that cost as much as a factorisation"""
    patience: int
    """Steps before it is asked how they get on"""
    overshoot: float
    """By how many times its promise a step may raise the cost"""
