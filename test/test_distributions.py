# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tails and densities against `scipy.stats`, far into the tails; and that nobody imports that."""

import subprocess
import sys

import numpy as np
import pytest
import scipy.stats

from mapmerge_ros.association.repetition import _ranks
from mapmerge_ros.distributions import (
    PriceLaw,
    binomial_tail,
    chi2_quantile,
    chi2_tail,
    f_log_density,
    f_log_distribution,
    f_tail,
    product_tail,
    tail,
)

VALUES = np.array([-1.0, 0.0, 1e-6, 0.3, 1.0, 7.0, 40.0, 300.0, np.inf, np.nan])


@pytest.mark.parametrize('dof', [1, 2, 3, 46, 3000])
def test_tails_are_those_of_scipy_stats(dof: int) -> None:
    np.testing.assert_allclose(chi2_tail(VALUES, dof), scipy.stats.chi2.sf(VALUES, dof), 1e-12)
    np.testing.assert_array_equal(tail(VALUES, dof, np.inf), chi2_tail(VALUES, dof))
    for freedom in (0.5, 4.0, 20.0, 1e5):
        exact = scipy.stats.f.sf(VALUES, dof, freedom)
        np.testing.assert_allclose(f_tail(VALUES, dof, freedom), exact, 1e-12)
        np.testing.assert_allclose(tail(dof * VALUES, dof, freedom), exact, 1e-9)


@pytest.mark.parametrize(('p', 'q'), [(0.3, 0.9), (1e-4, 1.0), (0.02, 0.03), (1e-200, 1e-200)])
def test_two_p_values_are_combined_as_fisher_did(p: float, q: float) -> None:
    exact = scipy.stats.combine_pvalues([p, q], method='fisher').pvalue
    assert product_tail(p * q) == pytest.approx(exact, rel=1e-9, abs=1e-300)
    assert product_tail(1.0) == 1.0
    assert product_tail(0.0) == 0.0


def test_nothing_is_probable_without_a_degree_of_freedom() -> None:
    assert np.isnan(chi2_tail(1.0, np.array([0.0, -1.0]))).all()
    assert np.isnan(f_tail(1.0, np.array([0.0, -1.0]), 5.0)).all()


def test_quantile_is_where_the_tail_is() -> None:
    for share in (0.5, 1e-3, 1e-12):
        assert chi2_tail(chi2_quantile(share, 3), 3) == pytest.approx(share, rel=1e-9)


@pytest.mark.parametrize(('count', 'share'), [(1, 0.5), (30, 0.01), (5000, 0.001)])
def test_binomial_tail(count: int, share: float) -> None:
    for hits in sorted({0, 1, count // 2, count}):
        exact = scipy.stats.binom.sf(hits - 1, count, share)
        assert binomial_tail(hits, count, share) == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize('freedom', [2.5, 30.0, 400.0])
def test_likelihood_of_an_f_distribution(freedom: float) -> None:
    values, law = VALUES[2:8], scipy.stats.f(3, freedom)
    np.testing.assert_allclose(f_log_density(values, 3, freedom), law.logpdf(values), 1e-11)
    # Older SciPy has no digits here where nearly everything is below.
    found = f_log_distribution(values, 3, freedom)
    np.testing.assert_allclose(found, law.logcdf(values), 1e-11, 2e-16)
    assert f_log_distribution(np.inf, 3, freedom) == 0.0


@pytest.mark.parametrize('dof', [1, 2, 3, 46])
@pytest.mark.parametrize('redundancy', [5.0, 60.0, np.inf])
def test_price_law(dof: int, redundancy: float) -> None:
    law = PriceLaw(dof, redundancy)
    known = np.isinf(redundancy)
    exact = scipy.stats.chi2(dof) if known else scipy.stats.f(dof, redundancy, scale=dof)
    assert law.mean == pytest.approx(exact.mean())
    assert law.std == pytest.approx(exact.std())
    np.testing.assert_allclose(law.density(VALUES[2:8]), exact.pdf(VALUES[2:8]), 1e-10)


def test_ranks_share_the_mean_of_equal_values() -> None:
    values = np.random.default_rng(3).integers(0, 20, 100) / 7.0
    np.testing.assert_array_equal(_ranks(values), scipy.stats.rankdata(values))


@pytest.mark.parametrize('module', ['mapmerge_ros.cli.replay', 'mapmerge_ros.fusion.engine'])
def test_a_command_does_not_wait_for_scipy_stats(module: str) -> None:
    found = subprocess.run(
        [sys.executable, '-c', f'import sys, {module}; print("scipy.stats" in sys.modules)'],
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout.strip() == 'False'
