from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from ltsim.adjustment import adjust
from ltsim.core.errors import InputError
from ltsim.core.units import ARCSECOND, MICROMETRE
from ltsim.geometry.polar import to_polar, wrap_angle
from ltsim.physics.effects import CATALOGUE, Effect, find_effect
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.native import read_recording, write_recording
from ltsim.recordings.recording import Recording
from ltsim.simulation.measurement_geometry import make_measurement_geometry
from ltsim.simulation.scenario import Scenario, load_scenario
from ltsim.simulation.simulator import exact_readings, measure_trial, simulate
from ltsim.simulation.truth import Truth

PAPER = load_scenario("paper-workshop-re-aimed")
TWO_FACE = load_scenario("paper-workshop-two-face")
SILENT = {"noise_factor": 0.0, "errors": {}, "resolution": {"distance_um": 0.0, "angle_arcsec": 0.0}}


def with_(scenario: Scenario, **sections: Mapping[str, Any] | list[dict[str, Any]]) -> Scenario:
    """The scenario with some keys of its sections changed, or its effects."""
    data = scenario.model_dump(by_alias=True, exclude_none=True)
    for name, change in sections.items():
        data[name] = {**data[name], **change} if isinstance(change, Mapping) else change
    return Scenario.model_validate(data)


def ideal(recording: Recording, truth: Truth) -> np.ndarray:
    """Front-face polar coordinates of every pointing's target, by the truth alone."""
    offset = truth.target_points[recording.target] - truth.station_positions[recording.station]
    return to_polar(np.einsum("nji,nj->ni", truth.station_rotations[recording.station], offset))


def test_without_noise_and_errors_readings_are_the_polar_coordinates() -> None:
    recording, truth = simulate(with_(PAPER, instrument=SILENT), 5)
    np.testing.assert_allclose(recording.readings, ideal(recording, truth), rtol=0, atol=1e-14)
    assert not any(truth.instrument_values.values())


@pytest.mark.parametrize("order", ["per-target", "per-station"])
def test_face_pairs_differ_by_half_a_turn(order: str) -> None:
    recording, _ = simulate(with_(TWO_FACE, instrument=SILENT, work={"face_order": order}), 5)
    keys = list(zip(recording.station, recording.target, strict=True))
    front = {k: i for i, k in enumerate(keys) if recording.face[i] == 1}
    back = {k: i for i, k in enumerate(keys) if recording.face[i] == 2}
    assert front.keys() == back.keys() and len(front) == 140
    front_readings = recording.readings[[front[k] for k in front]]
    two = recording.readings[[back[k] for k in front]]
    np.testing.assert_allclose(two[:, 0], front_readings[:, 0], atol=1e-14)
    np.testing.assert_allclose(np.abs(wrap_angle(two[:, 1] - front_readings[:, 1])), np.pi, atol=1e-13)
    np.testing.assert_allclose(two[:, 2] + front_readings[:, 2], np.pi, atol=1e-14)


def test_face_order_per_target_and_per_station() -> None:
    with_amount_per_target, _ = simulate(TWO_FACE, 1)
    assert with_amount_per_target.face[:6].tolist() == [1, 2] * 3
    assert np.array_equal(with_amount_per_target.target[::2], with_amount_per_target.target[1::2])
    per_station, _ = simulate(with_(TWO_FACE, work={"face_order": "per-station"}), 1)
    assert per_station.face[:56].tolist() == [1] * 28 + [2] * 28


def test_the_instrument_is_exact_in_both_directions() -> None:
    work = make_measurement_geometry(
        with_(TWO_FACE, instrument={"errors": {"beam-tilt": 400.0, "transit-offset": 900.0}}), 2
    )
    values = np.array(
        [{"beam-tilt": 4e-4, "transit-offset": 9e-4}.get(n, 0.0) for n in work.construction.parameter_names]
    )
    readings = exact_readings(work, values[None], ())
    point = work.construction.points_from_readings(readings, values)
    np.testing.assert_allclose(point, work.sightings.local_points, rtol=0, atol=1e-12)


def test_declared_errors_are_the_true_errors() -> None:
    _, truth = simulate(with_(PAPER, instrument={"errors": {"beam-tilt": 5.0, "range-scale": -1.5}}), 1)
    assert truth.instrument_values["beam-tilt"] == pytest.approx(5e-6)
    assert truth.instrument_values["range-scale"] == pytest.approx(-1.5e-6)
    assert sum(v != 0 for v in truth.instrument_values.values()) == 2


def test_dh_has_separate_errors() -> None:
    recording, truth = simulate(with_(PAPER, instrument={"construction": "dh", "harmonics": 1, "degree": 1}), 1)
    assert truth.construction == "dh" and len(truth.instrument_values) == 48
    assert np.isfinite(recording.readings).all()


