"""Networks that are degenerate in one way each: all verbs refuse them, in the same words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.fieldcheck import check
from ltsim.adjustment.quality import adjustment_warnings
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL, GLOBAL_TEST_LEVEL
from ltsim.calibration.network import calibrate_network
from ltsim.core.errors import LtsimError
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import swap_front_and_raw, to_polar
from ltsim.recordings.recording import Recording
from tests.campaigns.workshop import workshop
from tests.families import family

Points = np.ndarray
Break = Callable[[Recording, Points, np.random.Generator], Recording]


def measured(recording: Recording, points: Points, seed: int) -> Recording:
    """The workshop's pointings to targets in other places, with its stated noise."""
    _, state = workshop()
    arm = points[recording.target] - state.station_positions[recording.station]
    readings = to_polar(np.einsum("nji,nj->ni", state.station_rotations[recording.station], arm))
    noise = random_stream(seed, "degenerate").standard_normal(readings.shape) * recording.reading_sigmas()
    return recording.with_readings(readings + noise)


def without(recording: Recording, gone: np.ndarray) -> Recording:
    """The recording without some pointings."""
    return recording.select(~gone)


def on_a_line(recording: Recording, points: Points, rng: np.random.Generator) -> Recording:
    """Two stations share ten targets on one line."""
    line = points.copy()
    line[:10] = points[0] + np.linspace(0.0, 3.0, 10)[:, None] * rng.uniform(0.1, 0.3, 3)
    return measured(recording, line, int(rng.integers(1000))).select((recording.station < 2) & (recording.target < 10))


def two_shared(recording: Recording, points: Points, rng: np.random.Generator) -> Recording:
    """One station shares two targets only with the others."""
    station, targets = rng.integers(1, 5), rng.choice(len(points), 2, replace=False)
    return without(recording, (recording.station == station) & ~np.isin(recording.target, targets))


def nothing_shared(recording: Recording, points: Points, rng: np.random.Generator) -> Recording:
    """Two halves of the stations see other targets."""
    first = recording.station < rng.integers(1, 4)
    half = recording.target < len(points) // 2
    return without(recording, first != half)


def clockwise(recording: Recording, points: Points, rng: np.random.Generator) -> Recording:
    """One set-up is the mirror image of the others."""
    readings = recording.readings.copy()
    readings[recording.station == rng.integers(1, 5), 1] *= -1.0
    return recording.with_readings(readings)


def no_scale(recording: Recording, points: Points, rng: np.random.Generator) -> Recording:
    """Beams alone, and no length."""
    recording = recording.replace(setup=recording.setup.model_copy(update={"gauge": None}))
    return recording.with_readings(np.where([True, False, False], np.nan, recording.readings))


WAYS: tuple[Break, ...] = (on_a_line, two_shared, nothing_shared, clockwise, no_scale)


def words(verb: Callable[[Recording], object], recording: Recording) -> str:
    """The sentence in which a verb refuses a recording; empty where it does not."""
    try:
        verb(recording)
    except LtsimError as refused:
        return str(refused)
    return ""


def agreed(way: Break, seed: int) -> str:
    """The sentence of all verbs about a network that is degenerate in one way."""
    recording, state = workshop()
    broken = way(measured(recording, state.target_points, seed), state.target_points, random_stream(seed, way.__name__))
    sentences = words(lt.adjust, broken)
    if not sentences:  # noise bends a line: there is a solution, and its sigmas are doubted aloud
        (doubt,) = adjustment_warnings(lt.adjust(broken).adjustment)
        assert way is on_a_line
        assert "hardly determine its pose" in doubt
        assert "hardly determine its pose" in calibrate_network(broken, recommend_measurements=False).verdict.sentence
        cause = doubt.partition("(curvature")[0]  # noise that a check finds too large curves the line more
        assert any(item.sentence.startswith(cause) and not item.passed for item in check(broken).items)
        return doubt
    assert words(lambda r: calibrate_network(r, recommend_measurements=False), broken) == sentences
    if way is clockwise:  # what is understood is mended by a diagnosis, and said
        assert "clockwise" in str(lt.diagnose(broken, held_out=False))
    else:
        assert words(lt.diagnose, broken) == sentences
    result = check(broken)
    assert not result.passed
    assert any(sentences in item.sentence for item in result.items)
    return sentences


@pytest.mark.parametrize("seed", family(range(64)))
@pytest.mark.parametrize("way", WAYS)
def test_all_verbs_say_the_same_of_a_degenerate_network(way: Break, seed: int) -> None:
    agreed(way, seed)


@pytest.mark.parametrize("seed", family(range(6), 2))
@pytest.mark.parametrize("noise", [1.0, 1.2, 1.5])
def test_check_gives_the_judgement_of_adjust_where_nothing_but_noise_is_larger(seed: int, noise: float) -> None:
    """No error of the instrument is at work: the same sigma0, and no-go where it is rarer than the level allows."""
    recording, state = workshop()
    exact = recording.with_readings(measured(recording, state.target_points, seed).readings)
    exact = exact.select((exact.station < 3) & (exact.target < 9))
    extra = (
        random_stream(seed, "larger").standard_normal(exact.readings.shape)
        * exact.reading_sigmas()
        * np.sqrt(noise**2 - 1.0)
    )
    noisy = exact.with_readings(exact.readings + extra)
    adjusted, result = lt.adjust(noisy).adjustment, check(noisy)
    (item,) = (item for item in result.items if item.kind == "network")
    assert result.passed == item.passed
    if lt.adjust(noisy, robust=True).adjustment.is_rejected_reading.any():
        assert "contradicts the other stations" in item.sentence
        return
    assert item.passed == (2.0 * min(adjusted.p_value, 1.0 - adjusted.p_value) >= FAMILY_WISE_LEVEL / 4)
    assert f"sigma0 is {adjusted.sigma0:.2f}, " in item.sentence
    assert ("noise alone causes so large a value in one of" in item.sentence) == (
        item.passed and adjusted.p_value < GLOBAL_TEST_LEVEL / 2
    )


