# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What third maps say about a link: both of its landmarks have the same partner there, or not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.sparse

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.second_look import Links

Pair = tuple[int, int]


def supported(
    links: Mapping[Pair, Links], sizes: Sequence[int], config: AssociationConfig
) -> dict[Pair, Links]:
    """
    Links with posteriors after third maps have been heard; `sizes` are the maps' landmarks.

    Those far below any threshold are left out.
    """
    likely = {pair: own.above(config.min_posterior_heard) for pair, own in links.items()}
    tables: dict[Pair, scipy.sparse.csr_array] = {}
    for (a, b), own in likely.items():
        shape = sizes[a], sizes[b]
        table = scipy.sparse.csr_array((own.posteriors, (own.of_a, own.of_b)), shape=shape)
        tables[a, b], tables[b, a] = table, table.T.tocsr()
    partners: dict[int, set[int]] = {}
    for a, b in tables:
        partners.setdefault(a, set()).add(b)
    return {
        (a, b): _heard(own, tables, (a, b), sorted(partners[a] & partners[b]), config)
        for (a, b), own in likely.items()
    }


def _heard(
    links: Links,
    tables: Mapping[Pair, scipy.sparse.csr_array],
    pair: Pair,
    thirds: Sequence[int],
    config: AssociationConfig,
) -> Links:
    log_odds = np.zeros(len(links))
    for third in thirds:
        of_a = tables[pair[0], third][links.of_a]
        of_b = tables[pair[1], third][links.of_b]
        agreeing: Floats = np.asarray((of_a * of_b).sum(axis=1)).ravel()
        both = _total(of_a) * _total(of_b)
        log_odds += config.agreement * agreeing
        log_odds -= config.contradiction * np.maximum(both - agreeing, 0.0)
    changed: Mask = log_odds != 0.0
    factor = np.exp(log_odds[changed])
    posteriors = links.posteriors.copy()
    odds = posteriors[changed] * factor
    posteriors[changed] = odds / (odds + 1.0 - posteriors[changed])
    return Links(links.of_a, links.of_b, posteriors)


def _total(rows: scipy.sparse.csr_array) -> Floats:
    """Probability (n,) that a landmark has a partner in the third map at all."""
    return np.minimum(np.asarray(rows.sum(axis=1)).ravel(), 1.0)
