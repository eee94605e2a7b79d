"""The order of the work: what was pointed at before, and how the axes moved since."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.model.measurement import sightings_at_state
from tests.networks import network


@pytest.fixture(scope="module")
def sightings():
    """Of a recording whose rows are not in the order of the work."""
    recording, truth = network(faces=2, seed=4)
    made = sightings_at_state(recording, truth.state)
    time = random_stream(4, "order").permutation(len(made)).astype(np.float64)
    return replace(made, time=time)


def test_moves_of_a_station_add_up(sightings):
    for station in range(len(sightings.station_names)):
        rows = sightings.measurement_order[sightings.station[sightings.measurement_order] == station]
        whole = sightings.ideal_raw_readings[rows[-1]] - sightings.ideal_raw_readings[rows[0]]
        gone = sightings.reading_changes_since_previous_pointing[rows].sum(axis=0)
        assert gone[[0, 2]] == pytest.approx(whole[[0, 2]], abs=1e-9)
        assert wrap_angle(np.array([gone[1] - whole[1]])) == pytest.approx(0.0, abs=1e-9)


def test_the_first_pointing_of_a_station_comes_from_nowhere(sightings):
    first = sightings.previous_pointing_indices < 0
    assert first.sum() == len(sightings.station_names)
    assert not sightings.reading_changes_since_previous_pointing[first].any()
    assert not sightings.approach_signs[first].any()
    assert (sightings.station[sightings.previous_pointing_indices[~first]] == sightings.station[~first]).all()
    assert (sightings.time[sightings.previous_pointing_indices[~first]] < sightings.time[~first]).all()


def test_a_reflector_that_stays_is_not_set_anew(sightings):
    """Faces and repeats of a target in a row are one seating; every set-up begins at nought."""
    first = sightings.measurement_order[sightings.station[sightings.measurement_order] == 0]
    target = sightings.target.copy()
    target[first[2:4]] = target[first[1]]
    again = replace(sightings, target=target)
    for station in range(len(sightings.station_names)):
        rows = sightings.measurement_order[sightings.station[sightings.measurement_order] == station]
        elsewhere = np.diff(target[rows]) != 0
        assert again.seating_numbers[rows[0]] == 0
        assert (np.diff(again.seating_numbers[rows]) == elsewhere).all()
    assert again.seating_numbers[first[3]] == 1


def test_an_axis_that_stands_still_was_moved_earlier(sightings):
    """Twice the same target: the second pointing comes from the side of the first."""
    rows = sightings.measurement_order[sightings.station[sightings.measurement_order] == 0]
    target, face = sightings.target.copy(), sightings.face.copy()
    target[rows[2]], face[rows[2]] = target[rows[1]], face[rows[1]]
    again = replace(sightings, target=target, face=face)
    assert not again.reading_changes_since_previous_pointing[rows[2]].any()
    assert (again.approach_signs[rows[2]] == again.approach_signs[rows[1]]).all()
    assert again.approach_signs[rows[1]].all()
