"""Diagnosis end to end: the concealed effect is found, placed, named, sized; clean recordings stay clean."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.files import write_diagnosis
from ltsim.geometry.rigid import align_rigidly
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.effect import design_from_displacements, design_from_front_face_corrections
from ltsim.physics.model.construction import misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, sightings_at_state
from ltsim.recordings.recording import Recording
from tests.networks import drawn, network

NONCENTRALITY = 250.0


def workshop(seed: int, *, faces: int = 1, repeats: int = 2) -> tuple[Recording, object]:
    """A noisy recording of an imperfect tracker, and its true state."""
    recording, truth = network(faces=faces, repeats=repeats, values=drawn(misalignment_construction(), seed), seed=seed)
    return recording, truth.state


def strengthened(recording, state, change):
    """A change of readings (n, 3) scaled to the wanted noncentrality after the adjustment, with its factor."""
    space = ResidualSpace.from_adjustment(adjust(recording, misalignment_construction(), start_state=state))
    projected = space.project(space.whiten(change[:, :, None]))[:, 0]
    factor = np.sqrt(NONCENTRALITY / float(projected @ projected))
    return recording.with_readings(recording.readings + factor * change), factor


def concealing(name: str, seed: int, values: list[float], faces: int = 1, **fields):
    """A recording that conceals an effect of the catalogue, and the values it was given [SI]."""
    recording, state = workshop(seed, faces=faces)
    effect = find_effect(name)(**fields)
    change = effect.reading_change(sightings_at_state(recording, state), np.array(values))
    hidden, factor = strengthened(recording, state, change)
    return hidden, factor * np.array(values)


WEATHER = ("station-weather", {"stations": ("S2",)}, [1e-6])
CYCLIC = ("range-cyclic", {"wavelength": 0.31}, [1e-6, 1e-6])
CASES = [
    ("target-moved", {"targets": ("T07",), "time": 2500.0}, [1e-5, 1e-5, -1e-5]),
    *(
        pytest.param(*case, marks=pytest.mark.long)
        for case in (
            ("station-settling", {"stations": ("S3",), "time_constant": 420.0}, [1e-6, -1e-6, 1e-6]),
            WEATHER,
            CYCLIC,
            ("backlash", {}, [1e-6, 1e-6]),
            ("azimuth-harmonic", {"order": 3}, [1e-6, 1e-6]),
        )
    ),
]


@cache
def diagnosis_and_truth(name, values, fields):
    """Diagnosis of a recording that conceals an effect, computed once for all tests, and the values given [SI]."""
    recording, truth = concealing(name, 11, list(values), **dict(fields))
    return diagnose(recording, seed=1), truth


def case_of(name, fields, values):
    """Diagnosis of a case, and the values that its effect was given [SI]."""
    return diagnosis_and_truth(name, tuple(values), tuple(fields.items()))


@pytest.mark.parametrize(("name", "fields", "values"), CASES)
def test_a_concealed_effect_is_named_placed_and_sized(name, fields, values):
    diagnosis, truth = case_of(name, fields, values)
    assert diagnosis.verdict == "mismatch"
    first = diagnosis.findings[0]
    assert first.effect == name
    assert first.where.stations == fields.get("stations", ())
    assert first.where.targets == fields.get("targets", ())
    assert first.evidence.p_value == pytest.approx(1 / 301)
    assert first.evidence.p_same_scope >= 0.9 * first.evidence.probability
    factors = [p.si_per_display_unit for p in find_effect(name)(**fields).parameters]
    for estimate, value, factor in zip(first.parameters, truth, factors, strict=False):
        assert abs(estimate.value - value / factor) < 4 * estimate.sigma, estimate


@pytest.mark.long
def test_both_of_two_effects_are_detected():
    recording, state = workshop(5)
    sightings = sightings_at_state(recording, state)
    for name, fields, values in (WEATHER, CYCLIC):
        change = find_effect(name)(**fields).reading_change(sightings, np.array(values))
        recording, _ = strengthened(recording, state, change)
    diagnosis = diagnose(recording)
    assert {f.effect for f in diagnosis.findings} == {"station-weather", "range-cyclic"}


def test_physics_outside_the_catalogue_is_called_unknown():
    recording, state = workshop(3)
    sightings = sightings_at_state(recording, state)
    change = design_from_front_face_corrections(
        sightings, distance=np.sin(2 * sightings.azimuth) * np.sin(2 * sightings.elevation)
    )
    recording, _ = strengthened(recording, state, change)
    diagnosis = diagnose(recording, held_out=True)
    first = diagnosis.findings[0]
    assert (first.effect, first.is_catalogued) == ("unknown", False)
    assert first.where.observables == ("distance",)
    assert np.corrcoef(diagnosis.modelled_reading_change(recording)[:, 0], change[:, 0])[0, 1] > 0.9
    assert (diagnosis.variance_factors == 1.0).all()
    assert set(first.where.covariates) == {"azimuth", "elevation"}
    assert "azimuth" in first.formula
    assert diagnosis.fit.after.held_out_rms < diagnosis.fit.before.held_out_rms


@pytest.mark.long
def test_effects_of_the_previous_motion_are_no_noise():
    """Scatter to the eye: only the order of the work tells that it is none."""
    recording, state = workshop(9)
    sightings = sightings_at_state(recording, state)
    change = design_from_front_face_corrections(
        sightings, elevation=np.abs(sightings.reading_changes_since_previous_pointing[:, 1]) * sightings.range_
    )
    diagnosis = diagnose(strengthened(recording, state, change)[0])
    assert [f.effect for f in diagnosis.findings] == ["unknown"]
    first = diagnosis.findings[0]
    assert first.where.observables == ("elevation",)
    assert "approach" in first.where.covariates
    assert "|move-azimuth|" in first.formula


@pytest.mark.long
def test_neighbours_that_move_together_are_detected_together():
    recording, state = workshop(13)
    sightings = sightings_at_state(recording, state)
    corner = np.argsort(np.linalg.norm(sightings.target_points - sightings.target_points[4], axis=1))[:7]
    sinks = np.isin(sightings.target, corner) * sightings.time / 3600.0
    change = design_from_displacements(sightings, sinks[:, None, None] * np.array([0.0, 0.0, -1.0])[:, None])[:, :, 0]
    diagnosis = diagnose(strengthened(recording, state, change)[0])
    first = diagnosis.findings[0]
    assert first.effect == "unknown"
    assert set(first.where.targets) == {recording.targets[t] for t in corner}
    assert first.where.covariates == ("time",)
    assert first.carrier == "position of targets"
    assert max(first.parameters, key=lambda p: abs(p.value)).name == "swing along z"


@pytest.mark.long
def test_a_leaning_wall_is_a_single_motion_and_its_targets_have_their_first_coordinates():
    recording, state = workshop(14)
    sightings = sightings_at_state(recording, state)
    wall = sightings.target_points[:, 1] > np.median(sightings.target_points[:, 1])
    leans = wall[sightings.target] * sightings.target_points[sightings.target, 2] * sightings.time
    change = design_from_displacements(sightings, leans[:, None, None] * np.array([0.0, 1.0, 0.0])[:, None])[:, :, 0]
    diagnosis = diagnose(strengthened(recording, state, change)[0])
    assert len(diagnosis.findings) == 1
    first = diagnosis.findings[0]
    assert "target" in first.carrier and first.driver.startswith("time")
    assert set(first.where.targets) <= {recording.targets[t] for t in np.flatnonzero(wall)}
    errors = [
        rigid_gap(points, state.target_points)
        for points in (diagnosis.baseline_adjustment.state.target_points, diagnosis.targets.points)
    ]
    assert errors[1] < 0.8 * errors[0]


@pytest.mark.long
def test_two_alternating_reflectors_are_detected_by_the_height_of_the_targets():
    """Every other target is measured with a larger ball, in two faces: no parity of the pointings tells that."""
    recording, state = workshop(16, faces=2)
    sightings = sightings_at_state(recording, state)
    out = (sightings.seating_numbers % 2)[:, None] * np.nan_to_num(sightings.nest_normals[sightings.target])
    diagnosis = diagnose(
        strengthened(recording, state, design_from_displacements(sightings, out[:, :, None])[:, :, 0])[0]
    )
    assert [f.carrier for f in diagnosis.findings] == ["height of targets in their nests"]
    assert diagnosis.findings[0].driver == "the parity of the seatings (every other target)"


@pytest.mark.long
def test_a_stand_that_is_pumped_up_again_and_again_swings():
    recording, state = workshop(17)
    sightings = sightings_at_state(recording, state)
    visit = float(np.ptp(sightings.time[sightings.station == 1]))
    sinks = (sightings.station == 1) * np.mod(sightings.time_since_station_start / (visit / 4), 1.0)
    change = design_from_displacements(sightings, sinks[:, None, None] * np.array([0.0, 0.0, 1.0])[:, None])[:, :, 0]
    diagnosis = diagnose(strengthened(recording, state, change)[0])
    first = diagnosis.findings[0]
    assert first.effect == "unknown"
    assert first.where.stations == (recording.stations[1],)
    assert "stand" in first.carrier and ("cycle" in first.driver or "wave" in first.driver)


def rigid_gap(points: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square difference of coordinates after the best rigid fit [m]."""
    rotation, translation = align_rigidly(points, truth)
    return float(np.sqrt(np.mean((points @ rotation.T + translation - truth) ** 2)))


