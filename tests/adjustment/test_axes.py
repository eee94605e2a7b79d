"""The hall's axes: results in coordinates that a person names, the shape of the network untouched."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.axes import with_axes_from_points, with_axes_from_three_targets
from ltsim.adjustment.estimate import adjust
from ltsim.core.errors import RecordError
from ltsim.core.units import ARCSECOND
from ltsim.geometry.rigid import matrix_from_rotation_vector
from ltsim.physics.effects.motions import reading_change_by_displacement
from ltsim.physics.model.measurement import sightings_at_state
from ltsim.recordings.coordinates import read_points
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Station, Target
from tests.networks import STATIONS, YAWS, network

TURN, SHIFT = matrix_from_rotation_vector(np.array([0.2, -0.4, 2.2])), np.array([120.0, -40.0, 7.0])


@pytest.fixture(scope="module")
def recording() -> Recording:
    return network(faces=2, seed=5, stations=3)[0]


def hall(recording: Recording, names: list[str], *, noise: float = 0.0) -> dict[str, np.ndarray]:
    """The network's targets in other axes."""
    points = adjust(recording).state.target_points @ TURN.T + SHIFT
    spread = noise * np.sin(np.arange(3 * len(points))).reshape(-1, 3)
    return {name: points[recording.targets.index(name)] + spread[recording.targets.index(name)] for name in names}


def distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None], axis=2)


def test_results_come_out_in_named_coordinates(recording: Recording) -> None:
    plain = adjust(recording)
    goal = hall(recording, ["T01", "T06", "T12", "T20", "T25"])
    adjustment = adjust(with_axes_from_points(recording, goal, "hall.csv"))
    for name, place in goal.items():
        np.testing.assert_allclose(adjustment.state.target_points[recording.targets.index(name)], place, atol=2e-9)
    np.testing.assert_allclose(
        distances(adjustment.state.target_points), distances(plain.state.target_points), atol=1e-9
    )
    np.testing.assert_allclose(adjustment.chi2, plain.chi2, rtol=1e-7)
    np.testing.assert_allclose(adjustment.state.station_rotations, TURN @ plain.state.station_rotations, atol=1e-9)


def test_three_targets_span_the_axes_exactly(recording: Recording) -> None:
    """By the 3-2-1 rule, in covariance too: what defines the axes is not uncertain in them."""
    named = with_axes_from_three_targets(recording, "T01", "T04", "T20")
    for result in (lt.adjust(named), adjust(named)):
        points = result.target_points if hasattr(result, "target_points") else result.state.target_points
        a, b, c = (points[recording.targets.index(name)] for name in ("T01", "T04", "T20"))
        np.testing.assert_allclose([*a, b[1], b[2], c[2]], 0.0, atol=1e-9)
        assert b[0] > 0 < c[1]
        sigma = np.sqrt(np.einsum("tii->ti", result.target_covariances))
        np.testing.assert_allclose(sigma[recording.targets.index("T01")], 0.0, atol=1e-9)
        assert sigma[recording.targets.index("T20")][0] > 1e-6
    assert "the axes of the declared coordinates of the datum's targets" in lt.adjust(named).frame


def test_axes_are_determined_as_well_as_the_coordinates_that_give_them_fit(recording: Recording) -> None:
    names = list(recording.targets[:12])
    rough, fine = (
        lt.adjust(with_axes_from_points(recording, hall(recording, names, noise=n), "h")) for n in (3e-3, 3e-4)
    )
    assert rough.axes is not None
    assert fine.axes is not None
    for adjustment, noise in ((rough, 3.0), (fine, 0.3)):  # the noise is a sine: its rms is 0.7 of its height
        assert np.array(adjustment.axes.sigma_position_mm) == pytest.approx(noise / np.sqrt(2 * 12), rel=0.4)
    lever = np.linalg.norm(np.ptp(rough.target_points[:12], axis=0)) / 2
    turn = 2.1 / np.sqrt(12) / (1e3 * lever) / ARCSECOND
    assert np.all(np.array(rough.axes.sigma_rotation_arcsec) > 0.5 * turn)
    assert np.all(np.array(rough.axes.sigma_rotation_arcsec) < 6 * turn)
    assert "which leaves the axes uncertain by" in rough.notes[0]
    assert lt.adjust(recording).axes is None


def test_another_scale_of_the_coordinates_is_reported_and_noise_is_none(recording: Recording) -> None:
    names = list(recording.targets[:8])
    for scale, noise in ((1.0004, 1e-5), (0.9999, 3e-5), (1.0, 1e-3), (1.0, 1e-5)):
        drawn = {name: scale * place for name, place in hall(recording, names, noise=noise).items()}
        (note, *_) = lt.adjust(with_axes_from_points(recording, drawn, "h")).notes
        reported = re.search(r"the scale of the coordinates differs by (\S+) \+- (\S+) ppm", note)
        assert (reported is not None) == (scale != 1.0), note
        if reported is not None:
            assert float(reported[1]) == pytest.approx(1e6 * (scale - 1.0), abs=4 * float(reported[2]))


def test_the_scale_of_right_coordinates_is_not_blamed_for_the_uncertain_scale_of_the_ranges() -> None:
    """Without a length, the scale of a calibrated network is as uncertain as the range zero and scale."""
    recording, truth = network(seed=3, faces=2, stations=3)
    recording = recording.replace(setup=recording.setup.model_copy(update={"gauge": None}))
    points = dict(zip(recording.targets[:8], truth.state.target_points, strict=False))
    (note, *_) = lt.calibrate(with_axes_from_points(recording, points, "hall.csv")).notes
    assert "the scale of the coordinates" not in note


