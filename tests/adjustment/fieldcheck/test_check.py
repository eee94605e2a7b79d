"""Go or no-go: what is wrong is named with its place and time, what is right passes, at the stated rate."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import ltsim as lt
from ltsim.adjustment.estimate import adjust
from ltsim.adjustment.fieldcheck import Check, check
from ltsim.adjustment.fieldcheck.check import best_fitting_bump
from ltsim.adjustment.fieldcheck.sentences import number_text
from ltsim.adjustment.fieldcheck.setup_model import SetupModel, two_face_pairs
from ltsim.adjustment.reliability import neg_log_p_chi2
from ltsim.cli.check import parse_mpe, wait_for_changes, watch_recording
from ltsim.cli.main import run
from ltsim.cli.options import ReadingOptions
from ltsim.cli.terminal import Terminal
from ltsim.core.errors import NetworkError, RecordError
from ltsim.core.randomness import random_stream
from ltsim.core.units import ARCSECOND
from ltsim.physics.effects.motions import reading_change_by_station_motion
from ltsim.physics.model.construction import misalignment_construction, steering_mirror_construction
from ltsim.recordings import Hints, Recording, read, write
from ltsim.recordings.setup import Instrument, Station
from ltsim.reports.figures.points import field_check_figure
from ltsim.reports.style import svg_text
from tests.families import family
from tests.networks import drawn, network


def visits(seed: int, *, stations: int = 1, values: float = 0.0) -> Recording:
    """Both faces of every target, face 1 first, in one mixed order from each station; a pointing every 10 s."""
    errors = values * np.array([p.prior_sigma for p in misalignment_construction().parameters])
    recording, _ = network(faces=2, seed=seed, stations=stations, values=errors)
    mixed = random_stream(1, "order").permutation(len(recording.targets))
    order = np.lexsort((mixed[recording.target], recording.face, recording.station))
    return recording.select(order).replace(time=10.0 * np.arange(len(recording)), has_clock=True)


def moved(recording: Recording, station: int, time: float, motion: list[float]) -> Recording:
    """The recording with a station that stands elsewhere from a time on [m, rad]."""
    rows = recording.station == station
    visit = SetupModel.from_recording(recording.select(rows), misalignment_construction())
    after = recording.time[rows] >= time
    readings = recording.readings.copy()
    readings[rows] += reading_change_by_station_motion(visit.sightings, after[:, None] * np.array(motion))
    return recording.with_readings(readings)


def kinds(result: Check) -> set[tuple[str, str]]:
    return {(item.station, item.kind) for item in result.items if not item.passed}


def test_a_tracker_within_its_guarantee_is_a_go() -> None:
    """Two-face differences of several times the noise are no fault where the maker guarantees no less."""
    result = check(visits(3, stations=2, values=0.7))
    assert result.passed, result.sentence
    faces = result.arrays.setup_checks[0].two_face_differences
    assert faces is not None
    assert np.sqrt(np.mean((faces.uncorrected_pairs.half_differences / faces.half_difference_sigmas) ** 2)) > 3
    assert result.sentence == "go: 2 set-ups within noise and specification"
    assert {item.kind for item in result.items} >= {"two-face", "gross", "bump", "drift", "closure", "network"}


def test_false_alarms_come_at_the_declared_rate() -> None:
    """30 clean set-ups at 50 %: Bonferroni alarms at most so often, and does not sleep either."""
    alarms = sum(not check(visits(seed, values=0.7), level=0.5).passed for seed in range(30))
    assert 1 <= alarms <= stats.binom.ppf(0.999, 30, 0.5)


def test_a_bump_is_dated_within_its_gap() -> None:
    """One set-up: somebody touches the tripod between the pointings at 300 and 310 s."""
    clean = visits(4, values=0.5)
    start = clean.setup.model_copy(update={"started": "2026-03-04T11:55:00"})
    result = check(moved(clean.replace(setup=start), 0, 305.0, [40e-6, -30e-6, 10e-6, 0.0, 12e-6, 20e-6]))
    assert kinds(result) == {("S1", "bump")}
    item = next(item for item in result.items if item.kind == "bump")
    assert item.motion_interval_s == (300.0, 310.0)
    assert item.rows == (31, 32)
    assert item.p_value is not None
    assert item.p_value < 1e-6
    gap = "between 2026-03-04 12:00:00 and 2026-03-04 12:00:10 (rows 31 and 32)"
    assert f"no-go: S1 moved {gap}: shifted by " in result.sentence


def test_a_gross_pointing_is_named_and_nothing_else() -> None:
    recording = visits(5, stations=2, values=0.5)
    readings = recording.readings.copy()
    readings[70, 0] += 80e-6
    result = check(recording.with_readings(readings))
    assert ("S2", "gross") in kinds(result)
    assert kinds(result) <= {("S2", "gross"), ("", "network")}
    item = next(item for item in result.items if item.kind == "gross" and not item.passed)
    name = recording.targets[recording.target[70]]
    assert item.targets == (name,)
    twin = np.flatnonzero((recording.station == 1) & (recording.target == recording.target[70])) + 1
    assert item.rows[0] in twin  # two pointings of a target cannot tell which of them is wrong
    match = re.fullmatch(rf"S2 to {name}: rows (\d+) and (\d+) are ([\d.]+) um apart, .*: measure again", item.sentence)
    assert match is not None, item.sentence
    assert {int(match[1]), int(match[2])} == set(twin.tolist())
    assert float(match[3]) == pytest.approx(80.0, abs=4 * np.sqrt(2) * 1e6 * recording.reading_sigmas()[70, 0])


@pytest.mark.parametrize("metres", [0.15, 0.2, 1.0])
@pytest.mark.parametrize("rounds", [3, 20])
def test_a_large_error_of_a_single_distance_is_gross_and_no_instrument_constant(metres: float, rounds: int) -> None:
    """One set-up, one face; the columns of the instrument must not follow the reading that is wrong."""
    recording = visits(5)
    front = recording.select(np.flatnonzero(recording.face == 1)[:8])
    again = front.select(np.tile(np.arange(8), rounds))
    noise = random_stream(4, "repeated").standard_normal((8 * rounds, 3)) * again.reading_sigmas()
    readings = again.readings + noise
    readings[11, 0] -= metres
    again = again.replace(time=10.0 * np.arange(len(again)), repeat=np.arange(len(again)) // 8 + 1)
    result = check(again.with_readings(readings))
    assert not result.passed
    gross = next(item for item in result.items if item.kind == "gross")
    assert not gross.passed and gross.rows == (12,)


def test_creeping_is_called_drift() -> None:
    recording = visits(6, values=0.5)
    visit = SetupModel.from_recording(recording, misalignment_construction())
    share = recording.time / recording.time.max()
    creep = reading_change_by_station_motion(visit.sightings, share[:, None] * np.array([0, 0, 0, 25e-6, 0, 30e-6]))
    result = check(recording.with_readings(recording.readings + creep))
    assert ("S1", "bump") not in kinds(result)
    assert result.sentence.startswith("no-go: S1 drifts")
    index = recording.readings.copy()
    index[:, 2] += share * 6 * ARCSECOND
    result = check(recording.with_readings(index))
    assert ("S1", "instrument-drift") in kinds(result)
    sentence = next(item for item in result.items if item.kind == "instrument-drift").sentence
    drift = re.search(r"vertical index by (-?[\d.]+) \+- ([\d.]+) arcsec", sentence)
    assert drift is not None
    assert float(drift[1]) == pytest.approx(6.0, abs=4 * float(drift[2]))
    assert "positive: the readings grow with time" in sentence


def test_a_tripod_that_sinks_evenly_drifts_and_was_not_moved() -> None:
    clean = visits(6, values=0.5)
    recording = clean.replace(time=clean.time * (36 * 60 / clean.time.max()))
    visit, share = (
        SetupModel.from_recording(recording, misalignment_construction()),
        recording.time / recording.time.max(),
    )
    for millimetres in (0.05, 0.3, 2.0):
        sunk = reading_change_by_station_motion(
            visit.sightings, share[:, None] * np.array([0, 0, -1e-3 * millimetres, 0, 0, 0])
        )
        result = check(recording.with_readings(recording.readings + sunk))
        assert kinds(result) == {("S1", "drift")}
        assert result.sentence.startswith("no-go: S1 drifts in 36 min: shifted by")


@pytest.mark.parametrize("faces", [(1, 2), pytest.param((1,), marks=pytest.mark.long)])
def test_of_a_tripod_that_sinks_no_pointing_is_blamed(faces: tuple[int, ...]) -> None:
    """A network of three: neither two faces, nor scatter, nor pointings are named; one face is told by the others."""
    clean = visits(6, values=0.1, stations=3)
    rows = (clean.station == 0) & np.isin(clean.face, faces)
    share = clean.time[rows] / clean.time[rows].max()
    sunk, visit = (
        clean.readings.copy(),
        SetupModel.from_recording(clean.select(rows), misalignment_construction()),
    )
    sunk[rows] += reading_change_by_station_motion(visit.sightings, share[:, None] * np.array([0, 0, -2e-3, 0, 0, 0]))
    recording = clean.with_readings(sunk).select(np.isin(clean.face, faces))
    assert {kind for _, kind in kinds(check(recording))} == {"drift"}
    assert lt.adjust(recording).outliers == ()
    adjustment = lt.adjust(recording, robust=True)
    assert adjustment.outliers == ()
    assert adjustment.verdict is not None
    moved_by = re.match(r"Station S1 moves during its occupation, by ([\d.]+) \+- ", adjustment.verdict.sentence)
    assert moved_by is not None
    assert float(moved_by[1]) == pytest.approx(2000.0, rel=0.05)


@pytest.mark.parametrize("millimetres", family([0.1, 1.0]))
def test_a_bump_measured_in_a_single_face_is_reported_from_the_others_and_no_pointing_is_rejected(
    millimetres: float,
) -> None:
    """Eleven pointings before; nothing of the station was measured twice, so that only the network tells."""
    clean = visits(6, values=0.1, stations=3).select(visits(6, stations=3).face == 1)
    rows = clean.station == 0
    first = clean.select(rows)
    at = float(np.median(first.time))
    motion = (first.time > at)[:, None] * np.array([1e-3 * millimetres, 0, 0, 0, 0, 2e-5])
    bumped, visit = clean.readings.copy(), SetupModel.from_recording(first, misalignment_construction())
    bumped[rows] += reading_change_by_station_motion(visit.sightings, motion)
    recording = clean.with_readings(bumped)
    result = check(recording)
    assert kinds(result) == {("S1", "bump")}
    order = np.flatnonzero(rows)[np.argsort(first.time, kind="stable")]
    last = int(np.sum(first.time <= at))
    before, after = order[last - 1 : last + 1].tolist()
    times = f"{recording.time[before]:.1f} s and {recording.time[after]:.1f} s"
    between = f"Station S1 moved between {times} (rows {before + 1} and {after + 1}), by"
    size = re.match(rf"no-go: {re.escape(between)} ([\d.]+) \+- ([\d.]+) mm and ", result.sentence)
    assert size is not None, result.sentence
    assert float(size[1]) == pytest.approx(millimetres, abs=4 * float(size[2]))
    adjustment = lt.adjust(recording)
    assert adjustment.outliers == ()
    assert adjustment.verdict is not None
    assert adjustment.verdict.sentence.startswith(between)


def test_scatter_of_a_target_is_no_drift_of_the_station() -> None:
    """Poses of a robot, each watched without a break: they settle and scatter by themselves."""
    set_up = visits(4).select(np.arange(6))
    poses, shots = np.repeat(np.arange(6), 20), np.tile(np.arange(20), 6)
    rng = random_stream(3, "poses")
    settling = rng.standard_normal((6, 3))[poses] * (shots / 20)[:, None] * 12
    shaken = rng.standard_normal((120, 3)) * np.array([1, 2, 2, 3, 6, 12])[poses][:, None]
    recording = set_up.select(poses).replace(repeat=shots + 1, time=10.0 * np.arange(120))
    readings = recording.readings + (settling + shaken) * recording.reading_sigmas()
    result = check(recording.with_readings(readings))
    assert not kinds(result) & {("S1", "drift"), ("S1", "instrument-drift"), ("S1", "bump")}
    closure = next(item for item in result.items if item.kind == "closure")
    assert recording.targets[5] in closure.targets
    assert recording.targets[0] not in closure.targets
    assert "the targets cause this scatter" in result.sentence


def test_what_was_not_measured_again_has_no_value() -> None:
    """Two targets near each other on both faces: they tell no turn about the line through them, and no drift."""
    recording = visits(4)
    rows = np.flatnonzero((recording.face == 1) | np.isin(recording.target, [0, 1]))
    for seed in range(4):
        readings = recording.readings + recording.reading_sigmas() * random_stream(seed, "more").standard_normal(
            (len(recording), 3)
        )
        result = check(recording.with_readings(readings).select(rows))
        for item in result.items:
            assert not re.search(r"nan|inf|e\+|\d{4,} \+-|\+- \d{3,}", item.sentence), item.sentence


def test_never_go_where_adjust_refuses() -> None:
    recording = visits(3, stations=3)
    lost = (recording.station != 2) | (recording.target < 2)
    clockwise = recording.readings.copy()
    clockwise[recording.station == 1, 1] *= -1.0
    for broken in (recording.select(lost), recording.with_readings(clockwise)):
        with pytest.raises(NetworkError) as refused:
            lt.adjust(broken)
        result = check(broken)
        assert not result.passed
        assert ("", "network") in kinds(result)
        assert any(str(refused.value) in item.sentence for item in result.items)


def test_a_swap_is_called_a_swap_and_comes_first() -> None:
    recording = visits(5, stations=3)
    target = recording.target.copy()
    a, b = (int(np.flatnonzero((recording.station == 1) & (recording.target == t))[0]) for t in (3, 20))
    target[[a, b]] = target[[b, a]]
    result = check(recording.replace(target=target))
    assert result.items[0].kind == "mistake"
    assert sorted(result.items[0].rows) == sorted([a + 1, b + 1])
    assert result.sentence.startswith("no-go: At station S2 the reflectors T04 and T21")
    assert kinds(result) == {("S2", "mistake")}  # nobody else is blamed, not even their other pointings


def test_beyond_the_guarantee_and_beyond_a_limit() -> None:
    recording = visits(7)
    readings = recording.readings.copy()
    readings[recording.face == 2, 1] += 60 * ARCSECOND / np.cos(readings[recording.face == 2, 2])
    result = check(recording.with_readings(readings))
    assert kinds(result) == {("S1", "two-face")}
    assert "the two faces differ beyond noise and specification at 28 of 28 pairs" in result.sentence
    assert check(recording, mpe=(50, 10)).passed
    tight = check(recording, mpe=(1, 0.1))
    assert ("S1", "two-face") in kinds(tight)
    assert "beyond the limit" in tight.sentence


def test_scatter_is_judged_on_both_sides() -> None:
    recording = visits(8)
    noise = recording.setup.instrument.noise
    declared_noise = {"distance_mm": 0.2, "azimuth_arcsec": 2.0, "elevation_arcsec": 2.0}
    loud = recording.setup.instrument.model_copy(update={"noise": noise.model_copy(update=declared_noise)})
    result = check(recording.replace(setup=recording.setup.model_copy(update={"instrument": loud})))
    assert result.passed
    assert any("less than declared" in item.sentence for item in result.items)
    shaken = (
        recording.readings
        + random_stream(1, "shaken").standard_normal(recording.readings.shape) * 4 * recording.reading_sigmas()
    )
    assert ("S1", "closure") in kinds(check(recording.with_readings(shaken)))


def test_tests_that_pass_state_an_estimated_noise() -> None:
    """2.5 times the declared noise of the angles: what passes does so against the estimated noise, which is stated."""
    recording = network(seed=11, stations=4, faces=2)[0]
    extra = (
        2.3
        * recording.reading_sigmas()
        * random_stream(11, "angles").standard_normal((len(recording), 3))
        * [0.0, 1.0, 1.0]
    )
    result = check(recording.with_readings(recording.readings + extra))
    assert not result.passed
    tests = [item.sentence for item in result.items if "repeated pointings scatter" in item.sentence]
    tests += [item.sentence for item in result.items if "sigma0 is" in item.sentence]
    assert len(tests) == len(recording.stations) + 1
    for sentence in tests:
        match = re.search(
            r"; the estimated noise is (\S+) times the declared noise of azimuth and elevation$", sentence
        )
        assert match is not None, sentence
        assert float(match[1]) == pytest.approx(2.5, rel=0.1)
    assert not any("the declared noise (" in item.sentence for item in result.items)
    assert not any("estimated noise" in item.sentence for item in check(recording).items)


def levelled(recording: Recording, sigma: float) -> Recording:
    """The recording with every station said to follow its level, so well [arcsec]."""
    stations = {name: Station(levelled=True, levelling_sigma_arcsec=sigma) for name in recording.stations}
    return recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))


def test_a_wrong_level_is_detected_from_the_others() -> None:
    upright = levelled(visits(2, stations=3), 1.0)
    assert {item.passed for item in check(upright).items if item.kind == "level"} == {True}
    leaning = moved(upright, 1, -1.0, [0.0, 0.0, 0.0, 0.0, 30 * ARCSECOND, 0.0])
    result = check(leaning)
    assert ("S2", "level") in kinds(result)
    sentence = next(item.sentence for item in result.items if item.kind == "level" and item.station == "S2")
    assert sentence.startswith("S2: its level deviates from the vertical of the other stations (29.9 +- 1.")


def test_a_steering_mirror_is_tested_with_the_errors_of_its_construction() -> None:
    """Errors of a mirror that a source in the head cannot have are within its guarantee, and no scatter."""
    mirror = steering_mirror_construction()
    recording, _ = network(faces=2, seed=5, stations=1, construction=mirror, values=drawn(mirror, 5))
    instrument = Instrument(construction="steering-mirror")
    steering = recording.replace(setup=recording.setup.model_copy(update={"instrument": instrument}))
    assert check(steering).passed
    assert ("S1", "closure") in kinds(check(recording))
    both = visits(3, stations=2)
    mixed = {"instruments": {"M": instrument}, "stations": {"S2": Station(instrument="M")}}
    items = check(both.replace(setup=both.setup.model_copy(update=mixed))).items
    assert any(
        "the stations are not compared: stations S2 have a tracker with a steering mirror" in i.sentence for i in items
    )


def test_a_recording_without_repetitions_is_reported() -> None:
    recording = visits(9)
    with pytest.raises(NetworkError, match="measure some targets in both faces, or the first targets again"):
        check(recording.select(recording.face == 1))


def test_the_whole_search_is_paid_for() -> None:
    """The best of all gaps on clean readings: its chance, gaps counted, is no smaller than it should be."""
    chances = []
    for seed in range(20):
        visit = SetupModel.from_recording(visits(seed), misalignment_construction())
        _, gain, gaps = best_fitting_bump(visit)
        chances.append(visit.p_value(gain) * gaps)
    assert np.mean(np.array(chances) < 0.1) <= 0.2


def test_answers_and_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = moved(visits(4), 0, 305.0, [60e-6, 0, 0, 0, 0, 0])
    write(recording, tmp_path / "rec")
    assert run(["check", str(tmp_path / "rec"), "--out", str(tmp_path / "out"), "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer == json.loads((tmp_path / "out" / "check.json").read_text())
    assert answer["passed"] is False
    assert [i["kind"] for i in answer["items"] if not i["passed"]] == ["bump"]
    assert len((tmp_path / "out" / "two_face.csv").read_text().splitlines()) == 29
    assert (tmp_path / "out" / "check.svg").read_text().startswith("<?xml")
    write(visits(4), tmp_path / "good")
    assert run(["check", str(tmp_path / "good"), "--mpe", "100,10"]) == 0
    assert "Go: 1 set-up within" in capsys.readouterr().out
    assert run(["check", str(tmp_path / "good"), "--mpe", "twenty"]) == 2


def test_surprise_far_out() -> None:
    """The tail that a float cannot hold continues the one that it can, for every rank."""
    for rank in (1, 2, 3, 6):
        near = neg_log_p_chi2(np.array([590.0, 599.9, 600.1, 610.0]), np.full(4, rank))
        np.testing.assert_allclose(near, -stats.chi2.logsf([590.0, 599.9, 600.1, 610.0], rank), rtol=1e-5)
        assert np.isfinite(neg_log_p_chi2(1e9, rank))
    assert neg_log_p_chi2(10.0, 0) == 0.0


def test_numbers_are_written_out() -> None:
    assert [number_text(v) for v in (2712.3, 0.04216, -104.9, 7.0)] == ["2710", "0.0422", "-105", "7"]
    assert number_text(-104.9, 2) == "-100"


def test_limits_as_text() -> None:
    assert parse_mpe("20,6") == (20.0, 6.0)
    for text in ("20", "a,b", "-1,2", "1,2,3", "0,1"):
        with pytest.raises(RecordError, match="for instance 20,6"):
            parse_mpe(text)


@pytest.mark.parametrize("dialect", ["native", "table"])
def test_a_growing_recording_is_followed(dialect: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A file that grows by bytes, rows cut anywhere: the bump is told once, as soon as pointings after it say so."""
    write(moved(visits(4), 0, 305.0, [200e-6, 0, 0, 0, 0, 0]), tmp_path / "rec")
    place = tmp_path / "rec"
    file = place / "observations.csv"
    text = file.read_text()
    if dialect == "table":
        place = file = tmp_path / "live.csv"
        text = text.replace("azimuth_deg", "azimuth [deg]").replace("time_s", "time [s]").replace("station", "Stn", 1)
    ends = [i for i, c in enumerate(text) if c == "\n"]

    def steps() -> Iterator[None]:
        for pointings in (0, 5, 10, 11, 29, 30, 31, 40, 48, 56):
            file.write_text(text[: ends[pointings] + 1] + "S1,T"[: pointings % 5])
            yield

    watch_recording(Terminal(), lambda: check(ReadingOptions().read(place, is_growing=True)), steps())
    captured = capsys.readouterr()
    assert captured.err.count("waiting: no station measured a target twice") == 1
    assert "incomplete" not in captured.err and "never measured" not in captured.err
    assert captured.out.count("moved between 300.0 s and 310.0 s") == 1
    assert "40 pointings: NO-GO S1 moved" in captured.out
    file.write_text(text[:-20])
    with pytest.raises(RecordError, match="incomplete"):
        read(place)


