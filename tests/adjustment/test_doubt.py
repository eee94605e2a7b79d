"""A result that is none is refused with what would be right; what is in doubt is said first."""

from __future__ import annotations

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.identification.selection import identify_causes
from ltsim.adjustment.quality import MAX_POSE_CURVATURE, adjustment_warnings, pose_curvatures
from ltsim.adjustment.verdict import VerdictCase, verdict_on
from ltsim.core.errors import LtsimError, NetworkError
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import to_polar
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.model.construction import ideal_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Instrument, Noise, Station, Target
from tests.campaigns.workshop import workshop
from tests.networks import STATIONS, network


def noisy(seed: int = 0, stations: int = 5, **readings: object) -> Recording:
    """The workshop with its stated noise, from some of its stations."""
    recording, _ = workshop()
    keep = recording.station < stations
    rows = {n: getattr(recording, n)[keep] for n in ("station", "target", "face", "repeat", "time", "readings")}
    recording = recording.replace(**rows, stations=recording.stations[:stations])
    noise = random_stream(seed, "doubt").standard_normal(recording.readings.shape) * recording.reading_sigmas()
    return recording.with_readings(recording.readings + noise)


def with_reference_points(recording: Recording, points: np.ndarray) -> Recording:
    """The recording with known coordinates of its first targets."""
    named = zip(recording.targets, points, strict=False)
    targets = {name: Target(known_mm=tuple(1e3 * point), known_sigma_mm=0.01) for name, point in named}
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))


def test_a_sound_recording_has_no_doubts() -> None:
    adjustment = adjust(noisy())
    assert adjustment_warnings(adjustment) == ()
    assert verdict_on(adjustment).case is VerdictCase.CLEAN
    lt.adjust(with_reference_points(noisy(), workshop()[1].target_points[:6] @ rotation_about_z(0.3).T + 5.0))


@pytest.mark.long
def test_gon_read_as_degrees_is_refused_with_the_unit_that_fits() -> None:
    recording = noisy()
    with pytest.raises(NetworkError, match=r"contradict each other .* they fit as gon, not degrees"):
        lt.adjust(recording.with_readings(recording.readings * [1.0, 200 / 180, 200 / 180]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x: x * [1.0, -1.0, 1.0], "fit the mirror image"),
        (lambda x: 2.0 * x, "fit if their coordinates are multiplied by 0.5"),
        pytest.param(lambda x: 0.0 * x, "all known points have the same coordinates", marks=pytest.mark.long),
        (lambda x: x[[1, 0, 2, 3, 5, 4, 6, 7]], "coordinates and names"),
    ],
)
def test_reference_points_that_contradict_the_readings_are_refused(change, words: str) -> None:
    with pytest.raises(NetworkError, match=rf"known points contradict the readings.*{words}"):
        lt.adjust(with_reference_points(noisy(), change(workshop()[1].target_points[:8])))


def test_with_two_stations_nobody_can_tell_which_of_two_exchanged_names_is_right() -> None:
    recording = noisy(stations=2)
    target = recording.target.copy()
    first, second = (np.flatnonzero((recording.station == 1) & (target == t))[0] for t in (3, 17))
    target[[first, second]] = target[[second, first]]
    judged = verdict_on(adjust(recording.replace(target=target)))
    assert judged.case is VerdictCase.IN_DOUBT
    names = f"{recording.targets[3]}, {recording.targets[17]}"
    assert judged.sentence.startswith(f"{names}: the positions from two stations differ")


def test_a_station_with_clockwise_azimuths_is_doubted_aloud() -> None:
    recording = noisy()
    readings = recording.readings.copy()
    readings[recording.station == 3, 1] *= -1
    judged = verdict_on(adjust(recording.with_readings(readings)))
    assert judged.case is not VerdictCase.CLEAN
    assert "station S4" in judged.sentence or "Station S4" in judged.sentence


def test_a_station_with_only_rejected_readings_has_no_standard_deviation() -> None:
    """Names rotated at one station: nothing of it fits, and what is held is not known."""
    recording = noisy()
    is_of_station = recording.station == 2
    target = recording.target.copy()
    target[is_of_station] = np.roll(target[is_of_station], 5)
    adjustment = adjust(recording.replace(target=target), robust=True)
    is_used = adjustment.problem.is_used_reading[is_of_station].any()
    sigma = np.sqrt(np.einsum("sii->si", adjustment.pose_covariance))
    assert np.isfinite(sigma[[0, 1, 3, 4]]).all()
    if is_used:
        assert verdict_on(adjustment).sentence.startswith("Station S3 has")
    else:
        assert np.isnan(sigma[2]).all()
        assert adjustment.undetermined_stations == ("S3",)
        assert "do not determine the full pose of station S3" in verdict_on(adjustment).sentence


