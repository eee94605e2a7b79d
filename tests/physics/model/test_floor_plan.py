"""Nest normals are stated in the floor plan and used in the network's frame."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.geometry.rigid import matrix_from_rotation_vector, rotation_about_z
from ltsim.physics.model.declared_plan import DeclaredPlan
from ltsim.physics.model.measurement import NetworkState, sightings_at_state
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Station
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.simulator import simulate
from tests.networks import STATIONS, YAWS, network

ROOM = matrix_from_rotation_vector(np.array([0.004, -0.003, 2.1]))
"""Room to network, as after an adjustment in a station's frame."""


def recording_with(**settings: object) -> tuple[Recording, NetworkState]:
    """The test network with a rough floor plan, its state in a frame of its own."""
    recording, truth = network(faces=1)
    rough = np.random.default_rng(5)
    stations = {}
    for name, place, yaw in zip(recording.stations, STATIONS, YAWS, strict=True):
        plan = {
            "position_mm": tuple(1e3 * (place + rough.normal(0, 0.02, 3))),
            "yaw_deg": float(np.degrees(yaw)) + rough.normal(0, 1.0),
        }
        stations[name] = Station.model_validate({k: plan[k] for k in plan if k in settings})
    setup = recording.setup.model_copy(update={"stations": stations})
    state = NetworkState(
        truth.state.station_positions @ ROOM.T,
        ROOM @ truth.state.station_rotations,
        truth.state.target_points @ ROOM.T,
        truth.state.instrument_parameters,
    )
    return recording.replace(setup=setup), state


@pytest.mark.parametrize(
    "keys", [{"position_mm"}, {"yaw_deg"}, {"position_mm", "yaw_deg"}], ids=["position", "yaw", "both"]
)
def test_incidences_are_those_of_the_room(keys: set[str]) -> None:
    recording, truth = network(faces=1)
    expected = sightings_at_state(recording, truth.state)
    sightings = sightings_at_state(*recording_with(**dict.fromkeys(keys)))
    np.testing.assert_allclose(sightings.incidence_angle, expected.incidence_angle, atol=np.radians(1.0))
    assert np.degrees(np.abs(sightings.incidence_angle)).max() < 90


def test_a_frame_that_is_the_plan_s_is_not_changed() -> None:
    recording, _ = recording_with(position_mm=None, yaw_deg=None)
    stations = np.stack([rotation_about_z(float(y)) for y in YAWS])
    np.testing.assert_array_equal(
        DeclaredPlan.from_recording(recording).rotation_to_network(STATIONS, stations), np.eye(3)
    )


def test_without_a_plan_nothing_is_turned() -> None:
    recording, state = recording_with()
    np.testing.assert_array_equal(
        DeclaredPlan.from_recording(recording).rotation_to_network(state.station_positions, state.station_rotations),
        np.eye(3),
    )


def test_rough_places_do_not_lean_the_room() -> None:
    """Heights that are rough by a decimetre turn nothing but the yaw: instruments on tripods know the vertical."""
    recording, truth = simulate(load_scenario("paper-workshop"), seed=1)
    first = truth.station_rotations[0]
    turn = DeclaredPlan.from_recording(recording).rotation_to_network(
        (truth.station_positions - truth.station_positions[0]) @ first, first.T @ truth.station_rotations
    )
    leaned = (first @ turn)[2, 2]
    assert np.degrees(np.arccos(min(1.0, leaned))) < 0.1
