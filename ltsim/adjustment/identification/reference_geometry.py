"""Errors that the geometry of the reference points shows without an adjustment: exchanged points, another scale.

The shape of the network, computed without the reference coordinates, is compared with these coordinates. Such errors
are as large as the network, so that no adjustment with them converges or rejects the right values.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ltsim.adjustment.identification.evidence import log_prior_of_kind
from ltsim.adjustment.identification.hypothesis import CauseHypothesis, CoordinateExchange, ReadingShiftChange
from ltsim.adjustment.identification.reading_shifts import ReadingShift
from ltsim.adjustment.reference_values import without_reference_coordinates
from ltsim.adjustment.significance import MAX_TRACKER_ERROR, MIN_FAULTY_FRACTION_OF_GROUP
from ltsim.adjustment.start import initial_network
from ltsim.core.arrays import Floats
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
"""Largest ratio of misclosures at which the exchange of two points becomes a hypothesis: largest misclosure of the
reference points after this exchange, divided by that without an exchange or after any other exchange. It is also the
largest relative difference between the scale errors that single lengths show, if all distances have one scale error.
"""


MIN_COMPARED_LENGTH = MAX_TRACKER_ERROR / MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS
"""Smallest length [m] whose ratio to its measured value is computed: 0.5 m. Errors of a tracker then change the ratio
by less than `MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS`, above which a scale error is sought before any fit."""


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
        exchanged = exchanged or _exchanged_with_other_target(recording, points)
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
    setup_by_name = {name: recording.target_setup(name) for name in recording.targets}
    names = [
        name
        for name, target in setup_by_name.items()
        if target.known_mm is not None
        and target.known_axes == "xyz"
        and np.isfinite(points[recording.targets.index(name)]).all()
    ]
    here = points[[recording.targets.index(name) for name in names]]
    there = np.array([setup_by_name[name].known_mm for name in names], dtype=np.float64).reshape(-1, 3) * MILLIMETRE
    return names, here, there


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


def _exchanged_with_other_target(recording: Recording, points: Floats) -> tuple[str, str] | None:
    """Names of a reference point and of the target without reference coordinates at its declared place, or None.

    The other reference points define the frame. `points` (T, 3) [m] are the positions of all targets in any frame.
    """
    names, here, there = _reference_points(recording, points)
    best: tuple[float, tuple[str, str]] | None = None
    for k, name in enumerate(names):
        others = np.arange(len(names)) != k
        rotation, translation = align_rigidly(here[others], there[others])
        gaps = np.linalg.norm(points @ rotation.T + translation - there[k], axis=1)
        gaps = np.where(np.isfinite(gaps), gaps, np.inf)
        distances_of_others = np.linalg.norm(here[others] @ rotation.T + translation - there[others], axis=1)
        misclosure = max(float(np.min(gaps)), float(distances_of_others.max()))
        nearest, second_smallest = recording.targets[int(np.argmin(gaps))], float(np.partition(gaps, 1)[1])
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
    length must be equal for most lengths, and differ from 1 by more than
    `MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS`. The start state contains `instrument_parameters`, and the scale
    error as the parameter of the hypothesis.
    """
    ratios = np.array(_length_ratios(recording))
    scale = float(np.median(ratios)) - 1.0 if len(ratios) > 1 else 0.0
    agrees = np.abs(ratios - 1.0 - scale) < MAX_EXCHANGE_MISCLOSURE_RATIO * abs(scale)
    is_common = bool(agrees.sum() > max(1.0, MIN_FAULTY_FRACTION_OF_GROUP * len(ratios)))
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


def _length_ratios(recording: Recording) -> list[float]:
    """Ratio of each measured length to its declared length: median of the stations that measured both ends.

    The declared lengths are the reference lengths, and the lengths between reference points with three coordinates.
    """
    setup_by_index = {i: recording.target_setup(name) for i, name in enumerate(recording.targets)}
    place_by_index = {
        i: MILLIMETRE * np.array(target.known_mm, dtype=np.float64)
        for i, target in setup_by_index.items()
        if target.known_mm is not None and target.known_axes == "xyz"
    }
    length_by_ends = {
        (i, j): float(np.linalg.norm(place_by_index[i] - place_by_index[j]))
        for i, j in combinations(list(place_by_index)[:MAX_COMPARED_TARGETS], 2)
    }
    for distance in recording.gauge.distance:
        i, j = (recording.targets.index(name) for name in (distance.from_, distance.to))
        length_by_ends[i, j] = distance.length_mm * MILLIMETRE
    ratios_by_ends: dict[tuple[int, int], list[float]] = {}
    clouds = target_points_by_station(from_polar(recording.readings), recording.station, recording.target)
    for cloud in clouds.values() if length_by_ends else ():
        point_by_target = dict(zip(cloud.targets.tolist(), cloud.points, strict=True))
        for (i, j), length in length_by_ends.items():
            if length > MIN_COMPARED_LENGTH and i in point_by_target and j in point_by_target:
                measured = float(np.linalg.norm(point_by_target[i] - point_by_target[j]))
                ratios_by_ends.setdefault((i, j), []).append(measured / length)
    return [float(np.median(ratios)) for ratios in ratios_by_ends.values()]
