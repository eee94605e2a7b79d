"""A simple cause in a recording: check, adjust, calibrate and diagnose name it first, at the same place."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.fieldcheck import Check
from ltsim.adjustment.identification.reading_shifts import ReadingShift
from ltsim.calibration.calibration import Calibration
from ltsim.core.arrays import Ints
from ltsim.core.units import ARCSECOND
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.physics.effects.motions import reading_change_by_displacement
from ltsim.recordings.recording import Recording
from ltsim.reports.sections import result_section
from tests.families import family
from tests.networks import mesh, network

Place = tuple[tuple[str, ...], tuple[str, ...]]
"""Stations and targets at which a cause acts."""
Cause = Callable[[float], tuple[Recording, Place]]
"""Recording with a cause of some size, and its place."""


@cache
def workshop() -> Recording:
    return network(faces=2, seed=23)[0]


def rows_of(station: str = "", target: str = "") -> Ints:
    recording = workshop()
    acts = np.ones(len(recording), dtype=bool)
    if station:
        acts &= recording.station == recording.stations.index(station)
    if target:
        acts &= recording.target == recording.targets.index(target)
    return np.flatnonzero(acts)


def longer(rows: Ints, offset: float = 0.0, scale: float = 0.0) -> Recording:
    """The recording with the distances of some rows longer by an offset [m] and a share."""
    readings = workshop().readings.copy()
    readings[rows, 0] += offset + scale * readings[rows, 0]
    return workshop().with_readings(readings)


def wrong_distance(size: float) -> tuple[Recording, Place]:
    return longer(rows_of("S2", "T07")[:1], offset=size), (("S2",), ("T07",))


def ball_at_a_target(size: float) -> tuple[Recording, Place]:
    return longer(rows_of(target="T07"), offset=size), ((), ("T07",))


def ball_at_a_station(size: float) -> tuple[Recording, Place]:
    return longer(rows_of("S3"), offset=size), (("S3",), ())


def scale_at_a_station(size: float) -> tuple[Recording, Place]:
    return longer(rows_of("S2"), scale=size / 5.0), (("S2",), ())


def badly_seated_reflector(size: float) -> tuple[Recording, Place]:
    """A reflector that is displaced by a size [m] while one station measures it in both faces."""
    rows = rows_of("S2", "T07")
    displacement = np.zeros((len(workshop()), 3))
    displacement[rows] = size * np.array([0.6, -0.64, 0.48])
    change = reading_change_by_displacement(adjust(workshop()).sightings, displacement)
    return workshop().with_readings(workshop().readings + change), (("S2",), ("T07",))


def badly_seated_reflector_in_face_1(size: float) -> tuple[Recording, Place]:
    """As `badly_seated_reflector`, with a single pointing of each sight."""
    recording, place = badly_seated_reflector(size)
    return recording.select(recording.face == 1), place


def ball_at_all_stations(size: float) -> tuple[Recording, Place]:
    return longer(np.arange(len(workshop())), offset=size), ((), ())


def scale_at_all_stations(size: float) -> tuple[Recording, Place]:
    """Right control points, and a scale error of all distances, of a size [m] at 5 m."""
    return with_control_points(longer(np.arange(len(workshop())), scale=size / 5.0), 0.0), ((), ())


def exchanged_names(size: float) -> tuple[Recording, Place]:
    recording, target = workshop(), workshop().target.copy()
    first, second = rows_of("S2", "T07"), rows_of("S2", "T15")
    target[first], target[second] = target[second[0]], target[first[0]]
    return recording.replace(target=target), (("S2",), ("T07", "T15"))


def index_at_a_station(size: float) -> tuple[Recording, Place]:
    """Elevations of one face of a recording, with another vertical index of 1 / 100 of the size [m] at a set-up."""
    recording = workshop().select(workshop().face == 1)
    readings = recording.readings.copy()
    readings[recording.station == recording.stations.index("S3"), 2] += size / 100.0
    return recording.with_readings(readings), (("S3",), ())


def changing_constant(observable: str, *, is_drift: bool) -> Cause:
    """Readings of one observable whose constant drifts, or changes once, by a size [m or 10 rad] at a set-up."""

    def cause(size: float) -> tuple[Recording, Place]:
        recording = workshop()
        middle = float(np.median(recording.time[rows_of("S2")]))
        effect = ReadingShift(
            observable,
            False,
            ("S2",),
            (),
            -np.inf if is_drift else middle,
            drift_interval="occupation" if is_drift else None,
        )
        amount = np.array([size if observable == "distance" else 0.1 * size])
        change = effect.reading_change(adjust(recording).sightings, amount)
        return recording.with_readings(recording.readings + change), (("S2",), ())

    return cause


def moved_target(size: float) -> tuple[Recording, Place]:
    """A target that stood elsewhere when the last two stations measured it."""
    recording = workshop()
    sightings = adjust(recording).sightings
    late = (recording.station >= 3) & (recording.target == recording.targets.index("T07"))
    displacement = late[:, None] * np.array([0.6, 0.5, -0.62]) * size
    changed = recording.readings + reading_change_by_displacement(sightings, displacement)
    return recording.with_readings(changed), ((), ("T07",))


def exchanged_reference_points(size: float) -> tuple[Recording, Place]:
    """Four control points, two with each other's coordinates."""
    recording, points = workshop(), 1e3 * mesh()
    order = {"T01": "T13", "T05": "T05", "T13": "T01", "T22": "T22"}
    targets = dict(recording.setup.targets)
    for name, of in order.items():
        place = tuple(points[recording.targets.index(of)].tolist())
        targets[name] = targets[name].model_copy(update={"known_mm": place})
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets})), ((), ("T01", "T13"))


