# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The test of the paper: of a merge as a whole, with all that moved in it."""

from mapmerge_ros.fusion import FusionConfig

WHOLE_MAP = FusionConfig(unlock=False)
