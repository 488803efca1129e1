# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line `mapmerge`: every command parses, loads, calls and saves."""