def test_a_station_over_the_target_that_it_measures_is_refused_with_its_row() -> None:
    recording = noisy()
    setup = recording.setup.model_copy(update={"stations": {"S2": Station(over="T03")}})
    with pytest.raises(NetworkError, match=r"row 31: station S2 stands over target T03 and measures it"):
        adjust(recording.replace(setup=setup))


def test_targets_on_a_line_are_reported_to_be_on_a_line() -> None:
    recording, state = workshop()
    line = state.target_points[0] + np.linspace(0, 3, 10)[:, None] * [0.3, 0.1, 0.2]
    points = state.target_points.copy()
    points[:10] = line
    local = np.einsum(
        "nji,nj->ni",
        state.station_rotations[recording.station],
        points[recording.target] - state.station_positions[recording.station],
    )
    readings = to_polar(local)
    readings[(recording.station == 4) & (recording.target >= 10)] = np.nan
    with pytest.raises(NetworkError, match=r"S5 shares 10 targets .* lie on one line"):
        adjust(recording.with_readings(readings))


@pytest.mark.parametrize("clock", [True, False])
@pytest.mark.parametrize("times", [2, 50])
def test_copies_of_rows_do_not_sharpen_a_result(times: int, clock: bool) -> None:
    once = noisy().replace(has_clock=clock)
    rows = {n: np.tile(getattr(once, n), times) for n in ("station", "target", "face", "repeat", "time")}
    copied = adjust(once.replace(**rows, readings=np.tile(once.readings, (times, 1))))
    adjustment = adjust(once)
    assert copied.chi2 == pytest.approx(adjustment.chi2)
    assert copied.dof == adjustment.dof
    assert copied.target_covariances == pytest.approx(adjustment.target_covariances, rel=1e-9, abs=1e-16)
    assert adjustment_warnings(copied)[0].startswith(f"{(times - 1) * len(once)} rows are exact copies of other rows")
    assert not copied.is_rejected_reading.any()


def test_copies_of_rows_are_no_cause() -> None:
    once = noisy()
    rows = np.repeat(np.arange(len(once)), 3)
    alone, copied = identify_causes(once), identify_causes(once.select(rows))
    assert alone is not None and copied is not None
    assert copied.fit.hypotheses == alone.fit.hypotheses == ()
    assert copied.fit.problem.dof == alone.fit.problem.dof


def test_readings_that_repeat_by_chance_are_no_copies() -> None:
    recording = noisy()
    rows = {n: np.tile(getattr(recording, n), 2) for n in ("station", "target", "face", "repeat")}
    readings = np.tile(recording.readings, (2, 1))
    later = recording.replace(**rows, readings=readings, time=np.arange(2.0 * len(recording)))
    assert adjust(later).n_duplicate_rows == 0
    readings[-5:, 0] += 1e-6
    assert adjust(later.replace(readings=readings, has_clock=False)).n_duplicate_rows == 0


def test_two_targets_do_for_levelled_stations() -> None:
    recording = noisy(stations=3)
    keep = np.isin(recording.target, [0, 3])
    rows = {n: getattr(recording, n)[keep] for n in ("station", "face", "repeat", "time", "readings")}
    levelled = {name: Station(levelled=True) for name in recording.stations}
    setup = recording.setup.model_copy(update={"stations": levelled, "gauge": None})
    target = (recording.target[keep] == 3).astype(np.int64)
    adjustment = adjust(recording.replace(**rows, target=target, targets=("A", "B"), setup=setup))
    assert adjustment.solution.has_converged
    assert np.isfinite(adjustment.pose_covariance).all()


def test_impossible_noise_and_directions_end_in_a_sentence() -> None:
    huge = Noise(distance_mm=1e9, azimuth_arcsec=1e9, elevation_arcsec=1e9)
    recording = noisy()
    with pytest.raises(LtsimError, match="observations with their declared noise do not determine"):
        lt.adjust(recording.replace(setup=recording.setup.model_copy(update={"instrument": Instrument(noise=huge)})))
    for vertical in ((0, 0, 0), (1e-300, 0, 0)):
        with pytest.raises(ValueError, match="a direction should not have length zero"):
            Station(vertical=vertical)
        with pytest.raises(ValueError, match="a direction should not have length zero"):
            Target(nest_normal=vertical)
    with pytest.raises(ValueError, match="greater than or equal to"):
        Target(known_mm=(0, 0, 0), known_sigma_mm=1e-300)


