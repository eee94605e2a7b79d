"""The workshop that is drawn stands where the floor plan says."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.reports import workshop_scene
from ltsim.simulation.scenario import load_scenario
from tests.networks import STATIONS, YAWS, mesh
from tests.reports import samples


@pytest.fixture(scope="module")
def scene() -> workshop_scene.WorkshopScene:
    return workshop_scene.workshop_from_recording(samples.recording())


def test_network_is_brought_to_the_floor_plan(scene: workshop_scene.WorkshopScene) -> None:
    assert scene.station_positions == pytest.approx(STATIONS, abs=1e-3)
    assert scene.target_points == pytest.approx(mesh(), abs=1e-3)
    assert np.exp(1j * scene.station_yaws) == pytest.approx(np.exp(1j * YAWS), abs=1e-3)
    assert scene.floor_height == 0.0


def test_walls_stand_behind_the_nests(scene: workshop_scene.WorkshopScene) -> None:
    assert scene.wall_corners.shape == (2, 4, 3)
    assert scene.wall_corners[0, :, 0] == pytest.approx(-0.05, abs=2e-3)
    assert scene.wall_corners[1, :, 1] == pytest.approx(-0.05, abs=2e-3)


def test_walls_stand_behind_nests_that_are_aimed_at_the_stations() -> None:
    from ltsim.simulation.simulator import simulate

    walls = workshop_scene.workshop_from_recording(simulate(load_scenario("paper-workshop"), 7)[0]).wall_corners
    assert walls.shape == (2, 4, 3)
    for axis in range(2):
        assert np.abs(walls[axis, :, axis]).max() < 0.1


def test_shadow_is_a_cone_under_the_elevation_limit(scene: workshop_scene.WorkshopScene) -> None:
    assert np.degrees(scene.shadow_cone_opening) == pytest.approx(70.0)
    assert scene.shadow_radii_on_floor[0] == pytest.approx(1.9 * np.tan(np.radians(35.0)), rel=1e-3)


def test_drawn_shadow_has_the_opening_of_the_scenario() -> None:
    scenario = load_scenario("paper-workshop")
    wide = scenario.model_copy(update={"workshop": scenario.workshop.model_copy(update={"shadow_cone_deg": 90.0})})
    drawn = workshop_scene.workshop_from_scenario(wide)
    assert np.degrees(drawn.shadow_cone_opening) == pytest.approx(90.0)
    assert drawn.shadow_radii_on_floor == pytest.approx(drawn.station_positions[:, 2])


def test_incidence_is_measured_on_the_walls(scene: workshop_scene.WorkshopScene) -> None:
    made = samples.recording()
    fixed = {name: target.model_copy(update={"reaimed": False}) for name, target in made.setup.targets.items()}
    walls = workshop_scene.workshop_with_surroundings(scene, made.setup.model_copy(update={"targets": fixed}))
    sights = walls.with_sights_coloured_by("incidence").sights
    assert sights is not None
    first = (sights.station_indices == 0) & (sights.target_indices == 0)
    beam = STATIONS[0] - mesh()[0]
    expected = np.degrees(np.arccos(beam[0] / np.linalg.norm(beam)))
    assert sights.colour_values[first] == pytest.approx(expected, abs=0.1)
    assert sights.colour_values.max() < 90.0


def test_reflectors_that_are_re_aimed_have_no_incidence(scene: workshop_scene.WorkshopScene) -> None:
    assert scene.incidence_sights() is None
    assert scene.with_sights_coloured_by("incidence").sights is scene.sights


def test_corrections_are_the_change_by_calibration(scene: workshop_scene.WorkshopScene) -> None:
    assert scene.target_corrections is not None
    change = samples.after().state.target_points - samples.before().state.target_points
    assert np.linalg.norm(scene.target_corrections, axis=1) == pytest.approx(np.linalg.norm(change, axis=1))


def test_a_plan_whose_zero_lies_far_below_tells_no_floor() -> None:
    made = samples.recording()
    stations = {
        name: station.model_copy(update={"position_mm": (*station.position_mm[:2], station.position_mm[2] + 360e3)})
        for name, station in made.setup.stations.items()
    }
    scene = workshop_scene.workshop_from_recording(
        made.replace(setup=made.setup.model_copy(update={"stations": stations}))
    )
    assert scene.floor_height == pytest.approx(scene.target_points[:, 2].min())
    assert scene.floor_height > 359.0
    assert scene.shadow_radii_on_floor.max() < 10.0


def test_without_a_plan_the_floor_is_at_the_lowest_target() -> None:
    made = samples.recording()
    bare = made.replace(setup=made.setup.model_copy(update={"stations": {}}))
    scene = workshop_scene.workshop_from_recording(bare)
    assert scene.floor_height == pytest.approx(scene.target_points[:, 2].min())
    assert scene.notes
    assert scene.wall_corners.shape == (0, 4, 3)


def test_gauge_lengths_join_the_gauge_targets(scene: workshop_scene.WorkshopScene) -> None:
    assert len(scene.gauge_pairs) == 6
    assert scene.gauge_targets == (24, 25, 26, 27)


def test_a_target_without_a_place_is_not_drawn() -> None:
    recording = samples.recording()
    recording = recording.select((recording.target != 5) | (recording.station == 0))
    readings = recording.readings.copy()
    readings[recording.target == 5, 1] = np.nan
    shown = workshop_scene.workshop_from_recording(recording.with_readings(readings))
    assert "T06" not in shown.targets
    assert len(shown.target_points) == len(recording.targets) - 1
    assert shown.target_covariances is not None
    assert np.isfinite(shown.target_covariances).all()
    assert shown.sights is not None
    names = [shown.targets[t] for t in shown.sights.target_indices]
    wanted = [recording.targets[t] for t in recording.target if recording.targets[t] != "T06"]
    assert names == wanted