@pytest.mark.long
@pytest.mark.parametrize(
    ("amount", "text"),
    [
        (lambda time: np.mod(time, 2000.0) < 700.0, "cycle in time"),
        (lambda time: (time > np.quantile(time, 0.3)) & (time < np.quantile(time, 0.6)), "step(time"),
    ],
)
def test_a_range_error_for_a_while_is_a_single_finding_with_sharp_edges(amount, text):
    recording, state = workshop(15)
    sightings = sightings_at_state(recording, state)
    change = design_from_front_face_corrections(sightings, distance=amount(sightings.time).astype(np.float64))
    diagnosis = diagnose(strengthened(recording, state, change)[0])
    assert [f.effect for f in diagnosis.findings] == ["unknown"]
    assert text in diagnosis.findings[0].formula
    assert diagnosis.findings[0].carrier == "distance"


def shifted_by_a_row(s):
    """Each range is corrected by the constant of the target before."""
    order = np.argsort(s.time, kind="stable")
    constant = random_stream(18, "constants").standard_normal(len(s.target_names))[s.target[order]]
    late = np.zeros(len(s))
    late[order[1:]] = -np.diff(constant)
    return design_from_front_face_corrections(s, distance=late)


def slow_wall(s):
    """The hall warms in a step, a constant of the tracker comes after."""
    since = np.maximum(s.time - np.quantile(s.time, 0.4), 0.0)
    return design_from_front_face_corrections(s, elevation=1.0 - np.exp(-since / 1500.0))


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "carrier", "text"),
    [
        (shifted_by_a_row, "distance", "the target before, another at each"),
        (slow_wall, "vertical index", "hall with a lag of 2"),
    ],
)
def test_memory_of_previous_pointings_is_reported_in_words(law, carrier, text):
    recording, state = workshop(18)
    warm = (recording.time > np.quantile(recording.time, 0.4)).astype(np.float64)
    recording = recording.replace(covariates={"hall": 20.0 + warm})
    diagnosis = diagnose(strengthened(recording, state, law(sightings_at_state(recording, state)))[0])
    assert [f.carrier for f in diagnosis.findings] == [carrier]
    assert text in diagnosis.findings[0].driver
    assert 0.1 < diagnosis.findings[0].target_shift_rms_um < 1000.0


