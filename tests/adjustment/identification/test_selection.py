"""Simple causes: each is identified at its place with its size, just visible or absurd, and nothing else is."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.identification import CauseSelection, FitInput, cause_tests, screening, select_causes
from ltsim.adjustment.identification.evidence import (
    LOG_OF_LOG_SIZE_PRIOR_WIDTH,
    estimate_noise_factors,
    estimate_noise_factors_of_groups,
    log_occam_factor_of_shift,
    log_occam_factor_of_variance,
)
from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis_library import shift_candidates
from ltsim.adjustment.identification.model_changes import apply_corrections_and_omissions
from ltsim.adjustment.identification.motion_refinement import refine_motion_time
from ltsim.adjustment.identification.nominal_offsets import smr_exchange_text
from ltsim.adjustment.identification.recommendations import recommendation_for_cause
from ltsim.adjustment.identification.screening import _distance_trial_hypotheses
from ltsim.adjustment.reference_values import ReferenceValue, reference_values
from ltsim.adjustment.start import initial_network
from ltsim.adjustment.stochastic_model import fit_robust_state
from ltsim.core.arrays import Floats, Ints
from ltsim.core.randomness import random_stream
from ltsim.core.units import ARCSECOND
from ltsim.diagnosis.findings_from_tests import cause_test_finding
from ltsim.diagnosis.sentences import finding_title
from ltsim.geometry.rigid import align_robustly, rotation_about_z
from ltsim.physics.effects.motions import reading_change_by_displacement, reading_change_by_station_motion
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.effects.station_settling import StationSettling
from ltsim.physics.model.construction import declared_construction, misalignment_construction
from ltsim.physics.model.measurement import sightings_at_state
from ltsim.recordings.centring_errors import CentringUncertainty
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.recordings.setup import Target
from tests.families import family
from tests.networks import Truth, network

CONTROL = ("T01", "T06", "T12", "T24")


@cache
def hall() -> tuple[Recording, Truth]:
    """Four stations, both faces, four control points, a gauge; a pointing every 10 s."""
    recording, truth = network(faces=2, seed=3, stations=4)
    points = dict(zip(recording.targets, truth.state.target_points, strict=True))
    references = {name: Target(known_mm=tuple((1e3 * points[name]).tolist()), known_sigma_mm=0.01) for name in CONTROL}
    setup = recording.setup.model_copy(update={"targets": {**recording.setup.targets, **references}})
    order = np.argsort(recording.station, kind="stable")
    clocked = recording.select(order).replace(time=10.0 * np.arange(len(recording)), has_clock=True, setup=setup)
    return clocked, truth


def identified(recording: Recording) -> CauseSelection:
    return select_causes(FitInput(recording, misalignment_construction()))


def shifted(recording: Recording, rows: Floats, column: int, size: float | Floats) -> Recording:
    readings = recording.readings.copy()
    readings[rows, column] += size
    return recording.with_readings(readings)


def only_cause(selection: CauseSelection) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    (choice,) = selection.selected_hypotheses
    return choice.hypothesis.kind, choice.hypothesis.stations, choice.hypothesis.targets


def test_nothing_is_identified_in_a_clean_hall() -> None:
    selection = identified(hall()[0])
    assert selection.selected_hypotheses == ()
    assert selection.fit.is_outlier.sum() <= 1
    assert not selection.requires_adjustment_with_causes


@pytest.mark.parametrize("size", family([2e-4, 12.7e-3, 0.4], 2))
def test_an_offset_of_all_distances_to_a_target(size: float) -> None:
    recording, truth = hall()
    wrong = shifted(recording, recording.target == 7, 0, size)
    selection = identified(wrong)
    assert only_cause(selection) == ("constant-offset", (), ("T08",))
    (test,) = [t for t in cause_tests(selection) if t.accepted and t.kind != "outlier"]
    assert test.unit == "mm"
    assert test.estimate == pytest.approx(1e3 * size, abs=0.05)
    assert ("0.5 inch" in test.sentence) == (size == 12.7e-3)
    assert np.allclose(selection.fit.state.target_points, truth.state.target_points, atol=1e-4)


@pytest.mark.parametrize("size", family([2e-4, 17.5e-3, 0.3]))
def test_an_offset_of_all_distances_from_a_station(size: float) -> None:
    recording, _ = hall()
    assert only_cause(identified(shifted(recording, recording.station == 2, 0, size))) == (
        "constant-offset",
        ("S3",),
        (),
    )


@pytest.mark.parametrize(("size", "direction"), [(3e-5, "large"), (-3e-5, "small")])
def test_an_offset_of_the_elevations_from_a_station_has_its_sign(size: float, direction: str) -> None:
    recording, _ = hall()
    selection = identified(shifted(recording, recording.station == 2, 2, size))
    (test,) = [t for t in cause_tests(selection) if t.accepted and t.kind != "outlier"]
    assert test.estimate == pytest.approx(size / ARCSECOND, abs=5.0 * test.sigma)
    assert f"arcsec too {direction}: the vertical index differs at this set-up" in test.sentence


@pytest.mark.parametrize("share", family([3e-5, 0.01]))
def test_a_scale_error_of_a_station(share: float) -> None:
    recording, _ = hall()
    readings = recording.readings.copy()
    readings[recording.station == 1, 0] *= 1.0 + share
    assert only_cause(identified(recording.with_readings(readings))) == ("scale-error", ("S2",), ())


@pytest.mark.parametrize("size", [1.0, *family([100.0], 0)])
def test_a_settling_stand_is_a_single_cause(size: float) -> None:
    """It was reported as a sudden motion and a drift of the station."""
    recording, truth = hall()
    settled = StationSettling(("S2",), time_constant=240.0).reading_change(
        sightings_at_state(recording, truth.state), size * np.array([2e-5, -1.5e-5, 5e-5])
    )
    selection = identified(recording.with_readings(recording.readings + settled))
    assert only_cause(selection) == ("station-settling", ("S2",), ())
    assert selection.requires_adjustment_with_causes
    (effect,) = selection.fit.effects
    assert isinstance(effect, StationSettling)
    assert effect.time_constant == pytest.approx(240.0, rel=0.5 if size < 10.0 else 0.1)
    (test,) = cause_tests(selection)
    assert test.unit == "urad"
    assert test.estimate == pytest.approx(25.0 * size, rel=0.3 if size < 10.0 else 0.05)


@pytest.mark.parametrize("share", family([2e-4, 0.1, 2e-5]))
def test_a_scale_error_of_all_distances_is_no_error_of_control_points(share: float) -> None:
    recording, _ = hall()
    readings = recording.readings.copy()
    readings[:, 0] *= 1.0 + share
    selection = identified(recording.with_readings(readings))
    assert only_cause(selection) == ("scale-error", (), ())
    assert selection.wrong_range_constants == ("range-scale",) * (share < 1e-4)
    (test,) = cause_tests(selection)
    assert test.estimate == pytest.approx(1e6 * share, abs=5.0 * test.sigma)
    adjusted = lt.adjust(recording.with_readings(readings))
    assert adjusted.adjustment is not None
    assert not adjusted.adjustment.rejected_references
    assert adjusted.fit.chi2 < 1.2 * adjusted.fit.dof


def test_a_range_offset_stays_a_constant_of_the_calibration_with_another_cause() -> None:
    """Beside a wrong reflector it was a cause of its own, and the calibration corrected no distance."""
    recording, _ = hall()
    result = lt.calibrate(
        shifted(shifted(recording, recording.target >= 0, 0, 2e-4), recording.target == 7, 0, 12.7e-3)
    )
    assert [test.where.targets for test in result.tests if test.kind != "outlier"] == [("T08",)]
    offset = next(p for p in result.parameters if p.name == "range-offset")
    assert offset.value == pytest.approx(-200.0, abs=3.0 * offset.sigma)


@pytest.mark.parametrize(
    ("factor", "cause"), [(1.0 / 0.3048, "feet were recorded as metres"), (0.5, "another unit or a wrong factor")]
)
def test_a_large_scale_error_of_all_distances_is_identified_from_the_lengths(factor: float, cause: str) -> None:
    """With feet for metres no network fitted, and the sentence named temperatures of thousands of kelvin."""
    recording, truth = hall()
    readings = recording.readings.copy()
    readings[:, 0] *= factor
    scaled = recording.with_readings(readings)
    selection = identified(scaled)
    (first, *others) = cause_tests(selection)
    assert (first.kind, first.where.stations, first.where.targets) == ("scale-error", (), ())
    assert first.sentence.endswith(f"{cause}.")
    assert {test.kind for test in others} <= {"noise-level"}  # another unit changes the noise too
    assert "The distances from all stations" in str(lt.check(scaled)).splitlines()[0]
    adjusted = lt.adjust(scaled)
    assert adjusted.adjustment is not None
    assert np.allclose(adjusted.adjustment.state.target_points, truth.state.target_points, atol=2e-4)


def test_feet_for_metres_at_a_single_station_are_a_unit() -> None:
    recording, _ = hall()
    readings = recording.readings.copy()
    readings[recording.station == 1, 0] /= 0.3048
    selection = identified(recording.with_readings(readings))
    assert only_cause(selection) == ("unit", ("S2",), ())
    assert "feet for metres" in cause_tests(selection)[0].sentence


def test_a_single_wrong_length_may_be_a_scale_error() -> None:
    """Without reference points a wrong length and a scale error of all distances are indistinguishable."""
    recording, _ = hall()
    (length, *_) = recording.gauge.distance
    gauge = recording.gauge.model_copy(update={"distance": (length,)})
    targets = {name: target.model_copy(update={"known_mm": None}) for name, target in recording.setup.targets.items()}
    setup = recording.setup.model_copy(update={"targets": targets, "gauge": gauge})
    readings = recording.readings.copy()
    readings[:, 0] *= 0.9
    (test, *_) = cause_tests(identified(recording.replace(readings=readings, setup=setup)))
    assert test.kind == "reference-value"
    assert "or the distances from all stations are 100000 ppm too short" in test.sentence.replace("1e+05", "100000")


@pytest.mark.parametrize("is_in_recording", [True, False])
def test_a_reference_point_exchanged_with_another_target_is_named(*, is_in_recording: bool) -> None:
    """The reference coordinates were reported as off by the distance of both targets."""
    recording, _ = hall()
    first, second = "T06", "T07"
    if is_in_recording:
        i, j = (recording.targets.index(name) for name in (first, second))
        exchanged = np.arange(len(recording.targets))
        exchanged[[i, j]] = j, i
        wrong = recording.replace(target=exchanged[recording.target])
    else:
        targets = dict(recording.setup.targets)
        targets[second] = targets.pop(first)
        wrong = recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))
        first, second = second, first
    selection = identified(wrong)
    assert only_cause(selection) == ("names", (), (first, second))
    (test,) = cause_tests(selection)
    assert test.sentence.startswith(f"The reference coordinates of {first} are those of {second}:")
    assert test.sentence[:-1] in str(lt.check(wrong)).splitlines()[0]
    adjusted = lt.adjust(wrong)
    assert adjusted.adjustment is not None
    assert not adjusted.adjustment.rejected_references
    assert adjusted.fit.chi2 < 1.2 * adjusted.fit.dof


@pytest.mark.parametrize(
    ("observable", "size"), [("distance", 1e-4), *family([("elevation", 3e-5), ("distance", 0.02)])]
)
def test_a_constant_that_drifts_evenly_at_a_station(observable: str, size: float) -> None:
    recording, truth = hall()
    at = recording.station == 1
    elapsed = (recording.time - recording.time[at].min()) / np.ptp(recording.time[at])
    wrong = shifted(recording, at, OBSERVABLES.index(observable), (size * elapsed)[at])
    selection = identified(wrong)
    assert only_cause(selection) == ("constant-drift", ("S2",), ())
    (test,) = [t for t in cause_tests(selection) if t.accepted and t.kind != "outlier"]
    assert test.acts_on == observable
    unit = 1e-3 if observable == "distance" else ARCSECOND
    assert test.estimate == pytest.approx(size / unit, abs=5.0 * test.sigma)
    assert "drifted by" in test.sentence
    assert np.allclose(selection.fit.state.target_points, truth.state.target_points, atol=1e-4)


@pytest.mark.parametrize(("observable", "size"), [("elevation", 1.5e-5), ("azimuth", 1.5e-5), ("distance", 6e-5)])
def test_a_constant_that_drifts_evenly_at_all_stations(observable: str, size: float) -> None:
    recording, truth = hall()
    time = recording.time - np.array([recording.time[recording.station == s].min() for s in recording.station])
    wrong = shifted(recording, np.ones(len(time), bool), OBSERVABLES.index(observable), size * time / time.max())
    selection = identified(wrong)
    assert only_cause(selection) == ("constant-drift", (), ())
    (test,) = [t for t in cause_tests(selection) if t.accepted and t.kind != "outlier"]
    assert (test.acts_on, recommendation_for_cause(test)) == (
        observable,
        "Let the tracker reach its operating temperature, and measure all set-ups again.",
    )
    assert abs(test.estimate) == pytest.approx(
        size / (1e-3 if observable == "distance" else ARCSECOND), abs=5.0 * test.sigma
    )
    assert np.allclose(selection.fit.state.target_points, truth.state.target_points, atol=1e-4)


@pytest.mark.parametrize(("observable", "size"), [("elevation", 3e-5), ("distance", 1e-4)])
def test_a_constant_that_changes_once_at_a_station_and_all_later_ones(observable: str, size: float) -> None:
    recording, _ = hall()
    begin = float(np.median(recording.time[recording.station == 1]))
    wrong = shifted(recording, recording.time >= begin, OBSERVABLES.index(observable), size)
    selection = identified(wrong)
    assert only_cause(selection) == ("constant-step", (), ())
    (test,) = [t for t in cause_tests(selection) if t.accepted and t.kind != "outlier"]
    assert f"The {observable}s from all stations changed by" in test.sentence


def test_a_station_that_moves_evenly_is_no_drift_of_a_constant() -> None:
    recording, truth = hall()
    at = recording.station == 1
    elapsed = np.where(at, (recording.time - recording.time[at].min()) / np.ptp(recording.time[at]), 0.0)
    motion = elapsed[:, None] * np.array([2e-4, -1e-4, -3e-4, 2e-5, 0.0, 0.0])
    change = reading_change_by_station_motion(sightings_at_state(recording, truth.state), motion)
    selection = identified(recording.with_readings(recording.readings + change))
    assert only_cause(selection) == ("station-drift", ("S2",), ())


@pytest.mark.parametrize("size", [1e-3, 10.0])
def test_a_reference_point_that_is_off(size: float) -> None:
    recording, truth = hall()
    targets = dict(recording.setup.targets)
    off = np.array(targets["T12"].known_mm) + 1e3 * size * np.array([0.6, 0.0, -0.8])
    targets["T12"] = targets["T12"].model_copy(update={"known_mm": tuple(off.tolist())})
    wrong = recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))
    selection = identified(wrong)
    assert only_cause(selection) == ("reference-value", (), ("T12",))
    (test,) = [t for t in cause_tests(selection) if t.accepted]
    assert finding_title(cause_test_finding(test)) == "an error of the reference coordinates"
    assert np.allclose(selection.fit.state.target_points, truth.state.target_points, atol=2e-4)


@pytest.mark.parametrize("size", family([3e-4, 0.02]))
def test_a_station_that_moved_in_mid_work(size: float) -> None:
    recording, truth = hall()
    rows = np.flatnonzero(recording.station == 1)
    motion = np.zeros((len(recording), 6))
    motion[rows[len(rows) // 2 :], :2] = [0.8 * size, -0.6 * size]
    change = reading_change_by_station_motion(sightings_at_state(recording, truth.state), motion)
    selection = identified(recording.with_readings(recording.readings + change))
    assert only_cause(selection) == ("station-bump", ("S2",), ())
    (test,) = [t for t in cause_tests(selection) if t.kind == "station-bump"]
    assert test.estimate == pytest.approx(1e3 * size, abs=0.1)
    middle = len(rows) // 2
    assert f"(rows {rows[middle - 1] + 1} and {rows[middle] + 1})" in test.sentence


@pytest.mark.parametrize("gaps", family([-6, 3, -3, 6], 1))
def test_the_moment_of_a_large_motion_is_corrected_in_the_fit(gaps: int) -> None:
    """The score of a moment is linear, so that the motion of a distorted network may be accepted at a wrong one."""
    recording, _ = network(seed=5)
    times = np.unique(recording.time[recording.station == 2])
    between = 0.5 * (times[1:] + times[:-1])
    bump = StationBump((recording.stations[2],), time=float(between[len(between) // 2]))
    change = bump.reading_change(adjust(recording).sightings, np.array([0.02, -0.01, 0.006, 0.0, 0.0, 0.0]))
    right = select_causes(
        FitInput(recording.with_readings(recording.readings + change), declared_construction(recording))
    ).fit
    (hypothesis,) = right.hypotheses
    elsewhere = bump.with_shape_parameters(time=float(between[len(between) // 2 + gaps]))
    wrong = NetworkFit.from_start(
        right.fit_input, (replace(hypothesis, model_change=replace(hypothesis.model_change, effect=elsewhere)),)
    )
    assert wrong is not None and wrong.log_evidence < right.log_evidence - 100.0
    corrected = refine_motion_time(wrong)
    assert corrected.hypotheses[0].model_change.effect.time == bump.time
    assert corrected.log_evidence == pytest.approx(right.log_evidence, abs=1e-3)


def test_a_target_that_moved_between_two_stations() -> None:
    recording, truth = hall()
    motion = np.zeros((len(recording), 3))
    motion[(recording.target == 4) & (recording.station >= 2)] = [1e-3, 0.0, 2e-3]
    change = reading_change_by_displacement(sightings_at_state(recording, truth.state), motion)
    selection = identified(recording.with_readings(recording.readings + change))
    assert only_cause(selection) == ("target-moved", (), ("T05",))
    sentence = cause_tests(selection)[0].sentence
    match = re.match(
        r"Target T05 moved between (\S+) s and (\S+) s \(rows (\d+) and (\d+)\), by \S+ \+- \S+ mm "
        r"\(dx (\S+) \+- \S+, dy (\S+) \+- \S+, dz (\S+) \+- \S+ mm\)\. The coordinates of T05 refer to the time ",
        sentence,
    )
    assert match is not None, sentence
    before, after = int(match[3]) - 1, int(match[4]) - 1
    assert recording.station[before] < 2 <= recording.station[after]
    assert [float(match[1]), float(match[2])] == pytest.approx(recording.time[[before, after]], abs=0.05)
    assert [float(match[k]) for k in (5, 6, 7)] == pytest.approx([1.0, 0.0, 2.0], abs=0.1)
    free_targets = {name: Target() for name in CONTROL}
    free_setup = recording.setup.model_copy(update={"targets": {**recording.setup.targets, **free_targets}})
    free = identified(recording.replace(readings=recording.readings + change, setup=free_setup))
    assert " mm along the axes of S1). The coordinates" in cause_tests(free)[0].sentence
    without_clock = identified(recording.replace(readings=recording.readings + change, has_clock=False))
    assert f"moved between rows {before + 1} and {after + 1}, by" in cause_tests(without_clock)[0].sentence


@pytest.mark.parametrize("angle", family([1e-3, 0.5]))
def test_a_circle_that_was_turned_in_mid_work(angle: float) -> None:
    recording, _ = hall()
    rows = np.flatnonzero(recording.station == 0)
    wrong = shifted(recording, rows[len(rows) // 2 :], 1, angle)
    kind, stations, _ = only_cause(identified(wrong))
    assert stations == ("S1",)
    assert kind in ("orientation", "station-bump")  # a station that is turned turns its circle with it


@pytest.mark.parametrize("distance_mm", [0.0, 1.0])
def test_exchanged_names_are_put_right(distance_mm: float) -> None:
    """Also with the noise of a total station, which is larger than errors of trackers."""
    recording, _ = hall()
    noise = recording.setup.instrument.noise
    noise = noise.model_copy(update={"distance_mm": np.hypot(noise.distance_mm, distance_mm)})
    instrument = recording.setup.instrument.model_copy(update={"noise": noise})
    recording = recording.replace(setup=recording.setup.model_copy(update={"instrument": instrument}))
    errors = np.random.default_rng(1).normal(size=len(recording)) * 1e-3 * distance_mm
    recording = shifted(recording, np.arange(len(recording)), 0, errors)
    target = recording.target.copy()
    rows = recording.station == 3
    target[rows & (recording.target == 2)], target[rows & (recording.target == 9)] = 9, 2
    selection = identified(recording.replace(target=target))
    assert only_cause(selection) == ("names", ("S4",), ("T03", "T10"))
    assert np.array_equal(
        apply_corrections_and_omissions(recording.replace(target=target), selection.fit.hypotheses).target,
        recording.target,
    )


@pytest.mark.parametrize("size", [1e-3, 20.0])
def test_a_single_bad_reading_is_an_outlier_and_no_cause(size: float) -> None:
    recording, _ = hall()
    selection = identified(shifted(recording, 40, 0, size))
    assert selection.selected_hypotheses == ()
    (test,) = [t for t in cause_tests(selection) if 41 in t.rows]
    assert test.kind == "outlier"
    assert test.estimate == pytest.approx(1e3 * size, abs=0.1)


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_noise_other_than_declared(factor: float) -> None:
    recording, _ = hall()
    noise = recording.setup.instrument.noise
    fields = ("distance_mm", "distance_ppm", "azimuth_arcsec", "elevation_arcsec")
    other = noise.model_copy(update={name: getattr(noise, name) / factor for name in fields})
    instrument = recording.setup.instrument.model_copy(update={"noise": other})
    selection = identified(recording.replace(setup=recording.setup.model_copy(update={"instrument": instrument})))
    assert only_cause(selection) == ("noise-level", (), ())
    (test,) = [t for t in cause_tests(selection) if t.kind == "noise-level"]
    assert test.estimate == pytest.approx(factor, rel=0.1)
    assert not selection.requires_adjustment_with_causes


def test_distances_are_put_aside_at_places_that_stand_out_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, _ = hall()
    fit = NetworkFit.from_start(FitInput(recording, misalignment_construction()))
    assert fit is not None
    every = shift_candidates(fit.adjustment.sightings)
    for gross, stations in ((recording.station == 1, {1}), (recording.station < 3, set[int]())):
        tried: list[Ints] = []
        monkeypatch.setattr(screening, "_fit_without_distances", lambda _, rows, tried=tried: tried.append(rows))
        marked = SimpleNamespace(
            is_outlier=np.repeat(gross[:, None], 3, axis=1),
            is_gross_reading=np.ones((len(recording), 3), dtype=bool),
            problem_with_all_readings=fit.problem_with_all_readings,
        )
        assert _distance_trial_hypotheses(marked, every) == []  # type: ignore[arg-type]
        assert {int(s) for rows in tried for s in recording.station[rows]} == stations


def test_two_causes_at_once() -> None:
    recording, _ = hall()
    wrong = shifted(shifted(recording, recording.target == 7, 0, 12.7e-3), recording.station == 2, 0, 2e-3)
    places = {(c.hypothesis.stations, c.hypothesis.targets) for c in identified(wrong).selected_hypotheses}
    assert places == {((), ("T08",)), (("S3",), ())}


@pytest.mark.long
def test_commands_report_the_same_for_a_single_cause() -> None:
    recording, truth = hall()
    wrong = shifted(recording, recording.target == 7, 0, 12.7e-3)
    adjusted, calibrated, checked = lt.adjust(wrong), lt.calibrate(wrong, advise=False), lt.check(wrong)
    diagnosed = lt.diagnose(wrong, held_out=False)
    first = {adjusted.tests[0].sentence, calibrated.tests[0].sentence, checked.tests[0].sentence}
    assert first == {diagnosed.findings[0].sentence}
    assert not checked.passed
    assert checked.sentence.startswith("no-go: The distances to T08")
    assert "T08" in (adjusted.verdict.sentence if adjusted.verdict else "")
    for points in (adjusted.target_points, calibrated.target_points, diagnosed.targets.points):
        assert np.allclose(points, truth.state.target_points, atol=2e-4)


def test_a_robust_state_is_not_bent_by_a_reference_point_that_is_far_off() -> None:
    recording, truth = hall()
    wrong = identified(recording).fit.problem_with_all_readings
    control = wrong.control_rows
    points = control.declared_points.copy()
    points[1] += 5.0
    bent = replace(wrong, control_rows=replace(control, declared_points=points))
    positions, rotations, targets = initial_network(recording)[0]
    start = replace(
        truth.state,
        station_positions=positions,
        station_rotations=rotations,
        target_points=targets,
        instrument_parameters=np.zeros((1, 16)),
    )
    state, _ = fit_robust_state(bent, start)
    assert np.allclose(state.target_points, truth.state.target_points, atol=2e-4)


def test_alignment_survives_any_error_of_a_point_among_four() -> None:
    source = np.array([[0.0, 0.0, 0.0], [6.0, 0.0, 1.0], [5.0, 7.0, 0.0], [0.0, 6.0, 3.0]])
    turn, shift = rotation_about_z(0.7), np.array([1.0, -2.0, 0.3])
    goal = source @ turn.T + shift
    for off in (0.01, 1.0, 100.0):
        wrong = goal.copy()
        wrong[2, 0] += off
        rotation, translation = align_robustly(source, wrong)
        assert np.abs(source @ rotation.T + translation - goal).max() < 0.02 * off


def test_the_occam_factor_is_the_integral_over_all_sizes() -> None:
    w, sizes = 9.0, np.geomspace(1e-3, 1e3, 400_001)
    likelihood = np.exp(-0.5 * (w - sizes) ** 2) + np.exp(-0.5 * (w + sizes) ** 2)
    integral = np.trapezoid(0.5 * likelihood, np.log(sizes)) / np.exp(LOG_OF_LOG_SIZE_PRIOR_WIDTH)
    assert float(log_occam_factor_of_shift(w, 1)) == pytest.approx(np.log(integral), abs=0.02)


def test_a_variance_factor_is_estimated_where_the_noise_has_it() -> None:
    draw = random_stream(5, "noise").normal(size=(200, 300)) * 2.0
    squares = np.sum(draw**2, axis=1)
    factor, gain = estimate_noise_factors_of_groups(squares, np.full(200, 300.0))
    assert np.mean(factor) == pytest.approx(2.0, rel=0.01)
    assert np.all(gain + log_occam_factor_of_variance(300.0) > 50.0)
    quiet, nothing = estimate_noise_factors_of_groups(np.array([300.0]), np.array([300.0]))
    assert quiet == pytest.approx(1.0)
    assert nothing == pytest.approx(0.0)


SMRS = [
    (12.7, "a 1.5 inch SMR in place of a 0.5 inch one"),
    (-12.7, "a 0.5 inch SMR in place of a 1.5 inch one"),
    (-7.94, "a 7/8 inch SMR in place of a 1.5 inch one"),
]


@pytest.mark.parametrize(("size", "sentence"), SMRS)
def test_the_sign_says_which_smr_was_used(size: float, sentence: str) -> None:
    assert smr_exchange_text(1e-3 * size + 1e-5, 1e-5) == sentence
    assert smr_exchange_text(1e-3 * size + 1e-4, 1e-5) == smr_exchange_text(1e-3 * size, 1e-4) == ""


@pytest.mark.long
@pytest.mark.parametrize(("size", "sentence"), SMRS[::2])
def test_another_smr_at_a_station_comes_before_the_noise_that_it_leaves(size: float, sentence: str) -> None:
    """Nests are declared on a floor plan: what the rest of its tilt makes of so large an offset scatters."""
    effect = {"name": "smr-offset", "stations": ["S4"], "values": {"radius-difference": size}}
    recording, _ = lt.simulate("paper-workshop-two-face", seed=21, changes={"effects": [effect]})
    first, *others = cause_tests(identified(recording))
    assert (first.kind, first.where.stations) == ("reflector-radius", ("S4",))
    assert first.estimate == pytest.approx(size, abs=0.05)
    assert sentence in first.sentence
    assert ("away from" in first.sentence) == (size > 0)
    remaining = [test.kind for test in others if test.accepted and test.kind != "outlier"]
    assert remaining in ([], ["noise-level"], ["centring"])
    assert sentence in lt.check(recording).sentence


def test_a_reference_value_of_a_set_up_without_readings_has_no_misclosure() -> None:
    fit = NetworkFit.from_start(FitInput(hall()[0], misalignment_construction()))
    assert fit is not None
    sigma = np.full(2, 1e-5)
    value = ReferenceValue("level", "S2", "", sigma, np.zeros(2))  # the network has no row for it
    np.testing.assert_array_equal(fit.misclosure_of(value), np.zeros(2))


def test_misclosures_in_a_network_with_estimated_centring_errors() -> None:
    recording = hall()[0]
    centring = (CentringUncertainty(sigma_mm=0.01, stations=("S2",)),)
    declared = recording.replace(setup=recording.setup.model_copy(update={"centring": centring}))
    fit = NetworkFit.from_start(FitInput(declared, misalignment_construction()))
    assert fit is not None
    value = next(v for v in reference_values(fit.problem, fit.state) if v.kind == "point")
    misclosures = replace(fit, fit_input=replace(fit.fit_input, recording=recording)).misclosure_of(value)
    np.testing.assert_allclose(misclosures, fit.misclosure_of(value), atol=1e-15)


def test_noise_factors_of_common_readings_are_estimated_together() -> None:
    """All readings are 2 times as noisy as declared, the distances 0.5 times of that."""
    squares = np.tile([1.0, 4.0, 4.0], (1000, 1))
    everything = np.ones(squares.shape, dtype=bool)
    factors = estimate_noise_factors(squares, np.ones(squares.shape), [everything, everything & (np.arange(3) == 0)])
    np.testing.assert_allclose(factors, np.tile([1.0, 2.0, 2.0], (1000, 1)), rtol=0.02)


def test_larger_noise_of_an_observable_with_smaller_noise_of_another_is_reported() -> None:
    """Neither verb gave an advice, and `check` reported motions and outliers instead."""
    recording = network(faces=2, seed=21)[0]
    adjusted = adjust(recording)
    noise = random_stream(22, "noise").standard_normal(recording.readings.shape) * recording.reading_sigmas()
    exact = adjusted.problem.model.predict(adjusted.state)
    changed = recording.with_readings(exact + noise * [3.0, 1.0, 0.3])
    checked, result = lt.check(changed), lt.adjust(changed)
    assert result.verdict.case == "larger noise"
    for setting in ("distance_mm", "elevation_arcsec"):
        assert f"set {setting} to" in result.verdict.sentence
    assert "set distance_mm to" in checked.sentence
    assert [item.kind for item in checked.items if not item.passed and item.kind != "closure"] == []


def test_noise_of_the_angles_is_reported_with_the_settings_to_declare() -> None:
    recording = network(faces=2, seed=21)[0]
    extra = (
        np.sqrt(2.4**2 - 1.0)
        * recording.reading_sigmas()
        * random_stream(22, "noise").standard_normal(recording.readings.shape)
    )
    noisy = recording.with_readings(recording.readings + extra * [0.0, 1.0, 1.0])
    result = lt.check(noisy)
    (test,) = (test for test in result.tests if test.accepted)
    assert (test.kind, test.acts_on) == ("noise-level", "angles")
    assert test.estimate == pytest.approx(2.4, rel=0.1)
    noise = noisy.setup.instrument_named(noisy.instruments[0]).noise
    (declared,) = re.findall(r"azimuth_arcsec to ([0-9.]+)", result.sentence)
    assert float(declared) == pytest.approx(test.estimate * noise.azimuth_arcsec, rel=0.02)
    assert [item.kind for item in result.items if not item.passed] == ["closure"]
