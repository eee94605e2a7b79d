"""The built-in workshops keep what the paper asks of its own (section 2.3.2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.core.units import DEGREE
from ltsim.geometry.polar import to_polar
from ltsim.scene.visibility import InvisibilityReason, nest_normals_of_smallest_incidence, stand_shadow_radii
from ltsim.simulation.measurement_geometry import make_measurement_geometry
from ltsim.simulation.scenario import Scenario, change_scenario, load_scenario
from ltsim.simulation.simulator import simulate
from ltsim.simulation.workshop import (
    gauge_rotation,
    make_gauge_frame,
    make_sight_limits,
    make_visibility,
    planned_layout,
)

PAPER = load_scenario("paper-workshop")
LAYOUT = planned_layout(PAPER)


def changed(scenario: Scenario, section: str, **values: object) -> Scenario:
    inner = getattr(scenario, section).model_copy(update=values)
    return scenario.model_copy(update={section: inner})


def test_first_station_stands_on_the_bisector_and_sees_the_walls_over_180_degrees() -> None:
    place = LAYOUT.station_positions[0, :2]
    assert place[0] == place[1] == pytest.approx(4.25 / 2**0.5, abs=0.5e-3)
    corners = np.array([[0.0, 6.0], [6.0, 0.0]]) - place
    span = np.arccos(corners[0] @ corners[1] / np.prod(np.linalg.norm(corners, axis=1)))
    assert span == pytest.approx(np.pi, abs=0.01)


def test_stations_differ_in_place_height_and_yaw() -> None:
    assert len(LAYOUT.station_names) == 5
    yaw = np.array([s.yaw_deg for s in PAPER.stations.values()])
    for values in (LAYOUT.station_positions[:, 2], yaw % 90, *LAYOUT.station_positions[:, :2].T):
        assert np.min(np.diff(np.sort(values))) > 0.05


def test_three_levels_of_eight_on_two_walls_and_a_gauge_of_four() -> None:
    heights = LAYOUT.target_points[:24, 2]
    for low, high in ((0.1, 0.2), (1.9, 2.1), (5.8, 6.0)):
        assert np.sum((heights > low) & (heights < high)) == 8
    assert np.all(LAYOUT.target_points[:24, :2].min(axis=1) <= 0.05)
    assert np.all(LAYOUT.target_points[24:, 2] < 0.6) and np.all(
        np.linalg.norm(LAYOUT.target_points[24:, :2], axis=1) < 1.6
    )
    assert np.all(LAYOUT.target_points[24:, 2] > 0.05)


def test_gauge_is_parallel_to_no_reference_plane() -> None:
    assert PAPER.gauge is not None
    frame = make_gauge_frame(PAPER.gauge)
    normal = gauge_rotation(PAPER.gauge) @ np.linalg.svd(frame.points)[2][2]
    for axes in (np.eye(3)[None], LAYOUT.station_rotations):
        angle = np.arccos(np.abs(np.einsum("sij,i->sj", axes, normal))) / DEGREE
        assert angle.min() > 10.0 and np.all(90.0 - angle > 3.0)


@pytest.mark.parametrize("cone", [None, 70.0, 110.0])
def test_every_reflector_is_visible_from_every_station_outside_both_cones(cone: float | None) -> None:
    scenario = changed(PAPER, "workshop", shadow_cone_deg=cone)
    assert make_sight_limits(scenario, scenario.instrument).elevation_min == pytest.approx(-55 * DEGREE)
    table = make_visibility(scenario)
    assert table.invisible_pair_sentences(LAYOUT.station_names, LAYOUT.target_names) == []
    radius = stand_shadow_radii(LAYOUT.station_positions, 0.15, 110 * DEGREE)
    floor = LAYOUT.target_points[16:24, :2]
    assert np.all(np.linalg.norm(floor - LAYOUT.station_positions[:, None, :2], axis=2) > radius[:, None])


@pytest.mark.parametrize("seed", range(20))
def test_true_positions_of_reflectors_are_visible(seed: int) -> None:
    assert make_measurement_geometry(changed(PAPER, "workshop", shadow_cone_deg=110.0), seed).hidden_pair_notes == ()


@pytest.mark.parametrize("name", ["paper-workshop", "paper-workshop-re-aimed", "paper-workshop-two-face"])
def test_targets_are_visible_over_180_degrees_from_every_station(name: str) -> None:
    layout = planned_layout(load_scenario(name))
    np.testing.assert_array_equal(layout.station_positions, LAYOUT.station_positions)
    np.testing.assert_array_equal(layout.target_points, LAYOUT.target_points)
    for place in layout.station_positions:
        azimuth = np.sort(to_polar(layout.target_points - place)[:, 1])
        gaps = np.diff(azimuth, append=azimuth[0] + 2 * np.pi)
        assert 2 * np.pi - gaps.max() >= np.pi


def test_wide_angles_and_ranges_are_covered() -> None:
    polar = np.concatenate([to_polar(LAYOUT.target_points - p) for p in LAYOUT.station_positions]) / [
        1.0,
        DEGREE,
        DEGREE,
    ]
    assert polar[:, 2].min() < -28 and polar[:, 2].max() > 55 and np.min(np.abs(polar[:, 2])) < 1
    assert polar[:, 0].min() < 2 and polar[:, 0].max() > 6


def test_fixed_nests_aimed_at_the_stations_serve_all_of_them() -> None:
    table = make_visibility(PAPER)
    assert table.is_visible.all()
    assert table.incidence_angles.max() < 30 * DEGREE and np.median(table.incidence_angles) > 8 * DEGREE
    normal, half = nest_normals_of_smallest_incidence(LAYOUT.station_positions, LAYOUT.target_points)
    np.testing.assert_allclose(LAYOUT.nest_normals, normal, atol=1e-9)
    np.testing.assert_allclose(table.incidence_angles.max(axis=0), half, atol=1e-9)


def test_fixed_nests_square_to_the_walls_lose_reflectors_and_the_table_says_which() -> None:
    square = changed(load_scenario("paper-workshop-re-aimed"), "smr", nest_orientation="fixed")
    table = make_visibility(square)
    assert np.all(table.reason_codes[~table.is_visible] == InvisibilityReason.OUTSIDE_ACCEPTANCE_ANGLE)
    assert 20 < np.sum(~table.is_visible) < 140
    lost = table.invisible_pair_sentences(LAYOUT.station_names, LAYOUT.target_names)
    assert "S1 does not see T01: outside the acceptance angle of the reflector" in lost
    recording, _ = simulate(square, 2)
    assert len(recording) == 43 and recording.notes[0].startswith("97 of 140 pairs")


def test_an_obstacle_hides_what_is_behind_it() -> None:
    box = {"box_mm": (800.0, 200.0, 2500.0), "position_mm": (1500.0, 1500.0, 0.0), "yaw_deg": 135.0}
    with_box = Scenario.model_validate(
        {**PAPER.model_dump(by_alias=True), "workshop": {**PAPER.workshop.model_dump(), "obstacles": (box,)}}
    )
    table = make_visibility(with_box)
    assert set(table.reason_codes[~table.is_visible].tolist()) == {InvisibilityReason.HIDDEN_BY_OBSTACLE}
    hidden = {LAYOUT.target_names[t] for t in np.flatnonzero(~table.is_visible[0])}
    assert {"T25", "T26", "T27", "T28"} <= hidden
    assert table.is_visible[0, :8].all()


def test_laboratory_has_17_reflectors_on_a_table_at_20_degrees() -> None:
    laboratory = load_scenario("paper-laboratory")
    layout = planned_layout(laboratory)
    assert laboratory.workshop.temperature_c == 20.0 and laboratory.cmm.measures_targets
    assert len(layout.target_names) == 17 and len(layout.station_names) == 5
    assert np.all(np.ptp(layout.target_points, axis=0) < [1.2, 1.2, 0.61])
    assert make_visibility(laboratory).is_visible.all()
    gap = np.linalg.norm(layout.station_positions[:, None] - LAYOUT.station_positions, axis=2)
    assert gap.min() > 0.1


def test_nests_of_cells_with_the_same_hall_are_aimed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the first trial, 3,660 cells of a campaign took a minute: the nests of each were aimed again."""
    aimed = []
    monkeypatch.setattr(
        "ltsim.simulation.workshop.nest_normals_of_smallest_incidence",
        lambda position, points: aimed.append(1) or nest_normals_of_smallest_incidence(position, points),
    )
    scenario = load_scenario("paper-workshop")
    moved = change_scenario(scenario, {"stations.S1.position_mm": [1.0, 2.0, 1500.0]}, Path("a.toml"))
    louder = change_scenario(moved, {"instrument.noise_factor": 2.0}, Path("a.toml"))
    first, second = planned_layout(moved), planned_layout(louder)
    assert len(aimed) == 1
    assert np.array_equal(first.nest_normals, second.nest_normals)
    assert not np.array_equal(first.nest_normals, planned_layout(scenario).nest_normals)