@dataclass(frozen=True)
class Results:
    """Results of the four verbs for one recording."""

    check: Check
    adjust: Calibration
    calibrate: Calibration
    diagnose: Diagnosis

    @classmethod
    def of_recording(cls, recording: Recording) -> Results:
        calibration = lt.calibrate(recording, advise=False)
        return cls(lt.check(recording), lt.adjust(recording), calibration, lt.diagnose(recording, held_out=False))

    def first_places(self) -> dict[str, Place]:
        """Place of the first cause that each verb with coordinates accepts."""
        tests = {"adjust": self.adjust.tests, "calibrate": self.calibrate.tests}
        places = {verb: next(t.where for t in verb_tests if t.accepted) for verb, verb_tests in tests.items()}
        places["diagnose"] = self.diagnose.findings[0].where
        return {verb: (where.stations, where.targets) for verb, where in places.items()}


@cache
def results(cause: Cause, size: float) -> Results:
    """Results for a recording with a cause, computed once for all tests."""
    return Results.of_recording(cause(size)[0])


CAUSES = (wrong_distance, ball_at_a_target, ball_at_a_station, scale_at_a_station)

RUNGS = [
    pytest.param(badly_seated_reflector, 1e-3, id="badly_seated_reflector"),
    pytest.param(ball_at_all_stations, 3e-3, id="ball_at_all_stations", marks=pytest.mark.long),
    pytest.param(scale_at_all_stations, 3e-3, id="scale_at_all_stations", marks=pytest.mark.long),
    pytest.param(exchanged_names, 0.0, id="exchanged_names", marks=pytest.mark.long),
    pytest.param(exchanged_reference_points, 0.0, id="exchanged_reference_points"),
    pytest.param(changing_constant("elevation", is_drift=True), 3e-4, id="drift_of_elevation", marks=pytest.mark.long),
    *(
        pytest.param(
            changing_constant(observable, is_drift=is_drift),
            size,
            id=f"{'drift' if is_drift else 'step'}_of_{observable}-{size:g}",
            marks=pytest.mark.long,
        )
        for observable in ("distance", "elevation")
        for is_drift in (True, False)
        for size in (5e-4, 0.02, 2.0)
    ),
    *(
        pytest.param(cause, size, id=f"{cause.__name__}-{size:g}", marks=pytest.mark.long)
        for cause, sizes in {
            **dict.fromkeys(CAUSES, (2e-4, 5e-3, 0.3, 20.0)),
            index_at_a_station: (0.1, 5.0),
            moved_target: (1e-3, 0.05, 0.5),
            badly_seated_reflector: (2e-4, 0.02, 0.5),
            badly_seated_reflector_in_face_1: (1e-3,),
            ball_at_all_stations: (2e-4, 0.0175, 0.3),
        }.items()
        for size in sizes
    ),
]


@pytest.mark.parametrize(("cause", "size"), RUNGS)
def test_every_verb_names_a_simple_cause_first_at_its_place(cause: Cause, size: float) -> None:
    _, place = cause(size)
    expected = tuple(tuple(sorted(names)) for names in place)
    for verb, (stations, targets) in results(cause, size).first_places().items():
        assert (tuple(sorted(stations)), tuple(sorted(targets))) == expected, verb
    checked = results(cause, size).check
    assert not checked.passed
    assert all(name in checked.sentence for names in place for name in names)


DRIFTS_AT_ALL_STATIONS = [
    ("elevation", 1e-5, "index-drift"),
    ("azimuth", 1e-5, "azimuth-drift"),
    ("distance", 5e-5, "range-drift"),
]
"""Observable whose constant drifts at every station, its change [m or rad], and the catalogue effect."""


