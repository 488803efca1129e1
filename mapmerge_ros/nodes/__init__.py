# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS nodes: convert → engine → convert → publish. The only room that knows rclpy."""
