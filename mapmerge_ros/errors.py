# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The root of every error that a user can cause; each room derives its own."""

from __future__ import annotations


class MapMergeError(Exception):
    """A known failure with a one-line message; anything else is a bug."""


class InvalidValue(MapMergeError):
    """A value from outside breaks its contract; the message names the field."""


class DegenerateGeometry(MapMergeError):
    """The points do not determine what was asked for."""
