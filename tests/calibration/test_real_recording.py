"""A real tracker: parameters found at one set-up take two-face differences out of the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment.fieldcheck.setup_model import two_face_pairs
from ltsim.calibration.correct import correct
from ltsim.calibration.network import calibrate_network
from ltsim.geometry.polar import from_polar
from ltsim.recordings import Hints, Recording, read


@pytest.fixture(scope="module")
def epoch(shared: Path) -> Recording:
    file = shared / "recordings" / "desy-girder-at960" / "Polar_measurements_20Sep21.txt"
    if not file.is_file():
        pytest.skip("the recording desy-girder-at960 is not at hand")
    return read(file, hints=Hints(azimuth="clockwise"))


def two_face_gap(recording: Recording) -> float:
    """Rms [m] of the distance between the points of the two faces of a target."""
    points = from_polar(recording.readings)
    gaps = []
    for target in range(len(recording.targets)):
        rows = recording.target == target
        face_points, two = (points[rows & (recording.face == face)] for face in (1, 2))
        if len(face_points) and len(two):
            gaps.append(face_points.mean(axis=0) - two.mean(axis=0))
    return float(np.sqrt(np.mean(np.sum(np.square(gaps), axis=1))))


@pytest.mark.parametrize(("learned", "applied"), [(0, 1), (1, 0)])
def test_parameters_carry_over_to_the_other_set_up(epoch: Recording, learned: int, applied: int) -> None:
    calibration = calibrate_network(epoch.select(epoch.station == learned), recommend_measurements=False)
    assert calibration.fit.status == "converged"
    other = epoch.select(epoch.station == applied)
    before, after = two_face_gap(other), two_face_gap(correct(other, calibration))
    assert after < 0.5 * before, f"{1e6 * before:.1f} um before, {1e6 * after:.1f} um after"


@pytest.mark.long
def test_whole_epoch_gives_parameters_with_uncertainty(epoch: Recording) -> None:
    calibration = calibrate_network(epoch)
    tilt = calibration.instrument_parameter_names.index("beam-tilt")
    assert calibration.sigma[0, tilt] < 0.1 * calibration.prior_sigma[0, tilt]
    assert any("range-scale" in c.combination for c in calibration.undetermined)


@pytest.mark.long
def test_from_the_first_set_up_to_the_second_of_every_epoch_by_default(shared: Path) -> None:
    """Two-face differences of set-up 1 that the default calibration from set-up 0 removes, median over the epochs.

    Six terms without the azimuth's eccentricity, which one set-up does not hold, remove 81.6 and 68.4 % by the same
    measure, all sixteen 80.3 and 68.3 %; six fitted to set-up 1 itself, which no transfer can beat, 82.4 and 74.1 %.
    """
    files = sorted((shared / "recordings" / "desy-girder-at960").glob("Polar_measurements_*.txt"))
    if not files:
        pytest.skip("the recording desy-girder-at960 is not at hand")
    removed = []
    for file in files:
        whole = read(file, hints=Hints(azimuth="clockwise"))
        calibration = calibrate_network(whole.select(whole.station == 0), recommend_measurements=False)
        other = whole.select(whole.station == 1)
        remaining_gap = two_face_pairs(
            other, calibration.construction, calibration.applied_values[0]
        ).rms_half_differences
        removed.append(1.0 - remaining_gap / two_face_pairs(other).rms_half_differences)
    across, elevation = np.median(removed, axis=0)[1:]
    assert across > 0.813
    assert elevation > 0.62