def test_changes_of_files_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "a.csv"
    file.write_text("1")
    naps = []

    def nap(seconds: float) -> None:
        naps.append(seconds)
        if len(naps) == 3:
            file.write_text("12")

    monkeypatch.setattr("ltsim.cli.check.time.sleep", nap)
    steps = wait_for_changes(file)
    next(steps)
    next(steps)
    assert len(naps) == 3


def test_every_page_of_the_figure() -> None:
    front_face = visits(9).select(np.arange(28))
    twice = front_face.replace(
        **{name: np.concatenate([getattr(front_face, name)] * 2) for name in ("station", "target", "face", "readings")},
        repeat=np.repeat([1, 2], 28),
        time=np.arange(56.0),
    )
    assert "no target was measured on both faces" not in svg_text(field_check_figure(check(visits(3, stations=2))))
    assert svg_text(field_check_figure(check(twice)))


@pytest.mark.long
def test_the_girder_epochs(shared: Path) -> None:
    """The differences are those of the readings, and the nest whose faces differ by 32 um in range is named."""
    folder = shared / "recordings" / "desy-girder-at960"
    if not folder.is_dir():
        pytest.skip("the recordings of the girder are not beside this checkout")
    recording = read(folder / "Polar_measurements_24Feb22.txt", hints=Hints(azimuth="clockwise"))
    result = check(recording)
    whole = two_face_pairs(recording)
    pairs = [
        setup.two_face_differences.uncorrected_pairs
        for setup in result.arrays.setup_checks
        if setup.two_face_differences is not None
    ]
    assert sum(map(len, pairs)) == len(whole)
    np.testing.assert_allclose(np.concatenate([p.half_differences for p in pairs]), whole.half_differences, atol=1e-12)
    gross = next(item for item in result.items if item.kind == "gross" and item.station == "Instrument_0")
    assert "K6" in gross.targets
    assert not result.passed
    assert result.sentence.startswith("no-go: Instrument_0 to K6: rows 81 and 82 are 52")


