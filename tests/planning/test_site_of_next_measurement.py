"""New stations after a recording stand on the floor of the hall and see past its bodies, one proposal per place."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.calibration.identified_network import IdentifiedNetwork
from ltsim.cli.main import run
from ltsim.core.errors import InputError
from ltsim.physics.model.construction import declared_construction
from ltsim.planning.proposals import MeasurementProposalEntry, NextMeasurement
from ltsim.planning.result import load_plan_and_scenario
from ltsim.planning.search_inputs import plan_without_search
from ltsim.planning.site_axes import with_station_poses_on_site
from ltsim.recordings import Recording
from tests.families import family

MACHINE = np.array([[3700.0, 2900.0, 0.0], [5300.0, 4100.0, 2200.0]])
"""Opposite corners of the machine [mm]."""
HALL = """format = "ltsim-plan/1"
title = "A hall with a machine"

[workshop]
size_mm = [9000, 7000, 4000]

[[workshop.obstacles]]
name = "machine"
box_mm = [1600, 1200, 2200]
position_mm = [4500, 3500, 0]

[floor]
margin_mm = 800

[stations]
count = 4
spacing_mm = 800
min_stations_per_target = 1

""" + "".join(
    f'[[points]]\nname = "P{i}"\nx_mm = {300 + 2800 * (i % 4)}\ny_mm = {300 + 6400 * (i // 4)}\n'
    f"z_mm = {700 + 400 * (i % 3)}\n"
    for i in range(8)
)


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("hall") / "hall.toml"
    file.write_text(HALL)
    return file


@pytest.fixture(scope="module")
def measured(hall: Path) -> Recording:
    return lt.simulate(load_plan_and_scenario(hall)[1], seed=1).recording


def stations_of(measurement: NextMeasurement) -> list[MeasurementProposalEntry]:
    return [proposal for proposal in measurement.proposals if proposal.kind == "station"]


def is_permitted(place: tuple[float, float, float]) -> bool:
    inside = np.all((np.array(place) > MACHINE[0]) & (np.array(place) < MACHINE[1]))
    return bool(not inside and 800 <= place[0] <= 8200 and 800 <= place[1] <= 6200)


def is_behind_machine(place: np.ndarray, point: np.ndarray) -> bool:
    """By sampled points of the line of sight, which the code does not use."""
    along = place + np.linspace(0, 1, 4001)[:, None] * (point - place)
    return bool(np.any(np.all((along > MACHINE[0]) & (along < MACHINE[1]), axis=1)))


def test_new_stations_meet_the_floor_and_the_sights_of_the_site(hall: Path, measured: Recording) -> None:
    free, checked = lt.next_measurement(measured), lt.next_measurement(measured, site=hall)
    assert any(not is_permitted(p.position_mm) for p in stations_of(free))
    proposals = stations_of(checked)
    assert proposals and all(is_permitted(p.position_mm) for p in proposals)
    scenario = load_plan_and_scenario(hall)[1]
    points = [np.array(target.position_mm) for target in scenario.targets.values()]
    missing = []
    for proposal in proposals:
        n_hidden = sum(is_behind_machine(np.array(proposal.position_mm), point) for point in points)
        (n_sights,) = re.findall(r"measure the (\d+) targets in sight", proposal.action) or [len(points)]
        missing.append(len(points) - n_hidden - int(n_sights))
    # A sight that grazes the machine is counted as blocked, within the tolerance of the tripod's position.
    assert min(missing) >= 0 and missing.count(0) > len(missing) / 2
    assert any("targets in sight" in proposal.action for proposal in proposals)


def test_a_single_proposal_per_place(measured: Recording) -> None:
    places = [proposal.position_mm for proposal in stations_of(lt.next_measurement(measured))]
    assert len(places) > 10 and len(set(places)) == len(places)


def test_the_command_says_what_it_knows_of_the_hall(
    hall: Path, measured: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lt.write(measured, tmp_path / "rec")
    assert run(["plan", "--after", str(tmp_path / "rec")]) == 0
    assert "check each proposed station against the hall, or name its plan with --site." in capsys.readouterr().out
    assert run(["plan", "--after", str(tmp_path / "rec"), "--site", str(hall)]) == 0
    assert f"New stations meet the rules of {hall} for floor, bodies and lines of sight." in capsys.readouterr().out
    assert run(["plan", str(hall), "--site", str(hall)]) == 2
    assert "--site needs --after REC" in capsys.readouterr().err


def test_a_recording_without_positions_and_common_points_is_refused(hall: Path, measured: Recording) -> None:
    setup = measured.setup.model_copy(update={"stations": {}, "targets": {}})
    renamed = tuple(f"T{i}" for i in range(len(measured.targets)))
    with pytest.raises(InputError, match=r"position_mm of the stations in setup.toml, or name targets as in the plan"):
        lt.next_measurement(measured.replace(setup=setup, targets=renamed), site=hall)


def with_declared_places(recording: Recording, shift_mm: float, yaw_deg: float) -> Recording:
    """Recording whose set-up states other positions of the stations."""
    stations = {
        name: station.model_copy(
            update={
                "position_mm": tuple(np.array(station.position_mm) + [shift_mm, -shift_mm, 0.0]),
                "yaw_deg": station.yaw_deg + yaw_deg,
            }
        )
        for name, station in recording.setup.stations.items()
    }
    return recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))


def test_rounded_positions_of_stations_do_not_move_the_network_on_the_site(hall: Path, measured: Recording) -> None:
    """The adjusted targets place the network: rounded or missing positions of stations change no sight."""
    exact = {p.action for p in stations_of(lt.next_measurement(measured, site=hall))}
    bare = measured.replace(setup=measured.setup.model_copy(update={"stations": {}}))
    for other in (with_declared_places(measured, 70.0, 1.0), bare):
        assert {p.action for p in stations_of(lt.next_measurement(other, site=hall))} == exact


def test_a_site_in_other_axes_is_refused(hall: Path, measured: Recording, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"places station S1 at \(.*\) m, but .* place it at .*: the axes differ"):
        lt.next_measurement(with_declared_places(measured, 3000.0, 0.0), site=hall)
    other = tmp_path / "other.toml"
    mirrored = "\n".join(
        f"x_mm = {9000 - int(line[7:])}" if line.startswith("x_mm") else line for line in HALL.splitlines()
    )
    other.write_text(mirrored + "\n")
    with pytest.raises(InputError, match=r"but other positions: .* m off; give the plan of this hall, or rename"):
        lt.next_measurement(measured, site=other)
    renamed = measured.replace(targets=tuple(f"T{i}" for i in range(len(measured.targets))))
    with pytest.raises(InputError, match=r"no station of the recording stands on the permitted floor of .*: S1 is at"):
        lt.next_measurement(with_declared_places(renamed, 30000.0, 0.0), site=hall)


def with_wrong_ball(recording: Recording, station: int, radius_difference: float) -> Recording:
    """Recording in which all distances of a station are longer by the difference [m] of two radii."""
    readings = recording.readings.copy()
    readings[recording.station == station, 0] += radius_difference
    return recording.with_readings(readings)


@pytest.mark.parametrize("radius_difference", family([0.018, 0.3]))
def test_a_wrong_ball_does_not_move_the_network_on_the_site(
    radius_difference: float, hall: Path, measured: Recording
) -> None:
    """Without the cause in the model stations were displaced by up to 8 mm (18 mm) and 194 mm (300 mm)."""
    space = plan_without_search(*load_plan_and_scenario(hall))[1]

    def positions(recording: Recording) -> np.ndarray:
        adjustment = IdentifiedNetwork.from_recording(recording, declared_construction(recording)).adjustment
        placed = with_station_poses_on_site(recording, adjustment, space, "hall")
        return np.array([placed.setup.stations[name].position_mm for name in recording.stations])

    wrong = with_wrong_ball(measured, 1, radius_difference)
    assert positions(wrong) == pytest.approx(positions(measured), abs=0.1)
    proposals, expected = (lt.next_measurement(recording, site=hall) for recording in (wrong, measured))
    places, expected_places = ({p.position_mm for p in stations_of(made)} for made in (proposals, expected))
    distances = np.linalg.norm(np.array([*places])[:, None] - np.array([*expected_places]), axis=2)
    assert len(places) == len(expected_places) and distances.min(axis=1).max() < 50.0
    assert not expected.tests and not expected.urgent_actions
    (cause,) = proposals.tests
    assert cause.where.stations == ("S2",) and cause.acts_on == "distance"


def test_causes_in_a_recording_are_reported_with_every_ranking(
    measured: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    readings, is_outlier = measured.readings.copy(), (measured.station == 0) & (measured.target == 5)
    readings[is_outlier, 0] += 0.004
    lt.write(with_wrong_ball(measured.with_readings(readings), 1, 0.018), tmp_path / "rec")
    row = int(np.flatnonzero(is_outlier)[0]) + 1
    for options in ([], ["--between", "bearing-wobble,azimuth-harmonic"]):
        out = tmp_path / f"next-{len(options)}"
        assert run(["plan", "--after", str(tmp_path / "rec"), *options, "--out", str(out)]) == 0
        text = capsys.readouterr().out
        assert "The distances from S2 are 18.00" in text
        assert "- Check the SMR and the distance constant at S2; correct the wrong one." in text
        assert f"- Measure again P5 from S1 (row {row})." in text
        assert [test["kind"] for test in json.loads((out / "next.json").read_text())["tests"]] == [
            "constant-offset",
            "outlier",
        ]
    between = lt.next_measurement(tmp_path / "rec", between=("range-step", "station-weather"))
    assert between.compared_places == ("S2",) and len(between.tests) == 2
    assert not between.cause_sentences and len(between.urgent_actions) == 1  # S2 is what is compared
