"""A scenario of several trackers: each with errors, noise and limits of its own, and where it stood is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.core.errors import InputError
from ltsim.core.randomness import random_stream
from ltsim.physics.model.construction import misalignment_construction
from ltsim.planning.search_inputs import planned_survey
from ltsim.recordings.native import read_recording, write_recording
from ltsim.simulation.measurement_geometry import make_measurement_geometry
from ltsim.simulation.scenario import Scenario, change_scenario, load_scenario, scenario_to_toml, validate_scenario
from ltsim.simulation.simulator import simulate
from ltsim.simulation.truth import read_truth, write_truth

PAPER = load_scenario("paper-workshop")
TWO = load_scenario("two-trackers")


def two(**changes: Any) -> Scenario:
    """The hall of two trackers with some values changed, by dotted key with ``__`` for the dot."""
    return change_scenario(TWO, {key.replace("__", "."): value for key, value in changes.items()}, Path("two.toml"))


def test_a_second_tracker_does_not_change_the_draws_of_the_first() -> None:
    alone, truth = simulate(PAPER, 7)
    prior = PAPER.instrument.prior
    for p in misalignment_construction().parameters:
        assert (
            truth.instrument_values[p.name]
            == p.prior_sigma_from(prior) * random_stream(7, "instrument", p.name).standard_normal()
        )
    second = {"instruments.B.errors.draw": True, "stations.S5.instrument": "B"}
    second_recording, both = simulate(change_scenario(PAPER, second, Path("paper.toml")), 7)
    is_shared = alone.station != alone.stations.index("S5")
    assert second_recording.readings[is_shared].tobytes() == alone.readings[is_shared].tobytes()
    assert second_recording.readings[~is_shared].tobytes() != alone.readings[~is_shared].tobytes()
    assert {name: both.instrument_values[name] for name in truth.instrument_values} == truth.instrument_values
    tilt = next(p for p in misalignment_construction().parameters if p.name == "beam-tilt")
    draw = random_stream(7, "instrument", "B", "beam-tilt").standard_normal()
    assert both.instrument_values["beam-tilt@B"] == tilt.prior_sigma_from(prior) * draw


def test_a_named_tracker_measures_as_an_unnamed_tracker() -> None:
    errors = {"errors": {"beam-tilt": 7.0, "range-offset": -20.0}, "noise_factor": 1.5}
    plain = change_scenario(PAPER, {"instrument": errors}, Path("paper.toml"))
    stations = {f"stations.{name}.instrument": "A" for name in PAPER.stations}
    named = change_scenario(PAPER, {"instrument": "none", "instruments.A": errors, **stations}, Path("paper.toml"))
    (unnamed, first), (other, second) = simulate(plain, 2), simulate(named, 2)
    assert unnamed.readings.tobytes() == other.readings.tobytes()
    assert first.instrument_values == second.instrument_values and other.instruments == ("A",)
    assert second.instruments[0].noise_factor == 1.5


def test_each_tracker_has_separate_noise_resolution_and_errors() -> None:
    quiet = {"noise_factor": 0.0, "errors": {}, "resolution": {"distance_um": 0.0, "angle_arcsec": 0.0}}
    loud = {"noise_factor": 2.0, "errors": {"range-offset": 300.0}, "resolution": {"distance_um": 100.0}}
    work = make_measurement_geometry(two(instruments__A=quiet, instruments__B=loud), 1)
    recording, truth = lt.simulate(work.scenario, seed=1)
    gap = recording.readings[:, 0] - work.sightings.range_
    at_b = np.array(recording.instruments)[recording.instrument] == "B"
    assert np.abs(gap[~at_b]).max() < 1e-12
    steps = recording.readings[at_b, 0] / 100e-6
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert truth.instrument_values["range-offset@B"] == 300e-6
    assert abs(np.mean(gap[at_b]) + 300e-6) < 20e-6


def test_each_tracker_sees_within_its_limits() -> None:
    recording, _ = lt.simulate(two(instruments__B__limits__elevation_max_deg=20.0), seed=1)
    highest = {
        name: np.degrees(recording.readings[(recording.face == 1) & (recording.instrument == i), 2]).max()
        for i, name in enumerate(recording.instruments)
    }
    assert highest["B"] < 20.1 < highest["A"]
    assert all(note.startswith(("S2", "S4")) for note in recording.notes)


def test_recording_and_truth_say_which_tracker_stood_where(tmp_path: Path) -> None:
    recording, truth = lt.simulate(two(instruments__A__corrected=True), seed=3)
    write_recording(recording, tmp_path / "rec")
    text = (tmp_path / "rec" / "setup.toml").read_text()
    assert "[instruments.A]" in text and 'instrument = "B"' in text and "\n[instrument]" not in text
    again = read_recording(tmp_path / "rec")
    assert again.setup == recording.setup and again.instruments == ("A", "B")
    assert again.instrument_of("S1").corrected and not again.instrument_of("S2").corrected
    assert again.instrument_of("S4").prior.offset_mm == 0.06
    write_truth(truth, tmp_path / "truth.json")
    back = read_truth(tmp_path / "truth.json")
    assert back.instruments == truth.instruments
    assert [t.stations for t in back.instruments] == [("S1", "S3"), ("S2", "S4")]
    assert (
        back.instrument_values == pytest.approx(truth.instrument_values)
        and back.parameter_units == truth.parameter_units
    )


def test_the_scenario_survives_its_file(tmp_path: Path) -> None:
    path = tmp_path / "two.toml"
    path.write_text(scenario_to_toml(TWO))
    assert load_scenario(path) == TWO
    assert "4 stations by 2 trackers" in repr(TWO)


def test_calibration_estimates_and_corrects_the_errors_of_both_trackers() -> None:
    recording, truth = lt.simulate("two-trackers", seed=3)
    calibration = lt.calibrate(recording)
    assert (
        calibration.instrument_parameter_names[0] == "range-offset@A"
        and calibration.instrument_parameter_names[-1] == "elevation-second-order-sin@B"
    )
    z = (
        calibration.estimates.ravel()
        - [truth.instrument_values[name] for name in calibration.instrument_parameter_names]
    ) / calibration.sigma.ravel()
    assert np.abs(z).max() < 4 and 0.4 < np.mean(z**2) < 1.8
    corrected = lt.correct(recording, calibration)
    assert all(corrected.instrument_of(name).corrected for name in corrected.stations)
    assert lt.evaluate(corrected).distance.before.mean_um < 0.1 * lt.evaluate(recording).distance.before.mean_um


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stations.S1.instrument": "C"}, r"stations.S1.instrument names 'C', which is not one of A, B"),
        (
            {"instruments.A.construction": "dh"},
            r"instruments have different constructions or orders \(instruments.A 'dh' and",
        ),
        ({"instruments.C.corrected": True}, "instruments.C is used at no station; name it as"),
        ({"instrument.noise_factor": 2.0}, "instrument is used at no station"),
        ({"instruments.B.limits.elevation_max_deg": -50}, "instruments.B.limits is .* below elevation_max_deg"),
        ({"instruments.B.noise_facto": 2.0}, "unknown key 'instruments.B.noise_facto'|unknown key instruments"),
        ({"instruments.B.errors.beam-til": 2.0}, "instruments.B.errors.beam-til: .*beam-tilt"),
    ],
)
def test_invalid_input_is_refused_in_a_sentence(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        simulate(change_scenario(TWO, changes, Path("two.toml")), 1)
    assert "\n" not in str(caught.value)


def test_stations_name_trackers_only_if_trackers_exist() -> None:
    table = PAPER.model_dump(mode="json", by_alias=True, exclude_none=True)
    table["stations"]["S2"]["instrument"] = "A"
    with pytest.raises(InputError, match="names 'A', which is not declared"):
        validate_scenario(table, Path("paper.toml"))


def test_a_plan_is_for_a_single_tracker() -> None:
    with pytest.raises(InputError, match="a plan needs one, in the table"):
        planned_survey(TWO)