def test_every_verb_names_a_drift_of_the_distances_over_the_whole_recording() -> None:
    """Without this hypothesis the drift appears as steps, offsets and outliers at several stations."""
    recording = workshop()
    readings = recording.readings.copy()
    readings[:, 0] += 4e-4 * recording.time / recording.time.max()
    drifting = recording.with_readings(readings)
    outcomes = Results.of_recording(drifting)
    checked = outcomes.check
    assert "The distances from all stations drifted by" in checked.sentence
    assert "during the recording" in checked.sentence
    assert set(outcomes.first_places().values()) == {((), ())}
    for result in (outcomes.adjust, outcomes.calibrate):
        (cause,) = [test for test in result.tests if test.accepted]
        assert (cause.kind, cause.acts_on) == ("constant-drift", "distance")
        assert cause.estimate == pytest.approx(0.4, abs=5.0 * cause.sigma)
    assert outcomes.diagnose.findings[0].effect == "range-drift"


@pytest.mark.long
@pytest.mark.parametrize(("observable", "size", "effect"), DRIFTS_AT_ALL_STATIONS)
def test_every_verb_names_a_constant_that_drifts_at_all_stations(observable: str, size: float, effect: str) -> None:
    recording = workshop()
    change = ReadingShift(observable, drift_interval="occupation").reading_change(
        adjust(recording).sightings, np.array([size])
    )
    drifting = recording.with_readings(recording.readings + change)
    outcomes = Results.of_recording(drifting)
    checked = outcomes.check
    assert not checked.passed
    assert f"The {observable}s from all stations drifted by" in checked.sentence
    assert set(outcomes.first_places().values()) == {((), ())}
    for result in (outcomes.adjust, outcomes.calibrate):
        (cause,) = [test for test in result.tests if test.accepted]
        assert (cause.kind, cause.acts_on) == ("constant-drift", observable)
        assert cause.estimate == pytest.approx(size / (1e-3 if observable == "distance" else ARCSECOND), rel=0.3)
    assert outcomes.diagnose.findings[0].effect == effect


def test_every_verb_gives_the_settings_for_noise_declared_too_small() -> None:
    recording = workshop()
    noise = recording.setup.instrument.noise
    quieter = noise.model_copy(
        update={name: value / 2.5 for name, value in noise.model_dump().items() if "arcsec" in name}
    )
    instrument = recording.setup.instrument.model_copy(update={"noise": quieter})
    declared = recording.replace(setup=recording.setup.model_copy(update={"instrument": instrument}))
    sentence = lt.check(declared).sentence
    (setting,) = re.findall(
        r"set azimuth_arcsec to [0-9.]+, elevation_arcsec to [0-9.]+ in \[instrument.noise\]", sentence
    )
    for result in (lt.adjust(declared), lt.calibrate(declared, advise=False)):
        assert result.verdict.case == "larger noise"
        assert setting in result.verdict.sentence
        assert "systematic effect" not in result.verdict.sentence
        assert setting in result_section(result).summary
        assert not any("ltsim diagnose" in action for action in result_section(result).next_actions)


def test_a_target_that_moved_is_in_the_model_of_a_calibration() -> None:
    _, (_, targets) = moved_target(1e-3)
    calibrated = results(moved_target, 1e-3).calibrate
    assert calibrated.fit.chi2 < 1.2 * calibrated.fit.dof
    assert calibrated.fit.dof == lt.calibrate(workshop(), advise=False).fit.dof - 3
    assert f"The model corrects 1 error at {targets[0]}, with 3 degrees" in result_section(calibrated).terminal_text()


def test_every_verb_says_to_which_time_the_coordinates_of_a_moved_target_refer() -> None:
    _, (_, targets) = moved_target(1e-3)
    sentence = f"The coordinates of {targets[0]} refer to the time before the motion."
    outcomes = results(moved_target, 1e-3)
    for result in (outcomes.adjust, outcomes.calibrate, outcomes.check, outcomes.diagnose):
        section = result_section(result)
        assert sentence in section.terminal_text(), type(result)
        assert sentence in result.text(), type(result)


def with_control_points(recording: Recording, error_mm: float) -> Recording:
    """The recording with six control points, of which T13 has a wrong coordinate."""
    targets = dict(recording.setup.targets)
    for name in ("T01", "T05", "T10", "T13", "T19", "T22"):
        x, y, z = (1e3 * mesh()[recording.targets.index(name)]).tolist()
        place = (x, y + error_mm * (name == "T13"), z)
        targets[name] = targets[name].model_copy(update={"known_mm": place, "known_sigma_mm": 0.02})
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))


