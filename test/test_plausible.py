# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What has to be believed of maps for their merge, all of it together."""

import sys
from pathlib import Path

import numpy as np
import pytest

from mapmerge_ros.distributions import chi2_quantile, product_tail
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.fusion.plausible import (
    HONEST_ASIDE,
    HONEST_OMEGA_RADII,
    HONEST_PHI,
    MAX_OMEGA_RADII,
    MAX_PHI,
    p_plausible,
)

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / 'shared' / 'data'
REFUSED = 7.5e-4
"""Below it Fisher's product with a price of p = 0.5, thrice the least of three tests, refuses."""


@pytest.mark.parametrize(('price', 'refused'), [(0.5, REFUSED), (1.0, REFUSED / 2.0)])
def test_the_limit_is_that_of_the_usual_level(price: float, refused: float) -> None:
    """And so are the sums of squares that `plausible` and the documents tell."""
    level = FusionConfig().significance
    assert 3.0 * product_tail(price * refused) == pytest.approx(level, rel=0.01)
    assert chi2_quantile(refused, 3) == pytest.approx({0.5: 16.9, 1.0: 18.3}[price], abs=0.05)


def test_usual_errors_and_smaller_ones_are_plausible() -> None:
    assert p_plausible(HONEST_PHI, HONEST_OMEGA_RADII, 20, 200) == 1.0
    assert p_plausible(0.0, 0.0, 0, 200) == 1.0
    assert p_plausible(1.0, 0.0, 0, 0) > 0.5  # what the textbook believes


def test_each_error_makes_it_less_plausible_and_none_makes_up_for_another() -> None:
    rng = np.random.default_rng(4)
    for _ in range(200):
        phi, omega = rng.uniform(0.1, MAX_PHI), rng.uniform(0.0, MAX_OMEGA_RADII)
        count = int(rng.integers(20, 600))
        aside = int(rng.integers(0, count // 4))
        here = p_plausible(phi, omega, aside, count)
        assert p_plausible(1.1 * phi, omega, aside, count) <= here
        assert p_plausible(phi, 1.1 * omega, aside, count) <= here
        assert p_plausible(phi, omega, aside + 1, count) <= here
        alone = p_plausible(phi, 0.0, 0, count)
        assert here <= alone + 1e-12


def test_what_one_error_may_be_two_may_not() -> None:
    assert p_plausible(MAX_PHI, 0.0, 0, 200) > REFUSED
    assert p_plausible(0.5, MAX_OMEGA_RADII, 20, 200) > REFUSED
    assert p_plausible(MAX_PHI, MAX_OMEGA_RADII, 40, 200) < REFUSED


def test_of_few_landmarks_more_may_be_aside_by_chance() -> None:
    share = 2.0 * HONEST_ASIDE
    values = [p_plausible(0.7, 1e-3, int(share * n), n) for n in (20, 50, 100, 200, 400)]
    assert values == sorted(values, reverse=True)
    assert values[0] > 0.5
    assert p_plausible(0.7, 1e-3, int(0.24 * 400), 400) < REFUSED


@pytest.mark.parametrize('budget', [24, 50, 150, 250])
@pytest.mark.parametrize('name', ['boruszyn_kite', 'caliterra_drone', 'bal_ladybug49'])
def test_unchanged_maps_are_believed_however_many_landmarks_they_send(
    name: str, budget: int
) -> None:
    """Of Boruszyn 7 in 12 were refused when 15 % aside were too many, and 2 had moved objects."""
    if not (DATA / name).is_dir():
        pytest.skip(f'{DATA / name} is not there: real data is not shipped')
    pytest.importorskip('pycolmap', reason='COLMAP models are read by pycolmap')
    sys.path.insert(0, str(ROOT / 'benchmarks'))
    from real_data import compress_sessions

    from mapmerge_ros.fusion import fuse

    fusion = fuse(compress_sessions(DATA / name, budget)[0])
    assert fusion.verdict.accepted
    assert fusion.verdict.moved == 0
    assert len(fusion.components[0].map_ids) == len(fusion.alignments)