@pytest.mark.long
def test_overwhelming_evidence_states_more_than_99_percent():
    """No count of anything stands between the readings and what is said of them."""
    recording, state = workshop(12, faces=2)
    effect = find_effect("azimuth-drift")(("S2",), law="visit")
    hidden, _ = strengthened(
        recording, state, effect.reading_change(sightings_at_state(recording, state), np.array([4e-9]))
    )
    larger = recording.with_readings(recording.readings + 6.0 * (hidden.readings - recording.readings))
    first = diagnose(larger).findings[0]
    assert (first.effect, first.where.stations) == ("azimuth-drift", ("S2",))
    assert first.evidence.probability > 0.99


@pytest.mark.long
def test_a_constant_beyond_its_prior_is_reported_as_such_and_not_as_physics():
    values = drawn(misalignment_construction(), 1)
    values[misalignment_construction().parameter_names.index("range-offset")] = 60e-6
    recording, _ = network(faces=2, values=values, seed=1)
    (first,) = diagnose(recording).findings
    assert first.effect == "range-offset"
    (offset,) = first.parameters
    assert abs(offset.value - 60.0) < 3 * offset.sigma < 15.0
    assert "zero with a standard deviation of 10 um" in first.sentence


@pytest.mark.long
def test_a_noisy_station_is_noise_and_not_a_shift():
    recording, _ = workshop(7, repeats=1)
    extra = random_stream(7, "more").standard_normal(recording.readings.shape) * recording.reading_sigmas()
    extra[recording.station != 1] = 0.0
    diagnosis = diagnose(recording.with_readings(recording.readings + 1.5 * extra))
    assert [f.effect for f in diagnosis.findings] == ["station-noise"]
    assert diagnosis.findings[0].where.stations == ("S2",)
    assert diagnosis.fit.after.held_out_rms == pytest.approx(1.0, abs=0.1)