@pytest.mark.parametrize("other_cause", [None, ball_at_a_target, moved_target])
def test_only_what_the_model_contains_is_called_corrected(other_cause: Cause | None) -> None:
    recording, (_, places) = (workshop(), ((), ())) if other_cause is None else other_cause(1e-3)
    recording = with_control_points(recording, 2.0)
    for result in (lt.adjust(recording), lt.calibrate(recording, advise=False)):
        assert result.adjustment is not None
        used = result.adjustment.problem.control_rows.point_indices
        is_used = recording.targets.index("T13") in used.tolist()
        (test,) = (t for t in result.tests if t.kind == "reference-value")
        assert test.is_in_model == (not is_used)
        text = result_section(result).terminal_text()
        assert ("This result still uses this value" in text) == is_used
        assert "ltsim calibrate" not in text.split("Verdict")[0]
        corrected = ["T13"] * (not is_used) + list(places)
        count = f"The model corrects {len(corrected)} error{'s' if len(corrected) > 1 else ''} at "
        assert count in text and all(name in text for name in corrected)


@pytest.mark.parametrize(
    ("name", "error_mm"),
    [("T01", (0.3, 0.0, 0.0)), *family([("T01", (0.0, 2.0, 0.0)), ("T13", (30.0, -40.0, 0.0))], 2)],
)
def test_a_wrong_control_point_among_three_is_the_same_in_every_command(name: str, error_mm: tuple[float, ...]) -> None:
    """Without the wrong point a rotation was free: 2 mm were reported as 5 m, or the right points as wrong."""
    recording = workshop()
    targets = dict(recording.setup.targets)
    for control in ("T01", "T13", "T22"):
        place = 1e3 * mesh()[recording.targets.index(control)] + np.array(error_mm) * (control == name)
        targets[control] = targets[control].model_copy(
            update={"known_mm": tuple(place.tolist()), "known_sigma_mm": 0.01}
        )
    recording = recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))
    sentences = [
        sorted(item.sentence for item in lt.check(recording).items if item.kind == "reference" and not item.passed)
    ]
    for result in (lt.adjust(recording), lt.calibrate(recording, advise=False)):
        assert result.adjustment is not None
        sentences.append(sorted(test.sentence for test in result.adjustment.rejected_references))
        (test,) = (t for t in result.tests if t.accepted and t.kind != "outlier")
        assert name in (*test.where.targets, *(n for other in test.alternatives for n in other.where.targets))
        assert all(n in test.sentence for other in test.alternatives for n in other.where.targets)
        assert test.estimate < 1.1 * np.linalg.norm(error_mm) + 0.05  # type: ignore[operator]
    assert sentences[0] and sentences[0] == sentences[1] == sentences[2]


def test_the_error_of_a_reference_value_has_the_same_standard_deviation_everywhere() -> None:
    recording = with_control_points(workshop(), 2.0)
    result = lt.adjust(recording)
    assert result.adjustment is not None
    (rejected,) = result.adjustment.rejected_references
    (test,) = (t for t in lt.diagnose(recording, held_out=False).tests if t.kind == "reference-value")
    size, sigma = (float(text) for text in rejected.error_text.removesuffix(" mm").split(" +- "))
    assert size == pytest.approx(test.estimate, rel=2e-3)
    assert sigma == pytest.approx(test.sigma, rel=0.05)


@pytest.mark.parametrize("cause", [exchanged_reference_points, *family([exchanged_names], 0)])
def test_every_verb_gives_the_same_advice_on_exchanged_names(cause: Cause) -> None:
    _, (stations, targets) = cause(0.0)
    outcomes = results(cause, 0.0)
    answers = (outcomes.check, outcomes.adjust, outcomes.calibrate, outcomes.diagnose)
    (advice,) = {result_section(result).next_actions[0] for result in answers}
    assert all(name in advice for name in (*stations, *targets))


def test_a_cause_without_which_no_network_fits_is_written_and_read(tmp_path: Path) -> None:
    _, (_, targets) = exchanged_reference_points(0.0)
    folder = tmp_path / "adjusted"
    lt.write(results(exchanged_reference_points, 0.0).adjust, folder)
    first = lt.read(folder).tests[0]
    assert (first.kind, first.acts_on, first.where.targets) == ("names", "point", targets)


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_noise_below_the_declared_does_not_conceal_a_wrong_constant(factor: float) -> None:
    """The distances of one set-up are 0.25 mm too long; the declared noise is right, or twice as large."""
    recording, _ = lt.simulate("paper-workshop-two-face", seed=3)
    readings = recording.readings.copy()
    readings[recording.station == 1, 0] += 0.25e-3
    noise = recording.setup.instrument.noise
    louder = noise.model_copy(update={name: factor * value for name, value in noise.model_dump().items()})
    instrument = recording.setup.instrument.model_copy(update={"noise": louder})
    wrong = recording.with_readings(readings).replace(
        setup=recording.setup.model_copy(update={"instrument": instrument})
    )
    assert "The distances from S2 are 0.24" in lt.check(wrong).sentence
    calibrated = lt.calibrate(wrong)
    assert calibrated.noise_estimated == (factor > 1.0)
    assert "The distances from S2 are 0.24" in result_section(calibrated).terminal_text()
    assert calibrated.fit.chi2 < 1.2 * calibrated.fit.dof
