# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The joint merge made fast: stacked sub-maps, fronts over the map graph (docs/algorithm.md)."""
