# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a fusion says: of each sub-map, of the merge as a whole, and why."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints
from mapmerge_ros.association import PairMatch
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.changes import Change
from mapmerge_ros.fusion.examination import Examination
from mapmerge_ros.fusion.names import Names
from mapmerge_ros.fusion.refusal import Quarantine
from mapmerge_ros.geometry import Gauge, Similarity
from mapmerge_ros.submap import Request, SubMap


class State(IntEnum):
    """What became of a sub-map; the numbers are those of `mapmerge_msgs/Alignment`."""

    MERGED = 0
    DETACHED = 1
    REFUSED = 2


@dataclass(frozen=True, slots=True, eq=False)
class MapAlignment:
    """One sub-map after the fusion."""

    submap: SubMap
    state: State
    reason: str
    """Empty when merged"""
    component: int
    """Index into `Fusion.components`; -1 when refused"""
    S_global_map: Similarity
    """Into the frame of its component"""
    covariance: Floats
    """
    (7, 7) left tangent in the global frame, order of `Similarity.exp`; zeros = unknown.

    It is that of the frame in which the sub-map's own q° lies, not of the robot's true cameras.
    """
    quarantine: Quarantine | None = None
    """Evidence against a refused sub-map that is wrong as a whole"""
    note: str = ''
    """What is odd about it, whatever its state"""


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """What real maps have besides the noise that they claim, as fitted (docs/statistics.md)."""

    phi: float
    """Factor on the variances that the sub-maps claim"""
    tau_ratio: float
    """Ground floor of every landmark, of the scene radius"""
    omega_ratio: float
    """Smooth warp of every sub-map, of the scene radius"""
    tail_freedom: float
    """ν of F(3, ν), which single landmarks follow; inf: Gaussian"""
    price: float = float(np.nan)
    """Of merging, in units of what these errors explain: `dof` is expected"""
    dof: int = 0
    """Of that price: without the landmarks that are set aside"""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Test of the merge as a whole (section IV of the paper, and docs/statistics.md)."""

    a_tilde: float
    """ã = ā² - Σ a², px²"""
    dof: int
    sigma: float
    """Noise of one residual that the test uses, px"""
    variance_factor: float
    """ã / (dof σ²): 1 when nothing moved, matches are right and noise is Gaussian"""
    p_value: float
    """Under `errors` where a model was needed"""
    accepted: bool
    reason: str
    """Empty when accepted"""
    textbook_p_value: float = 1.0
    """As if all noise were Gaussian and of the size that the sub-maps claim"""
    errors: ErrorModel | None = None
    """None: the textbook's model is that of `p_value`"""
    set_aside: int = 0
    """Landmarks too far off to have a say in `errors` and `p_value`"""
    moved: int = 0
    """Landmarks that moved together with their neighbours; the merge still holds them equal"""
    suspect: str = ''
    """map_id of a sub-map that alone does not fit, where the rest may be believed"""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two sub-maps and the number of compressed landmarks that they share."""

    a: str
    b: str
    shared: int


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Two sub-maps that were compared by descriptors, and what came of it."""

    a: str
    b: str
    links: int
    """Landmarks that they have in common in the end, catalogues included"""
    found: PairMatch


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A landmark id that two sub-maps give to points too far apart to be one."""

    landmark_id: int
    a: str
    b: str


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Merged landmarks of a component, and which landmark of which sub-map each one is."""

    ids: Ids
    """(n,)"""
    points_global: Floats
    """(n, 3)"""
    std: Floats
    """
    (n, 3) global map units, in the gauge without preferred landmark; nan = unknown

    Where the verdict needed other errors than noise, with them.
    """
    member_rows: Ints
    """(members,) row of the landmark, ascending"""
    member_maps: tuple[str, ...]
    """(members,) map_id"""
    member_ids: Ids
    """(members,) the sub-map's own landmark id"""

    def members(self) -> list[list[tuple[str, int]]]:
        """Per landmark the (map_id, landmark_id) it consists of."""
        lists: list[list[tuple[str, int]]] = [[] for _ in self.ids]
        for row, map_id, landmark_id in zip(
            self.member_rows, self.member_maps, self.member_ids, strict=True
        ):
            lists[int(row)].append((map_id, int(landmark_id)))
        return lists


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """Sub-maps that hang together, merged into one map."""

    map_ids: tuple[str, ...]
    gauge: Gauge
    anchor: str
    """map_id of the sub-map that holds the global frame"""
    submap: SubMap
    """The merged map, compressed again"""
    landmarks: Landmarks
    verdict: Verdict
    iterations: int
    converged: bool
    starts: int
    """Starts of the merge until it was believed, or until there was no other to try"""
    cost_history: tuple[float, ...]
    association: Association
    """Tracks of its sub-maps, in the order of `map_ids`"""
    names: Names
    """Ids of their landmarks in the merged map"""
    examination: Examination | None = None
    """Single landmarks and objects, before anything was taken out; None: nothing is merged"""
    changes: tuple[Change, ...] = ()
    """What one sub-map has elsewhere than the others; it is not merged"""


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds spent in each part of a fusion."""

    associate_s: float = 0.0
    merge_s: float = 0.0
    test_s: float = 0.0
    total_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Fusion:
    """Everything that one run of the engine found."""

    components: tuple[Component, ...]
    """Largest first; the first one is published as the global map"""
    alignments: tuple[MapAlignment, ...]
    """By map_id"""
    pairs: tuple[Pair, ...]
    contradictions: tuple[Contradiction, ...] = ()
    matches: tuple[Match, ...] = ()
    """Pairs that were matched by descriptors"""
    requests: tuple[Request, ...] = ()
    """What the robots should compress to make the next merge better"""
    timing: Timing = field(default_factory=Timing)

    @property
    def global_map(self) -> SubMap | None:
        """The largest component as a sub-map, None when there is nothing to merge."""
        return self.components[0].submap if self.components else None

    @property
    def verdict(self) -> Verdict:
        """Verdict on the global map; that of an empty merge when there is none."""
        return self.components[0].verdict if self.components else EMPTY_VERDICT

    @property
    def changes(self) -> tuple[Change, ...]:
        """What was found to have moved, or not to fit, in the global map."""
        return self.components[0].changes if self.components else ()

    @property
    def quarantined(self) -> tuple[MapAlignment, ...]:
        """Refused sub-maps that are wrong as a whole, by map_id."""
        return tuple(item for item in self.alignments if item.quarantine)

    def in_state(self, state: State) -> tuple[MapAlignment, ...]:
        """Return the sub-maps in one state."""
        return tuple(item for item in self.alignments if item.state is state)


EMPTY_VERDICT = Verdict(0.0, 0, 0.0, float(np.nan), 1.0, accepted=True, reason='')
