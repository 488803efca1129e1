# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a fusion found, in sentences."""

from __future__ import annotations

from mapmerge_ros.fusion import Fusion, MapAlignment, State, Verdict
from mapmerge_ros.io.comparison import TruthComparison
from mapmerge_ros.io.moved_objects import moved_objects

MOST_NOTED = 2
"""Sub-maps whose oddities are written out in one sentence."""


def headline(fusion: Fusion) -> str:
    """Say what was merged."""
    merged, total = len(fusion.in_state(State.MERGED)), len(fusion.alignments)
    if not merged:
        if total == 1:
            return 'Nothing to merge yet: there is only one sub-map.'
        which = 'the two' if total == 2 else f'no two of the {total}'
        return f'Nothing was merged: {which} sub-maps could {"not " * (total == 2)}be joined.'
    count = len(fusion.components[0].landmarks.ids)
    everyone = 'Both' if total == 2 else f'All {total}'
    which = everyone if merged == total else f'{merged} of {total}'
    return f'{which} sub-maps were merged into one map of {count} landmarks.'


def belief(verdict: Verdict) -> str:
    """Say whether the test believes the merge."""
    if not verdict.dof:
        return 'There is nothing to test: no landmark is held by more than one sub-map.'
    if not verdict.accepted:
        return f'The test does not believe it: {verdict.reason}.'
    price = f'the merge costs {verdict.variance_factor:.2f} times what noise of '
    price += f'{verdict.sigma:.3g} px explains'
    if verdict.errors is not None:
        price += (
            f', as it does for maps with {verdict.errors.phi:.2g} times the claimed variances, a '
            f'warp of {verdict.errors.omega_ratio:.2%} of the scene, and bad tracks'
        )
    return f'The test believes it: {price} (p = {verdict.p_value:.2g}).'


def without_parallax(count: int) -> str:
    """Say how many landmarks of a bundle nothing determines."""
    return f'{counted(count, "landmark")} left out: no parallax says how far'


def what_moved(fusion: Fusion) -> str:
    """Say what was found to be elsewhere; empty if nothing was."""
    taken_out = [change for change in fusion.changes if not change.merged]
    doubtful = sum(not change.object_id for change in taken_out)
    merged = len(fusion.changes) - len(taken_out)
    parts = [
        f'{counted(each.count, "landmark")} of {each.map_id} moved together by {each.distance:.3g}'
        for each in moved_objects(taken_out)
    ]
    if doubtful:
        parts.append(f'{counted(doubtful, "landmark")} did not fit (wrong match, or moved)')
    sentences = [f'Taken out of the merge: {"; ".join(parts)}.'] if parts else []
    if merged:
        sentences.append(f'Doubtful, but merged: {counted(merged, "landmark")}.')
    return ' '.join(sentences)


def kept_out(fusion: Fusion) -> str:
    """Say which sub-maps are wrong as a whole; empty if none is."""
    names = [item.submap.map_id for item in fusion.quarantined]
    return f'Kept out, since the others contradict: {", ".join(names)}.' if names else ''


def verdict_sentences(fusion: Fusion) -> str:
    """Say what was merged, whether to believe it, and what moved."""
    if not fusion.in_state(State.MERGED):
        return headline(fusion)
    parts = (
        headline(fusion),
        kept_out(fusion),
        belief(fusion.verdict),
        what_moved(fusion),
        oddities(fusion),
    )
    return ' '.join(filter(None, parts))


def oddities(fusion: Fusion) -> str:
    """Say what is odd about sub-maps, whatever their state; empty if nothing is."""
    noted = [f'{item.submap.map_id}: {item.note}' for item in fusion.alignments if item.note]
    if len(noted) > MOST_NOTED:
        noted = [*noted[:MOST_NOTED], f'{len(noted) - MOST_NOTED} others likewise']
    return f'Look at {"; ".join(noted)}.' if noted else ''


def left_out(fusion: Fusion) -> tuple[MapAlignment, ...]:
    """Sub-maps that are not in the published map."""
    return tuple(item for item in fusion.alignments if item.state is not State.MERGED)


def against_truth(found: TruthComparison) -> str:
    """Say how far the map is from the truth."""
    share = found.median_error / found.radius
    return (
        f'Against the truth: {found.count} shared landmarks are {found.median_error:.3g} m off '
        f'(median; {share:.2%} of the scene), root mean square {found.rmse:.3g} m.'
    )


def counted(count: int, noun: str) -> str:
    """Say '1 drone', '4 drones'."""
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'


def readable_bytes(count: float) -> str:
    """Bytes with a unit, as `184 kB`."""
    for unit in ('B', 'kB', 'MB'):
        if count < 1000.0:
            return f'{count:.3g} {unit}'
        count /= 1000.0
    return f'{count:.3g} GB'