def test_a_drawing_fits_roughly_and_a_wrong_name_is_excluded(recording: Recording) -> None:
    goal = hall(recording, list(recording.targets[:12]), noise=3e-3)
    goal["T05"] = goal["T05"] + [0.4, 0.0, 0.0]
    aligned = with_axes_from_points(recording, goal, "hall.csv")
    (note,) = lt.adjust(aligned).notes
    assert "11 targets fit it within" in note
    assert "excluded from the datum: T05 (39" in note


def test_result_and_axes_state_the_same_time_of_a_moved_target() -> None:
    """Its declared coordinates of after the motion were off by the motion, and nothing said that it was the motion."""
    recording, _ = network(faces=2, seed=5)
    moved, motion = recording.targets[7], np.array([2e-3, 0.0, 0.0])
    sightings = sightings_at_state(recording, adjust(recording).state)
    later = (recording.target == 7) & (recording.station > 1)
    readings = recording.readings + reading_change_by_displacement(sightings, later[:, None] * motion)
    goal = hall(recording, list(recording.targets))
    goal[moved] = goal[moved] + TURN @ motion
    result = lt.adjust(with_axes_from_points(recording.with_readings(readings), goal, "hall.csv"))
    statement = f"The coordinates of {moved} refer to the time before the motion."
    assert any(f"excluded from the datum: {moved} (1.99" in n and n.endswith(statement) for n in result.notes)
    assert any(test.sentence.endswith(statement) for test in result.tests)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: p * 1000, "are 1000 times the measured ones"),
        (lambda p: p * [1, 1, -1], "left-handed"),
        (lambda p: p[[3, 5, 1, 0, 2, 4]], "times the measured ones|check that hall"),
    ],
)
def test_what_is_not_this_network_is_refused(recording: Recording, change: object, says: str) -> None:
    names = ["T01", "T06", "T12", "T20", "T25", "T16"]
    places = np.array(list(hall(recording, names).values()))
    with pytest.raises(RecordError, match=says):
        with_axes_from_points(recording, dict(zip(names, change(places), strict=True)), "hall.csv")  # type: ignore[operator]


def test_wrong_frames(recording: Recording) -> None:
    goal = hall(recording, ["T01", "T06", "T12"])
    with pytest.raises(RecordError, match="contains 2 of the recording's targets"):
        with_axes_from_points(recording, {k: goal[k] for k in ("T01", "T06")}, "hall.csv")
    with pytest.raises(RecordError, match="'T99', which was never measured"):
        with_axes_from_three_targets(recording, "T01", "T99", "T20")
    with pytest.raises(RecordError, match="lie on one line"):
        with_axes_from_three_targets(recording, "T01", "T02", "T03")
    reference_setup = recording.setup.model_copy(update={"targets": {"T01": Target(known_mm=(0.0, 0.0, 0.0))}})
    with pytest.raises(RecordError, match="leave frame out"):
        with_axes_from_points(recording.replace(setup=reference_setup), goal, "hall.csv")


def test_a_file_of_axes(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("target,x_mm,y_mm,z_mm,sigma_x_mm\nA,1,2,3,0.1\nB,,,,\n")
    (tmp_path / "b.txt").write_text("A 1 2 1000\n")
    (tmp_path / "c.csv").write_text("# from the drawing\nname;x_mm;y_mm;z_mm\nA;1,0;2;3\nB;;;\n")
    for name in ("a.csv", "b.txt", "c.csv"):
        coordinates = read_points(tmp_path / name, refuses_contradictions=False).coordinates_by_name
        assert list(coordinates) == ["A"]
        np.testing.assert_allclose(coordinates["A"][:2], [0.001, 0.002])
    (tmp_path / "d.csv").write_text("what;when\nA;1\n")
    with pytest.raises(RecordError, match=r"d.csv: the file is not a list of coordinates, expected a header"):
        read_points(tmp_path / "d.csv", refuses_contradictions=False)


def test_rough_places_of_stations_give_the_axes_of_the_floor_plan(recording: Recording) -> None:
    stations = {
        name: Station(position_mm=tuple((STATIONS[i] * 1e3).round(-2)), yaw_deg=float(np.degrees(YAWS[i]).round()))
        for i, name in enumerate(recording.stations)
    }
    placed = recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))
    adjustment, plain = lt.adjust(placed), lt.adjust(recording)
    for station, place in zip(adjustment.stations, STATIONS, strict=False):
        np.testing.assert_allclose(station.position, place, atol=0.15)
    assert "floor plan" in adjustment.frame
    np.testing.assert_allclose(adjustment.fit.chi2, plain.fit.chi2, rtol=1e-7)
    np.testing.assert_allclose(adjustment.stations[0].sigma_position, 0, atol=1e-7)
    elsewhere = {name: Station(position_mm=(0.0, 1e4 * i * i, 0.0)) for i, name in enumerate(recording.stations)}
    lost = recording.replace(setup=recording.setup.model_copy(update={"stations": elsewhere}))
    assert "station S1" in lt.adjust(lost).frame
    assert "floor plan" not in lt.adjust(lost).frame