def on_a_line(off: float) -> tuple[Recording, NetworkState]:
    """The workshop whose last station sees ten targets only, `off` [m] a line."""
    recording, state = workshop()
    points, use = state.target_points.copy(), (recording.station != 4) | (recording.target < 10)
    line = points[0] + np.linspace(0, 3, 10)[:, None] * [0.3, 0.1, 0.2]
    points[:10] = line + off * random_stream(1, "line").standard_normal((10, 3))
    rows = {n: getattr(recording, n)[use] for n in ("station", "target", "face", "repeat", "time", "readings")}
    recording = recording.replace(**rows)
    where = NetworkState(state.station_positions, state.station_rotations, points, np.zeros((1, 0)))
    return recording.with_readings(MeasurementModel(recording, ideal_construction()).predict(where)), where


@pytest.mark.parametrize(("off", "bent"), [(3e-2, False), (1e-3, True)])
def test_a_pose_whose_linear_covariance_fails_is_reported(off: float, bent: bool) -> None:
    """Curvature against what repeated trials show: 95 % regions hold, or hold far less often."""
    recording, where = on_a_line(off)
    rng, inside, trials = random_stream(2, "bent"), 0, 40
    for _ in range(trials):
        noise = rng.standard_normal(recording.readings.shape) * recording.reading_sigmas()
        adjustment = adjust(recording.with_readings(recording.readings + noise), start_state=where)
        gap = adjustment.state.station_positions[4] - where.station_positions[4]
        inside += gap @ np.linalg.solve(adjustment.pose_covariance[4, :3, :3], gap) < 7.81
    assert (pose_curvatures(adjustment)[4] > MAX_POSE_CURVATURE) == bent
    assert (inside < 0.8 * trials) == bent
    assert (
        any("targets of station S5 hardly determine its pose" in doubt for doubt in adjustment_warnings(adjustment))
        == bent
    )
    assert not pose_curvatures(adjustment)[:4].any()


@pytest.mark.parametrize("stations", [2, 4])
def test_a_set_up_that_is_the_mirror_image_of_the_others_is_no_solution(stations: int) -> None:
    recording, _ = network(seed=9, stations=stations)
    readings = recording.readings.copy()
    readings[recording.station == 1, 1] *= -1.0
    who = "Stations S1 and S2 measured mirror images" if stations == 2 else "Station S2 was recorded with"
    with pytest.raises(NetworkError, match=f"{who}.*clockwise"):
        lt.adjust(recording.with_readings(readings))


def test_a_floor_plan_with_heights_shows_that_elevations_have_a_wrong_sign() -> None:
    """Heights that are rounded to 0.1 m decide; a floor plan on which all stations have one height does not."""
    recording, _ = lt.simulate(lt.scenario("paper-workshop", {"instrument.errors": {"draw": False}}), seed=7)
    mirrored = recording.with_readings(recording.readings * [1.0, 1.0, -1.0])
    (warning,) = adjustment_warnings(adjust(mirrored))
    assert "fit the mirror image of this network" in warning
    assert "elevations have a wrong sign" in warning
    flat = {
        name: station.model_copy(update={"position_mm": (*station.position_mm[:2], 0.0)})
        for name, station in recording.setup.stations.items()
    }
    without_heights = mirrored.replace(setup=recording.setup.model_copy(update={"stations": flat}))
    assert adjustment_warnings(adjust(without_heights)) == ()


def test_a_floor_plan_that_fits_the_mirror_image_alone_is_reported() -> None:
    recording, _ = network(seed=9)
    places = {n: Station(position_mm=tuple(1e3 * p)) for n, p in zip(recording.stations, STATIONS, strict=True)}
    planned = recording.replace(setup=recording.setup.model_copy(update={"stations": places}))
    assert adjustment_warnings(adjust(planned)) == ()
    mirrored = planned.readings * [1.0, -1.0, 1.0]
    (warning,) = adjustment_warnings(adjust(planned.with_readings(mirrored)))
    assert "fit the mirror image of this network" in warning
    elsewhere = {n: Station(position_mm=(0.0, 1e4 * i * i, 0.0)) for i, n in enumerate(recording.stations)}
    lost = recording.replace(setup=recording.setup.model_copy(update={"stations": elsewhere}))
    (warning,) = adjustment_warnings(adjust(lost))
    assert "differ from the network by up to" in warning