def test_noise_has_the_declared_size_whatever_the_place() -> None:
    scenario = with_(TWO_FACE, instrument={"resolution": SILENT["resolution"]})
    work, z = make_measurement_geometry(scenario, 8), []
    for trial in range(60):
        recording, truth = measure_trial(work, 8, trial)
        gap = recording.readings - exact_readings(work, np.array([list(truth.instrument_values.values())]), ())
        gap[:, 1] = wrap_angle(gap[:, 1])
        z.append(gap / recording.reading_sigmas())
    square = np.square(np.concatenate(z)).sum(axis=0)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 60 * len(recording))
    assert np.all((square > low) & (square < high))


def test_readings_are_whole_steps_of_the_resolution() -> None:
    recording, _ = simulate(PAPER, 3)
    steps = recording.readings / [0.1 * MICROMETRE, 0.018 * ARCSECOND, 0.018 * ARCSECOND]
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)


def test_seeds_give_different_recordings_and_equal_seeds_the_same() -> None:
    first, again, other = (simulate(PAPER, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first[0].readings, again[0].readings)
    assert first[0].setup == again[0].setup
    assert np.all(first[0].readings != other[0].readings)
    assert not np.array_equal(first[0].target, other[0].target)
    assert np.all(first[1].target_points != other[1].target_points) and np.all(
        first[1].station_positions != other[1].station_positions
    )
    assert first[0].setup.gauge != other[0].setup.gauge


EFFECT = [{"name": "station-settling", "stations": ["S3"], "draw": True}]


def test_an_effect_changes_no_other_draw() -> None:
    plain, truth = simulate(PAPER, 4)
    more, other = simulate(with_(PAPER, effects=EFFECT), 4)
    assert truth.instrument_values == other.instrument_values
    np.testing.assert_array_equal(truth.target_points, other.target_points)
    np.testing.assert_array_equal(truth.station_rotations, other.station_rotations)
    np.testing.assert_array_equal(plain.target, more.target)
    np.testing.assert_array_equal(plain.time, more.time)
    assert plain.setup == more.setup
    there = plain.stations.index("S3")
    same = plain.station != there
    np.testing.assert_array_equal(plain.readings[same], more.readings[same])
    assert np.any(plain.readings[~same] != more.readings[~same])


def test_a_second_effect_does_not_change_the_values_of_the_first() -> None:
    second = [{"name": "range-cyclic", "draw": True}, *EFFECT, {"name": "range-cyclic", "draw": True}]
    applied = simulate(with_(PAPER, effects=EFFECT), 4)[1].applied_effects
    three = simulate(with_(PAPER, effects=second), 4)[1].applied_effects
    np.testing.assert_array_equal(applied[0].parameter_values, three[1].parameter_values)
    assert np.all(applied[0].parameter_values != 0) and np.all(three[0].parameter_values != three[2].parameter_values)


def test_an_effect_adds_exactly_its_shift() -> None:
    silent = {**SILENT, "errors": {}}
    entry = [{"name": "range-cyclic", "values": {}, "shape": {"wavelength": 300.0}}]
    probe = simulate(with_(PAPER, effects=entry), 6)[1].applied_effects[0].effect
    name = probe.parameters[0].name
    entry[0]["values"] = {name: 4.0}
    plain, _ = simulate(with_(PAPER, instrument=silent), 6)
    more, truth = simulate(with_(PAPER, instrument=silent, effects=entry), 6)
    work = make_measurement_geometry(PAPER, 6)
    shift = truth.applied_effects[0].effect.reading_change(work.sightings, truth.applied_effects[0].parameter_values)
    np.testing.assert_allclose(more.readings - plain.readings, shift, atol=1e-14)
    assert np.abs(shift[:, 0]).max() == pytest.approx(4e-6, rel=0.05)


def test_an_effect_on_the_noise_scales_the_same_draws() -> None:
    exact = {"resolution": SILENT["resolution"], "errors": {}}
    silent, _ = simulate(with_(PAPER, instrument=SILENT), 6)
    plain, _ = simulate(with_(PAPER, instrument=exact), 6)
    entry = [{"name": "station-noise", "stations": ["S2"], "draw": True}]
    scenario = with_(PAPER, instrument=exact, effects=entry)
    more, _ = simulate(scenario, 6)
    there = plain.station == plain.stations.index("S2")
    np.testing.assert_array_equal(plain.readings[~there], more.readings[~there])
    ratio = (more.readings - silent.readings)[there] / (plain.readings - silent.readings)[there]
    assert np.all(ratio > 0) and np.any(np.abs(ratio - 1) > 1e-3)


def test_more_noise_cannot_be_taken_away_than_there_is() -> None:
    entry = [{"name": "turbulence", "values": {p.name: -1e6 for p in find_effect("turbulence").parameters}}]
    with pytest.raises(InputError, match="turbulence makes a variance"):
        simulate(with_(PAPER, effects=entry), 1)


@pytest.mark.parametrize("kind", CATALOGUE, ids=lambda kind: kind.name)
def test_every_effect_of_the_catalogue_can_be_simulated_and_is_in_the_truth(kind: type[Effect]) -> None:
    places = {"station": {"stations": ["S2"]}, "target": {"targets": ["T03"]}}.get(kind.scope, {})
    recording, truth = simulate(with_(PAPER, effects=[{"name": kind.name, "draw": True, **places}]), 1)
    assert np.isfinite(recording.readings).all()
    assert Truth.model_validate(json.loads(truth.text())).applied_effects[0].effect == truth.applied_effects[0].effect


def test_wrong_gauge_scale_shows_in_the_certificate_only() -> None:
    plain, _ = simulate(PAPER, 6)
    more, _ = simulate(with_(PAPER, effects=[{"name": "gauge-scale", "values": {"gauge-scale": 50.0}}]), 6)
    np.testing.assert_array_equal(plain.readings, more.readings)
    assert plain.setup.gauge is not None and more.setup.gauge is not None
    for a, b in zip(plain.setup.gauge.distance, more.setup.gauge.distance, strict=True):
        assert b.length_mm / a.length_mm - 1 == pytest.approx(-50e-6, abs=3e-7)


def test_a_wrong_unit_is_a_finished_reading_written_down_wrongly() -> None:
    plain, _ = simulate(PAPER, 6)
    effect = {"name": "wrong-unit", "stations": ["S2"], "shape": {"mistake": "metre"}, "values": {"mistaken": 1.0}}
    wrong, _ = simulate(with_(PAPER, effects=[effect]), 6)
    rows = plain.station == plain.stations.index("S2")
    np.testing.assert_array_equal(wrong.readings[~rows], plain.readings[~rows])
    np.testing.assert_allclose(1e3 * wrong.readings[rows, 0], plain.readings[rows, 0], rtol=1e-15)


def test_swapped_reflectors_carry_the_errors_of_the_pointings_that_were_made() -> None:
    targets = ["T03", "T17"]
    effect = {"name": "target-swap", "stations": ["S2"], "targets": targets, "values": {"swapped": 1.0}}
    wrong, _ = simulate(with_(PAPER, effects=[effect]), 6)
    a, b = (wrong.targets.index(name) for name in targets)
    here = (wrong.station == wrong.stations.index("S2")) & np.isin(wrong.target, (a, b))
    corrected = wrong.replace(target=np.where(here, a + b - wrong.target, wrong.target))
    assert adjust(corrected, misalignment_construction()).p_value > 1e-3
    assert adjust(wrong, misalignment_construction()).is_gross_pointing[here].all()


def test_a_confused_face_carries_the_errors_of_the_face_that_was_used() -> None:
    effect = {"name": "face-confusion", "stations": ["S2"], "shape": {"face": 2}, "values": {"confused": 1.0}}
    wrong, _ = simulate(with_(TWO_FACE, effects=[effect]), 6)
    here = wrong.station == wrong.stations.index("S2")
    assert np.all(np.abs(wrong.readings[here, 2]) < np.pi / 2)
    corrected = wrong.replace(face=np.where(here, 1, wrong.face))
    assert adjust(corrected, misalignment_construction()).p_value > 1e-3


def test_the_gauge_is_larger_in_the_warm_workshop_than_on_its_certificate() -> None:
    recording, truth = simulate(with_(PAPER, cmm={"noise_factor": 0.0}), 6)
    assert recording.setup.gauge is not None
    for line in recording.setup.gauge.distance:
        a, b = (truth.target_points[truth.target_names.index(name)] for name in (line.from_, line.to))
        assert np.linalg.norm(a - b) * 1e3 == pytest.approx(line.length_mm * (1 + 23.2e-6 * 7), abs=1e-4)


def test_the_same_seed_is_the_same_instrument_in_workshop_and_laboratory() -> None:
    workshop, laboratory = (simulate(load_scenario(n), 9)[1] for n in ("paper-workshop", "paper-laboratory"))
    assert workshop.instrument_values == laboratory.instrument_values
    assert laboratory.arrays.nominal_points is not None and workshop.nominal_points is None
    assert 0.1e-6 < np.abs(laboratory.arrays.nominal_points - laboratory.target_points).max() < 8e-6


def test_trials_on_a_common_geometry_differ_in_errors_and_noise_only() -> None:
    work = make_measurement_geometry(PAPER, 1)
    (first_trial, first), (two, second) = measure_trial(work, 1, 0), measure_trial(work, 1, 1)
    np.testing.assert_array_equal(first.target_points, second.target_points)
    np.testing.assert_array_equal(first_trial.target, two.target)
    assert all(first.instrument_values[n] != second.instrument_values[n] for n in first.instrument_values)
    assert np.mean(first_trial.readings != two.readings) > 0.98  # a few round to the same step


def test_orders_of_the_work() -> None:
    listed, _ = simulate(with_(PAPER, work={"order": "as-listed"}), 1)
    assert listed.target[:28].tolist() == list(range(28))
    levels, truth = simulate(with_(PAPER, work={"order": "level-by-level"}), 1)
    heights = truth.target_points[levels.target[:28], 2]
    assert np.all(np.diff(np.round(heights)) <= 0) and heights[0] > 5 and heights[-1] < 1
    mixed, _ = simulate(PAPER, 1)
    visits = mixed.target.reshape(5, 28)
    assert all(sorted(v) == list(range(28)) for v in visits.tolist())
    assert len({tuple(v) for v in visits.tolist()}) == 5


def test_clock_repeats_and_air() -> None:
    room = {"temperature_rise_c_per_h": 0.5}
    work = {"repeats": 2, "seconds_per_pointing": 10.0, "minutes_per_move": 15.0}
    recording, _ = simulate(with_(PAPER, work=work, workshop=room), 1)
    assert len(recording) == 280 and sorted(set(recording.repeat.tolist())) == [1, 2]
    assert np.unique(np.diff(recording.time)).tolist() == [10.0, 10.0 + 15 * 60]
    air = recording.covariates["air_temperature_c"]
    assert air[0] == 27.0 and air[-1] == pytest.approx(27.0 + 0.5 * recording.time[-1] / 3600, abs=0.06)


def test_the_set_up_knows_the_plan_and_not_the_truth() -> None:
    recording, truth = simulate(PAPER, 1)
    for i, name in enumerate(recording.stations):
        station = recording.setup.stations[name]
        assert station.position_mm is not None and all(x % 100 == 0 for x in station.position_mm)
        assert 1 < np.linalg.norm(np.array(station.position_mm) - truth.station_positions[i] * 1e3) < 200
        assert station.yaw_deg == PAPER.stations[name].yaw_deg
    assert all(t.known_mm is None and t.approximate_mm is None for t in recording.setup.targets.values())
    assert recording.setup.instrument.prior == PAPER.instrument.prior


def test_a_levelled_station_leans_as_little_as_its_level_says() -> None:
    stations = {name: {**s.model_dump(), "levelled": True} for name, s in PAPER.stations.items()}
    scenario = with_(PAPER, stations=stations)
    lean = [make_measurement_geometry(scenario, seed).layout.station_rotations[:, 2, :2] for seed in range(60)]
    assert np.std(lean) / ARCSECOND == pytest.approx(1.0, rel=0.15)


def test_recordings_survive_being_written(tmp_path: Any) -> None:
    recording, _ = simulate(TWO_FACE, 1)
    write_recording(recording, tmp_path / "rec")
    again = read_recording(tmp_path / "rec")
    gap = again.readings - recording.readings
    gap[:, 1] = wrap_angle(gap[:, 1])
    assert np.abs(gap).max() < 1e-12
    assert again.setup == recording.setup
    assert again.stations == recording.stations and np.array_equal(again.face, recording.face)
    text = (tmp_path / "rec" / "setup.toml").read_text() + (tmp_path / "rec" / "observations.csv").read_text()
    assert "truth" not in text and "seed" not in text


def test_an_effect_without_anything_to_act_on_is_reported() -> None:
    """No thermometer in the recording, and reflectors that face the beam."""
    smr = PAPER.smr.model_copy(update={"nest_orientation": "re-aimed", "incidence_error": True})
    entries = [{"name": "dead-path", "draw": True}, {"name": "gauge-scale", "draw": True}]
    recording, _ = simulate(with_(PAPER, effects=entries).model_copy(update={"smr": smr}), 1)
    assert recording.notes[-2:] == (
        "dead-path changes no reading of this recording",
        "smr-incidence changes no reading of this recording",
    )


def test_a_recording_of_too_many_pointings_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A million took 1 GB and 31 s."""
    monkeypatch.setattr("ltsim.simulation.measurement_geometry.MAX_SIMULATED_POINTINGS", 139)
    with pytest.raises(InputError, match="the scenario has 140 pointings, expected at most 139: give fewer"):
        simulate(load_scenario("paper-workshop"), 1)
