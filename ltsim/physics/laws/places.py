"""Places at which a law may act: set-ups, instruments, targets, and groups of related targets."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from ltsim.core.arrays import Ints
from ltsim.scene.sightings import Sightings

CANDIDATE_NEIGHBOUR_GROUP_SIZES = (3, 6)
"""Numbers of nearest neighbours in the groups of targets that a diagnosis tries as places of a law (error as a function
of covariates)."""
MIN_GROUP_TARGETS = 3
"""Smallest number of targets in a group with a law (error as a function of covariates), and outside this group. A law
with a separate value for each set-up is tried only if there are more set-ups than this number."""
CLUSTERING_HEIGHT_WEIGHT = 5.0
"""Factor on heights in the clustering of targets by height and surface. A height difference of a fifth of the hall
then counts as much as an angle of 60 deg between two nest normals."""


@dataclass(frozen=True)
class LawPlace:
    """Place at which a law (function of covariates) acts: set-ups, targets or instruments, with the pointings there."""

    stations: tuple[str, ...]
    """Names of the set-ups at which the law (error as a function of covariates) acts; empty for all."""
    targets: tuple[str, ...]
    """Names of the targets at which the law (error as a function of covariates) acts; empty for all."""
    rows: Ints
    """Row indices of the pointings from these set-ups, to these targets and with these instruments."""
    instruments: tuple[str, ...] = ()
    """Names of the instruments of the law (error as a function of covariates); empty for all."""


def names_and_rows(names: Sequence[str], group_indices: Ints) -> Iterator[tuple[str, Ints]]:
    """Pairs of a name (of a station or target) and the row indices of its pointings, for each name with pointings.

    `group_indices` (n,) is the index in `names` of each of n pointings.
    """
    name_and_rows = ((name, np.flatnonzero(group_indices == i)) for i, name in enumerate(names))
    return (pair for pair in name_and_rows if len(pair[1]))


def station_names_of_rows(sightings: Sightings, rows: Ints) -> tuple[str, ...]:
    """Names of the set-ups of the pointings with the row indices `rows`."""
    return tuple(sightings.station_names[k] for k in np.unique(sightings.station[rows]))


def instrument_places(sightings: Sightings, names: Sequence[str]) -> tuple[LawPlace, ...]:
    """Places of laws, one per instrument in `names` with all its set-ups; empty if there is only one instrument.

    A law describes an error as a function of covariates.
    """
    places = tuple(
        LawPlace(station_names_of_rows(sightings, rows), (), rows, (name,))
        for name, rows in names_and_rows(names, sightings.instrument)
    )
    return places if len(places) > 1 else ()


def target_clusters(sightings: Sightings) -> set[tuple[int, ...]]:
    """Groups of related targets, for each of which a diagnosis tries a law, as tuples of sorted target indices.

    A law describes an error as a function of covariates. The groups are the branches of three trees of hierarchical
    clustering (average linkage): by position, by position and surface, and by height and surface. Nests with similar
    normals count as mounted on the same surface.
    """
    if len(sightings.target_points) < 2 * MIN_GROUP_TARGETS:
        return set()
    from scipy.cluster.hierarchy import linkage  # slow to load, and only a diagnosis clusters targets

    scaled_normals = np.nan_to_num(sightings.nest_normals) * np.ptp(sightings.target_points, axis=0).max()
    clusters = set()
    for features in (
        sightings.target_points,
        np.hstack([sightings.target_points, scaled_normals]),
        np.hstack([sightings.target_points[:, 2:] * CLUSTERING_HEIGHT_WEIGHT, scaled_normals]),
    ):
        tree = [[t] for t in range(len(features))]
        for first, second in linkage(features, "average")[:, :2].astype(int):
            tree.append(sorted(tree[first] + tree[second]))
        clusters |= {tuple(b) for b in tree if MIN_GROUP_TARGETS <= len(b) <= len(features) - MIN_GROUP_TARGETS}
    return clusters


def neighbour_groups(sightings: Sightings) -> set[tuple[int, ...]]:
    """Groups of each target and its nearest neighbours, as tuples of sorted target indices."""
    near = [
        np.argsort(np.linalg.norm(sightings.target_points - point, axis=1), kind="stable")
        for point in sightings.target_points
    ]
    return {tuple(sorted(n[: k + 1].tolist())) for n in near for k in CANDIDATE_NEIGHBOUR_GROUP_SIZES if 2 * k < len(n)}


def groups_connected_by_lengths(
    sightings: Sightings, length_target_names: Iterable[tuple[str, str]]
) -> set[tuple[int, ...]]:
    """Groups of targets that known lengths connect, such as the targets of a gauge, as tuples of target indices.

    `length_target_names` are the pairs of names of the targets at the ends of the known lengths.
    """
    index = {name: i for i, name in enumerate(sightings.target_names)}
    index_pairs = [(index[a], index[b]) for a, b in length_target_names if a in index and b in index]
    if not index_pairs:
        return set()
    count, (first, second) = len(index), np.array(index_pairs).T
    _, body = connected_components(
        sp.coo_array((np.ones(len(index_pairs)), (first, second)), (count, count)), directed=False
    )
    members = [tuple(np.flatnonzero(body == k).tolist()) for k in np.unique(body)]
    return {group for group in members if MIN_GROUP_TARGETS <= len(group) <= count - MIN_GROUP_TARGETS}


def group_places(sightings: Sightings, target_groups: set[tuple[int, ...]]) -> Iterator[LawPlace]:
    """Places of laws, one per group of targets (tuple of target indices), with the pointings to the group.

    A law describes an error as a function of covariates.
    """
    for members in sorted(target_groups):
        rows = np.flatnonzero(np.isin(sightings.target, members))
        if len(rows):
            yield LawPlace((), tuple(sightings.target_names[t] for t in members), rows)
