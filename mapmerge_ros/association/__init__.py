# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks of which sub-maps are one point, from descriptors and geometry alone."""

from mapmerge_ros.association.align_pair import match_pair
from mapmerge_ros.association.associate import Correspondences, associate
from mapmerge_ros.association.by_id import number_by_id
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.memory import Memory
from mapmerge_ros.association.nearest import Candidates, nearest
from mapmerge_ros.association.pair import Decision, Evidence, PairMatch
from mapmerge_ros.association.screening import likeness, screen
from mapmerge_ros.association.signature import Signature, signature

__all__ = [
    'AssociationConfig',
    'Candidates',
    'Correspondences',
    'Decision',
    'Evidence',
    'Memory',
    'PairMatch',
    'Signature',
    'associate',
    'likeness',
    'match_pair',
    'nearest',
    'number_by_id',
    'screen',
    'signature',
]
