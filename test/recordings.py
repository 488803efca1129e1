# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings to read: the same sub-maps in every kind of file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from submaps import random_submap

from mapmerge_ros.io import (
    encode_submap,
)
from mapmerge_ros.io.typestore import SUBMAP, typestore
from mapmerge_ros.submap import SubMap

START_NS = 1_700_000_000_000_000_000

Entry = tuple[str, int, SubMap]


def entries(seed: int, count: int = 8) -> list[Entry]:
    rng = np.random.default_rng(seed)
    return [
        (f'/drone{i % 3}/submap', START_NS + 10**9 * i, random_submap(rng)) for i in range(count)
    ]


def rosbag2_folder(path: Path, recorded: list[Entry], storage: StoragePlugin, **mode: Any) -> Path:
    bag_writer = BagWriter(path, version=9, storage_plugin=storage)
    if mode:
        bag_writer.set_compression(**mode)
    with bag_writer as writer:
        topics = {
            topic: writer.add_connection(topic, SUBMAP, typestore=typestore())
            for topic in sorted({topic for topic, _, _ in recorded})
        }
        for topic, log_time_ns, submap in recorded:
            writer.write(topics[topic], log_time_ns, encode_submap(submap))
    return path
