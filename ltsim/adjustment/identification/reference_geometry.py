"""Errors that the geometry of the reference points shows without an adjustment: exchanged points, another scale.

The shape of the network, computed without the reference coordinates, is compared with these coordinates. Such errors
are as large as the network, so that no adjustment with them converges or rejects the right values.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from ltsim.adjustment.identification.evidence import log_prior_of_kind
from ltsim.adjustment.identification.hypothesis import CauseHypothesis, CoordinateExchange, ReadingShiftChange
from ltsim.adjustment.identification.reading_shifts import ReadingShift
from ltsim.adjustment.reference_values import full_reference_coordinates, without_reference_coordinates
from ltsim.adjustment.significance import MAX_TRACKER_ERROR, MIN_FAULTY_FRACTION_OF_GROUP
from ltsim.adjustment.start import initial_network
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import align_rigidly, largest_alignment_distance
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.transcription_errors import (
    MAX_COMPARED_TARGETS,
    MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS,
    target_points_by_station,
)

MIN_POINTS_FOR_EXCHANGE = 4
"""Smallest number of reference points for a test whether two points are exchanged. With three points an exchange always
fits, as a mirror image."""
MAX_EXCHANGE_MISCLOSURE_RATIO = 0.02
"""Limit of the ratio of misclosures of reference points with two names exchanged and without an exchange (or after any
other exchange). If the ratio is smaller, the exchange becomes a hypothesis. It is also the largest relative difference
of the scale errors of single lengths, if all distances have one scale error."""


MIN_COMPARED_LENGTH = MAX_TRACKER_ERROR / MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS
"""Smallest length [m] that is compared with its measured value: 0.5 m. Errors of a tracker change the ratio of such
lengths by less than `MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS`, so that they are not taken for a scale error."""


def reference_point_exchanges(recording: Recording) -> list[CauseHypothesis]:
    """Hypothesis that two points are exchanged, at least one of them a reference point; empty list if none fits.

    The reference coordinates are compared with the shape of the network computed without them. A reference point is
    compared with the other reference points, and with the targets without reference coordinates.
    """
    try:
        (_, _, points), _ = initial_network(without_reference_coordinates(recording))
        names, here, there = _reference_points(recording, points)
        if len(names) < MIN_POINTS_FOR_EXCHANGE:
            return []
        pair = _exchanged_reference_points(here, there)
        exchanged = None if pair is None else (names[pair[0]], names[pair[1]])
        exchanged = exchanged or _exchanged_with_other_target(recording.targets, points, names, here, there)
    except NetworkError:
        return []
    if exchanged is None:
        return []
    first, second = exchanged
    if second in names:
        sentence = f"The reference coordinates of {first} and {second}, or the names of these targets, are exchanged."
    else:
        sentence = (
            f"The reference coordinates of {first} are those of {second}: the names of these targets are exchanged in "
            "the recording or in the file of the coordinates."
        )
    prior = log_prior_of_kind("names", len(names) * len(recording.targets))
    change = CoordinateExchange((first, second))
    return [CauseHypothesis("names", "point", (), (first, second), prior, change, sentence)]


def _reference_points(recording: Recording, points: Floats) -> tuple[list[str], Floats, Floats]:
    """Names of the k targets with three reference coordinates, their `points` (k, 3), and these coordinates (k, 3) [m].

    `points` (T, 3) [m] are the positions of all targets in any frame.
    """
    coordinates = full_reference_coordinates(recording)
    indices = [i for i in coordinates if np.isfinite(points[i]).all()]
    there = np.array([coordinates[i] for i in indices], dtype=np.float64).reshape(-1, 3)
    return [recording.targets[i] for i in indices], points[indices], there


def _exchanged_reference_points(points: Floats, reference_points: Floats) -> tuple[int, int] | None:
    """Indices of the two of k reference points that are exchanged; None if no exchange fits.

    `points` (k, 3) [m] are positions in the network, `reference_points` (k, 3) [m] the declared coordinates.
    """
    pairs = list(combinations(range(len(points)), 2))
    orders = (_swapped_order(len(points), *pair) for pair in pairs)
    swapped = [largest_alignment_distance(points, reference_points[order]) for order in orders]
    best = int(np.argmin(swapped))
    rivals = [largest_alignment_distance(points, reference_points), *swapped[:best], *swapped[best + 1 :]]
    return pairs[best] if swapped[best] < MAX_EXCHANGE_MISCLOSURE_RATIO * min(rivals) else None


def _exchanged_with_other_target(
    target_names: Sequence[str], points: Floats, names: Sequence[str], network_points: Floats, reference_points: Floats
) -> tuple[str, str] | None:
    """Names of a reference point and of the target without reference coordinates at its declared place, or None.

    The other reference points define the frame. `points` (T, 3) [m] are the positions of all targets in any frame,
    `network_points` (k, 3) [m] those of the k reference points `names`, and `reference_points` (k, 3) [m] the declared
    coordinates.
    """
    best: tuple[float, tuple[str, str]] | None = None
    for k, name in enumerate(names):
        others = np.arange(len(names)) != k
        rotation, translation = align_rigidly(network_points[others], reference_points[others])
        gaps = np.linalg.norm(points @ rotation.T + translation - reference_points[k], axis=1)
        gaps = np.where(np.isfinite(gaps), gaps, np.inf)
        distances_of_others = np.linalg.norm(
            network_points[others] @ rotation.T + translation - reference_points[others], axis=1
        )
        misclosure = max(float(np.min(gaps)), float(distances_of_others.max()))
        nearest, second_smallest = target_names[int(np.argmin(gaps))], float(np.partition(gaps, 1)[1])
        is_at_place = misclosure < min(MAX_TRACKER_ERROR, MAX_EXCHANGE_MISCLOSURE_RATIO * second_smallest)
        if nearest not in names and is_at_place and (best is None or misclosure < best[0]):
            best = misclosure, (name, nearest)
    return None if best is None else best[1]


def _swapped_order(n_points: int, first_index: int, second_index: int) -> list[int]:
    """Indices 0 to `n_points` - 1 in ascending order, with `first_index` and `second_index` exchanged."""
    order = list(range(n_points))
    order[first_index], order[second_index] = second_index, first_index
    return order


def common_scale_error(
    recording: Recording, instrument_parameters: Floats
) -> tuple[CauseHypothesis, NetworkState] | None:
    """Hypothesis of a large scale error of all distances, and a start state with it; None without such an error.

    Each station measures lengths between reference points, and reference lengths. The ratios of measured to declared
    length must be equal for most lengths of each of these two kinds, and differ from 1 by more than
    `MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS`. If the reference lengths agree with the readings, the reference
    coordinates have another scale, not the distances. The start state contains `instrument_parameters`, and the scale
    error as the parameter of the hypothesis.
    """
    ratios, is_reference_length = _length_ratios(recording)
    scale = float(np.median(ratios)) - 1.0 if len(ratios) > 1 else 0.0
    agrees = np.abs(ratios - 1.0 - scale) < MAX_EXCHANGE_MISCLOSURE_RATIO * abs(scale)
    kinds = [agrees[is_reference_length], agrees[~is_reference_length]]
    is_common = agrees.sum() > 1 and all(kind.mean() > MIN_FAULTY_FRACTION_OF_GROUP for kind in kinds if len(kind))
    if not is_common or abs(scale) < MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS:
        return None
    readings = recording.readings.copy()
    readings[:, 0] /= 1.0 + scale
    try:
        network, is_unconnected = initial_network(recording.with_readings(readings))
    except NetworkError:
        return None
    if is_unconnected.any():
        return None
    change = ReadingShiftChange(ReadingShift("distance", is_proportional=True))
    hypothesis = CauseHypothesis("scale-error", "distance", (), (), log_prior_of_kind("scale-error", 1), change)
    return hypothesis, NetworkState(*network, instrument_parameters, np.array([scale]))


def _length_ratios(recording: Recording) -> tuple[Floats, Bools]:
    """Ratios (k,) of measured to declared lengths, medians over stations; flags (k,) of the reference lengths.

    The declared lengths are the reference lengths, and the lengths between reference points with three coordinates.
    """
    place_by_index = full_reference_coordinates(recording)
    length_by_ends = {
        (i, j): float(np.linalg.norm(place_by_index[i] - place_by_index[j]))
        for i, j in combinations(list(place_by_index)[:MAX_COMPARED_TARGETS], 2)
    }
    reference_lengths = set()
    for distance in recording.gauge.distance:
        i, j = (recording.targets.index(name) for name in (distance.from_, distance.to))
        length_by_ends[i, j] = distance.length_mm * MILLIMETRE
        reference_lengths.add((i, j))
    if not length_by_ends:
        return np.zeros(0), np.zeros(0, dtype=bool)
    ratios_by_ends: dict[tuple[int, int], list[float]] = {}
    clouds = target_points_by_station(from_polar(recording.readings), recording.station, recording.target)
    for cloud in clouds.values():
        point_by_target = dict(zip(cloud.targets.tolist(), cloud.points, strict=True))
        for (i, j), length in length_by_ends.items():
            if length > MIN_COMPARED_LENGTH and i in point_by_target and j in point_by_target:
                measured = float(np.linalg.norm(point_by_target[i] - point_by_target[j]))
                ratios_by_ends.setdefault((i, j), []).append(measured / length)
    medians = np.array([np.median(ratios) for ratios in ratios_by_ends.values()])
    return medians, np.array([ends in reference_lengths for ends in ratios_by_ends], dtype=bool)
