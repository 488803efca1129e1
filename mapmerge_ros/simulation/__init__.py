# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated robots with truth: scenes, drones, their maps, and the full bundle to compare with."""

from mapmerge_ros.simulation.adjust import Adjustment, AdjustmentError, BehindCamera, adjust, solve
from mapmerge_ros.simulation.announcement import announcement
from mapmerge_ros.simulation.drones import Camera, Sensing, fly, observe
from mapmerge_ros.simulation.fleet import Fleet, FleetConfig, Truth, simulate_fleet
from mapmerge_ros.simulation.frames import anchored, frame_error, random_frame
from mapmerge_ros.simulation.joint import join, joint_bundle
from mapmerge_ros.simulation.moved import MovedObject, TemporaryObject
from mapmerge_ros.simulation.paper import box_truth, measured, paper_box
from mapmerge_ros.simulation.scene import Scene, box_scene, room_scene, yard_scene
from mapmerge_ros.simulation.session import Session, SimulationError, measure
from mapmerge_ros.simulation.street import Street, StreetConfig, simulate_street
from mapmerge_ros.simulation.trajectory import Trajectory, all_around, arc, lawn_mower, look_at

__all__ = [
    'Adjustment',
    'AdjustmentError',
    'BehindCamera',
    'Camera',
    'Fleet',
    'FleetConfig',
    'MovedObject',
    'Scene',
    'Sensing',
    'Session',
    'SimulationError',
    'Street',
    'StreetConfig',
    'TemporaryObject',
    'Trajectory',
    'Truth',
    'adjust',
    'all_around',
    'anchored',
    'announcement',
    'arc',
    'box_scene',
    'box_truth',
    'fly',
    'frame_error',
    'join',
    'joint_bundle',
    'lawn_mower',
    'look_at',
    'measure',
    'measured',
    'observe',
    'paper_box',
    'random_frame',
    'room_scene',
    'simulate_fleet',
    'simulate_street',
    'solve',
    'yard_scene',
]
