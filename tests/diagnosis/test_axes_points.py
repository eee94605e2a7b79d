"""Declared coordinates that define the axes are judged beside the other causes, not before them."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.axes import with_axes_from_points
from ltsim.core.arrays import Floats
from ltsim.diagnosis.diagnose import diagnose
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.recordings.recording import Recording
from tests.families import family
from tests.networks import network


def hall_with_axes(motion: Floats, error: Floats) -> Recording:
    """Six points define the axes; T02 moves by `motion` [m] in mid work, or its coordinates are off by `error` [m]."""
    recording, _ = network(faces=2, seed=5, stations=4)
    adjustment = adjust(recording)
    names = recording.targets[:6]
    declared = {name: adjustment.state.target_points[recording.targets.index(name)] for name in names}
    declared["T02"] = declared["T02"] + error
    time = float(np.median(adjustment.sightings.time[recording.target == recording.targets.index("T02")]))
    change = TargetMoved((), ("T02",), time=time).design(adjustment.sightings) @ motion
    return with_axes_from_points(recording.with_readings(recording.readings + change), declared, "hall.csv")


@pytest.mark.parametrize("motion", family([np.array([6e-5, -5e-5, 4e-5]), np.array([3e-4, -2e-4, 1e-4])]))
def test_right_coordinates_of_a_target_that_moved_are_not_blamed(motion: Floats) -> None:
    (finding,) = diagnose(hall_with_axes(motion, np.zeros(3))).findings
    assert (finding.effect, finding.where.targets) == ("target-moved", ("T02",))


def test_wrong_coordinates_of_a_target_that_stood_still_are_blamed() -> None:
    (finding,) = diagnose(hall_with_axes(np.zeros(3), np.array([3e-4, -2e-4, 1e-4]))).findings
    assert (finding.concerns_reference_value, finding.where.targets) == (True, ("T02",))
