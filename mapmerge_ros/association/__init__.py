# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks of which sub-maps are one point, from descriptors and geometry alone."""