@pytest.mark.long
def test_noise_of_the_azimuth_is_reported_in_the_azimuth():
    recording, _ = workshop(19, faces=2)
    readings = recording.readings.copy()
    readings[:, 1] += 2.0 * random_stream(19, "more").standard_normal(len(readings)) * recording.reading_sigmas()[:, 1]
    diagnosis = diagnose(recording.with_readings(readings))
    assert [f.where.observables for f in diagnosis.findings] == [("azimuth",)]


def test_exchanged_reflectors_are_named_and_corrected():
    recording, _ = workshop(9)
    target = recording.target.copy()
    rows = {t: np.flatnonzero((recording.station == 3) & (recording.target == t)) for t in (4, 13)}
    target[rows[4]], target[rows[13]] = 13, 4
    diagnosis = diagnose(recording.replace(target=target))
    first = diagnosis.findings[0]
    assert first.effect == "target-swap"
    assert first.where.stations == ("S4",)
    assert set(first.where.targets) == {"T05", "T14"}
    assert diagnosis.fit.after.chi2 / diagnosis.fit.after.dof == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("faces", [1, pytest.param(2, marks=pytest.mark.long)])
def test_a_clean_recording_is_consistent_and_its_diagnosis_is_a_function_of_the_seed(faces):
    recording, _ = workshop(21, faces=faces, repeats=1)
    diagnosis, again = diagnose(recording, seed=3), diagnose(recording, seed=3)
    assert diagnosis.verdict == "consistent"
    assert diagnosis.findings == ()
    assert "station-levelling" in {u.effect for u in diagnosis.undetectable}
    assert "station-bump" in {d.effect for d in diagnosis.detectable}
    assert all(u.undetected_target_error_um >= 0 and u.cure for u in diagnosis.undetectable)
    assert diagnosis.content() == again.content()


def test_a_common_scale_is_undetectable_without_a_reference_length():
    recording, _ = network(seed=4)
    free = recording.replace(setup=recording.setup.model_copy(update={"gauge": None}))
    for measured, is_hidden in ((free, True), (recording, False)):
        diagnosis = diagnose(measured)
        assert ("range-scale" in {entry.effect for entry in diagnosis.undetectable}) is is_hidden
        assert ("range-scale" in {entry.effect for entry in diagnosis.detectable}) is not is_hidden


def test_a_recording_without_redundancy_is_not_reported_to_agree():
    recording, _ = network(seed=4)
    recording = recording.replace(setup=recording.setup.model_copy(update={"gauge": None}))
    once = recording.select(recording.station == 0)
    _, first = np.unique(once.target, return_index=True)
    assert "cannot be tested: there is no redundancy" in diagnose(once.select(np.sort(first))).summary


@pytest.mark.long
def test_p_values_of_clean_recordings_are_uniform():
    """The false-alarm rate is what it says: six recordings, p-values spread over the unit interval."""
    values = [diagnose(workshop(100 + s, repeats=1)[0], seed=s).global_test.search_p_value for s in range(6)]
    assert min(values) > 0.001
    assert 0.2 < np.mean(values) < 0.8


def test_the_files_say_what_the_diagnosis_says(tmp_path):
    name, fields, values = CASES[0]
    diagnosis, truth = case_of(name, fields, values)
    recording = diagnosis.arrays.baseline_adjustment.recording
    write_diagnosis(diagnosis, tmp_path)
    content = json.loads((tmp_path / "diagnosis.json").read_text())
    assert content["format"] == "ltsim-diagnosis/1"
    finding = content["findings"][0]
    assert (finding["effect"], finding["where"]["targets"]) == (name, list(fields["targets"]))
    parameters = find_effect(name)(**fields).parameters
    for size, value, parameter in zip(finding["parameters"], truth, parameters, strict=False):
        assert abs(size["value"] - value / parameter.si_per_display_unit) < 4 * size["sigma"]
    lines = (tmp_path / "targets.csv").read_text().splitlines()
    assert len(lines) == 1 + len(recording.targets)
    assert lines[0].startswith("target,x_mm,y_mm,z_mm,sigma_x_mm")
    assert diagnosis.to_dataframe("targets")["target"].tolist() == list(recording.targets)


