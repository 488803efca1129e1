# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fusion side's request to one robot: compress these landmarks and send them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Ids, frozen
from mapmerge_ros.errors import InvalidValue


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """Landmarks of one sub-map that the fusion side wants compressed."""

    map_id: str
    robot_id: str
    revision: int
    """Of the catalogue that was matched"""
    landmark_ids: Ids
    """(k,) the sub-map's own ids, most wanted first, unique"""
    max_bytes: int = 0
    """Upper limit of the answer; landmarks are dropped from the end to keep it; 0 = none"""
    frame_id: str = ''
    """Of the sub-map that is asked"""

    def __post_init__(self) -> None:
        ids = frozen('landmark_ids', self.landmark_ids, np.uint64, (None,))
        object.__setattr__(self, 'landmark_ids', ids)
        if not self.map_id:
            raise InvalidValue('map_id: empty')
        if self.revision < 0:
            raise InvalidValue(f'revision: {self.revision} is negative')
        if self.max_bytes < 0:
            raise InvalidValue(f'max_bytes: {self.max_bytes} is negative')
        if not len(ids):
            raise InvalidValue('landmark_ids: empty, nothing is asked for')
        if len(np.unique(ids)) != len(ids):
            raise InvalidValue('landmark_ids: an id appears twice')