@pytest.mark.long
def test_readings_to_targets_that_scatter_are_reported_as_such_and_none_is_gross() -> None:
    """Directions to four targets are ten times as noisy: neither a set-up nor the network blames a pointing of them."""
    for seed in range(5):
        recording = network(faces=2, seed=seed)[0]
        extra = (
            10.0 * recording.reading_sigmas() * random_stream(seed, "noisy").standard_normal(recording.readings.shape)
        )
        noisy = recording.readings + np.isin(recording.target, [3, 9, 14, 20])[:, None] * extra * [0.0, 1.0, 1.0]
        result = check(recording.with_readings(noisy), level=0.001)
        failed = [item for item in result.items if not item.passed]
        noisier = [item for item in failed if "scatter" in item.sentence and not item.station]
        assert sorted(name for item in noisier for name in item.targets) == ["T04", "T10", "T15", "T21"]
        assert not [item for item in failed if item.rows]


@pytest.mark.parametrize(("scenario", "seed"), [("paper-workshop-two-face", 5), ("paper-workshop", 13)])
def test_what_an_uncalibrated_instrument_does_to_near_targets_is_no_scatter_of_theirs(scenario: str, seed: int) -> None:
    recording, _ = lt.simulate(scenario, seed=seed)
    assert len(adjust(recording).noisy_targets_and_scatter[0])
    assert check(recording).passed