@pytest.mark.parametrize(
    ("column", "factor", "cause"),
    [
        (1, 10 / 9, "gon"),
        pytest.param(0, 1e-3, "metres", marks=pytest.mark.long),
        pytest.param(0, 1 / 25.4, "inches", marks=pytest.mark.long),
    ],
)
def test_a_station_in_another_unit_is_named_and_corrected(column, factor, cause):
    recording, _ = workshop(13, repeats=1)
    readings = recording.readings.copy()
    columns = [0] if column == 0 else [1, 2]
    for k in columns:
        readings[recording.station == 2, k] *= factor
    diagnosis = diagnose(recording.with_readings(readings))
    first = diagnosis.findings[0]
    assert (first.effect, first.where.stations) == ("wrong-unit", ("S3",))
    assert cause in first.sentence
    assert diagnosis.fit.after.chi2 / diagnosis.fit.after.dof == pytest.approx(1.0, abs=0.2)


@pytest.mark.long
def test_noise_quieter_than_declared_does_not_raise_the_held_out_error():
    """Errors are told in the declared noise: less of it is found, and nothing is predicted worse."""
    recording, state = workshop(19)
    exact = MeasurementModel(recording, misalignment_construction()).predict(state)
    readings = exact + 0.6 * (recording.readings - exact)
    diagnosis = diagnose(recording.with_readings(readings))
    assert [f.effect for f in diagnosis.findings] == ["noise-level"]
    assert diagnosis.findings[0].equivalents == ()
    assert diagnosis.fit.after.held_out_rms == pytest.approx(diagnosis.fit.before.held_out_rms)
    assert diagnosis.fit.before.held_out_rms == pytest.approx(0.6, abs=0.05)
    assert "has seen" not in diagnosis.summary


@pytest.mark.long
def test_turbulence_is_distinguished_from_a_higher_noise_level():
    recording, state = workshop(17)
    sightings = sightings_at_state(recording, state)
    effect = find_effect("turbulence")()
    grown = np.sqrt(
        effect.variance(sightings, recording.reading_sigmas(), np.array([1.2e-12, 0.6e-12]))
        - recording.reading_sigmas() ** 2
    )
    extra = grown * random_stream(17, "air").standard_normal(grown.shape)
    diagnosis = diagnose(recording.with_readings(recording.readings + extra))
    assert diagnosis.findings[0].effect == "turbulence"


@pytest.mark.long
def test_a_wave_between_the_frequencies_of_the_grid_is_a_single_finding():
    recording, state = workshop(3)
    sightings = sightings_at_state(recording, state)
    change = design_from_front_face_corrections(sightings, distance=np.sin(83.7 * sightings.elevation + 1.0))
    diagnosis = diagnose(strengthened(recording, state, change)[0])
    assert [f.effect for f in diagnosis.findings] == ["unknown"]
    first = diagnosis.findings[0]
    assert first.where.covariates == ("elevation",)
    assert first.carrier == "distance"
    assert "a wave in elevation, 83." in first.driver


@pytest.mark.long
def test_an_encoder_of_any_number_of_lines_is_named():
    recording, state = workshop(3)
    sightings = sightings_at_state(recording, state)
    change = design_from_front_face_corrections(sightings, elevation=np.sin(83.7 * sightings.elevation + 1.0))
    diagnosis = diagnose(strengthened(recording, state, change)[0])
    assert [f.effect for f in diagnosis.findings] == ["encoder-interpolation"]
    assert diagnosis.findings[0].where.observables == ("elevation",)


@pytest.mark.long
def test_targets_are_no_worse_than_those_of_the_right_explanation():
    """An imitated law, unknown to the catalogue: targets after the diagnosis, and with the law itself."""
    recording, state = workshop(4)
    sightings = sightings_at_state(recording, state)
    change = design_from_front_face_corrections(sightings, distance=np.sin(3 * sightings.azimuth))
    hidden, _ = strengthened(recording, state, change)
    diagnosis = diagnose(hidden)
    assert rigid_gap(diagnosis.targets.points, state.target_points) < 1.05 * rigid_gap(
        diagnosis.baseline_adjustment.state.target_points, state.target_points
    )
    assert np.all(np.linalg.eigvalsh(diagnosis.targets.covariance[:-4]) > 0.0)