def along_axes(recording: Recording, points: Points, away: float, stations: tuple[int, ...]) -> Recording:
    """The recording with a target on the vertical axis of each of some stations, `away` [m] above or below its head."""
    _, state = workshop()
    moved = points.copy()
    for target, station in enumerate(stations, start=3):
        moved[target] = state.station_positions[station] + state.station_rotations[station] @ [0.0, 0.0, away]
    return measured(recording, moved, 0)


def exactly_vertical(recording: Recording) -> Recording:
    """The recording with pi/2 in place of the elevation of each pointing along the vertical axis."""
    readings = recording.readings.copy()
    readings[recording.is_along_standing_axis, 2] = 0.5 * np.pi
    return recording.with_readings(readings)


def without_angles(recording: Recording) -> Recording:
    """The recording without the angles of its pointings along the vertical axis."""
    return recording.with_readings(np.where(recording.is_usable_reading, recording.readings, np.nan))


AXES = {
    "zenith": lambda r, p: along_axes(r, p, 2.0, (1,)),
    "nadir": lambda r, p: along_axes(r, p, -1.5, (1,)),
    "three stations": lambda r, p: along_axes(r, p, 2.0, (1, 2, 3)),
    "pi/2": lambda r, p: exactly_vertical(along_axes(r, p, 2.0, (1,))),
    "three set-ups": lambda r, p: along_axes(r, p, 2.0, (1,)).select(r.station < 3),
}
"""Recordings with pointings along the vertical axis of the tracker."""


def network(adjustment: Adjustment) -> str:
    """Fit and targets of an adjusted network; criteria compare points of pointings, those along the axis included."""
    points = np.round(1e6 * adjustment.state.target_points, 1).tolist()
    return f"{adjustment.chi2:.4f} {adjustment.dof} {adjustment.is_rejected_reading.sum()} {points}"


VERBS = {
    "adjust": lambda r: network(lt.adjust(r).adjustment),
    "check": lambda r: str(check(r)),
    "calibrate": lambda r: network(calibrate_network(r, recommend_measurements=False).adjustment),
    "diagnose": lambda r: str(lt.diagnose(r, held_out=False)),
}
"""Results by verb."""


@pytest.mark.parametrize("way", family(AXES, 3))
@pytest.mark.parametrize("verb", family(VERBS, 2))
def test_the_angles_along_the_vertical_axis_are_used_by_no_verb(verb: str, way: str) -> None:
    recording, state = workshop()
    vertical = AXES[way](recording, state.target_points)
    assert vertical.is_along_standing_axis.any()
    assert VERBS[verb](vertical) == VERBS[verb](without_angles(vertical))


def test_azimuths_along_the_vertical_axis_change_nothing_in_a_check_of_a_single_set_up() -> None:
    recording, state = workshop()
    once = along_axes(recording, state.target_points, 2.0, (1,)).select(recording.station == 1)
    twice = once.select(np.tile(np.arange(len(once)), 2))
    face, count = np.repeat([1, 2], len(once)), len(twice)
    noise = random_stream(5, "two faces").standard_normal((count, 3)) * np.where(
        twice.is_usable_reading, twice.reading_sigmas(), 1e-6
    )
    readings = swap_front_and_raw(twice.readings, face) + noise
    twice = twice.replace(readings=readings, face=face, time=np.arange(count) * 1.0, has_clock=False)
    turned = np.where(twice.is_along_standing_axis[:, None] & [False, True, False], 1.0 + face[:, None], readings)
    assert twice.is_along_standing_axis.sum() == 2 and check(twice).passed
    assert str(check(twice.with_readings(turned))) == str(check(twice))
    assert len(twice.face_pair_rows()) == len(once) - 1


def test_a_target_that_only_a_vertical_pointing_reaches_is_undetermined_and_the_note_names_the_row(
    tmp_path: Path,
) -> None:
    recording, state = workshop()
    once = AXES["zenith"](recording, state.target_points)
    once = once.select((once.target != 3) | (once.station == 1))
    lt.write(once, tmp_path / "once")
    back = lt.read(tmp_path / "once")
    assert isinstance(back, Recording)
    assert any("row 31: along the vertical axis of the tracker" in note for note in back.notes)
    assert lt.adjust(back).adjustment.undetermined_targets == (once.targets[3],)
    assert lt.check(back).passed


@pytest.mark.parametrize("seed", family(range(6), 2))
def test_a_slip_of_a_metre_in_a_small_network_is_named_and_does_not_make_it_singular(seed: int) -> None:
    """29 pointings determine everything: one that is 1.02 m too long or too high is told, and nothing is refused."""
    recording, state = workshop()
    whole, rng = measured(recording, state.target_points, 1), random_stream(seed, "slip")
    few = whole.select((whole.station < 3) & np.isin(whole.target, rng.choice(28, 10, replace=False)))
    few = few.select(np.arange(min(len(few), 29)))
    readings, row = few.readings.copy(), int(rng.integers(len(few)))
    readings[row, 2 * (seed % 2)] += 1.02 / (readings[row, 0] if seed % 2 else 1.0)
    broken = few.with_readings(readings)
    assert not words(lt.adjust, broken)
    result = check(broken)
    assert not result.passed
    assert any(row + 1 in item.rows for item in result.items if not item.passed)
