"""Tripods set up again on another day, and points that directions alone place."""

from __future__ import annotations

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.centring import correct_centring, estimate_centring_errors
from ltsim.adjustment.fieldcheck import check
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import to_polar
from ltsim.recordings import Recording
from ltsim.recordings.setup import EXACT_LEVELLING_SIGMA_ARCSEC, Instrument, Noise, Setup, Station
from tests.families import family

PILLARS = np.array([[0, 0, 0], [90, 5, 2], [60, 80, -3], [-20, 60, 4], [30, 35, 1]], dtype=np.float64)
DAYS = ("2026-05-04", "2026-05-05")
SPIRE = np.array([45.0, 130.0, 25.0])


def local_tie(seed: int, shift: tuple[float, float, float] = (0.0, 0.0, 0.0), spire: float = 1.0) -> Recording:
    """Five pillars, each occupied on both days, all others sighted twice; P4's target stands off [mm] on the second.

    Directions to the spire scatter `spire` times as stated.
    """
    rng = random_stream(seed, "local-tie")
    rows = [
        (day, pillar, other, repeat)
        for day in range(2)
        for pillar in range(5)
        for repeat in (1, 2)
        for other in (*range(5), 5)
        if other != pillar
    ]
    day, pillar, other, repeat = np.array(rows).T
    points = np.vstack([PILLARS, SPIRE])
    goal = points[other] + ((day == 1) & (other == 3))[:, None] * np.array(shift) * 1e-3
    readings = to_polar(goal - points[pillar])
    readings[:, 1] -= rng.uniform(-3, 3, 10)[5 * day + pillar]
    noise = Noise(distance_mm=0.1, distance_ppm=0.0, azimuth_arcsec=1.0, elevation_arcsec=1.0)
    names = [f"P{p + 1}" for p in range(5)]
    over = {"levelled": True, "levelling_sigma_arcsec": EXACT_LEVELLING_SIGMA_ARCSEC}
    recording = Recording(
        setup=Setup(
            instrument=Instrument(noise=noise),
            stations={f"{name}/{d + 1}": Station(over=name, **over) for d in range(2) for name in names},
        ),
        stations=tuple(f"{name}/{d + 1}" for d in range(2) for name in names),
        targets=(*names, "SPIRE"),
        station=(5 * day + pillar).astype(np.int64),
        target=other.astype(np.int64),
        face=np.ones(len(rows), dtype=np.int64),
        repeat=repeat.astype(np.int64),
        time=np.arange(float(len(rows))),
        readings=readings,
        labels={"date": tuple(DAYS[d] for d in day)},
        has_clock=False,
    )
    noisy = (
        readings
        + recording.reading_sigmas() * rng.standard_normal(readings.shape) * np.where(other == 5, spire, 1)[:, None]
    )
    noisy[other == 5] *= np.array([np.nan, 1.0, np.nan])
    return recording.with_readings(noisy)


@pytest.mark.parametrize("spire", [1.0, 10.0])
def test_no_tripod_of_a_sound_network_is_named(spire: float) -> None:
    assert [estimate_centring_errors(adjust(local_tie(seed, spire=spire))) for seed in range(12)] == [None] * 12


@pytest.mark.parametrize("spire", [1.0, 30.0])
@pytest.mark.parametrize("seed", family(range(4)))
def test_a_tripod_next_to_its_mark_on_the_second_day_is_named_with_its_size(seed: int, spire: float) -> None:
    adjustment = adjust(local_tie(seed, (1.5, 1.0, 0.0), spire))
    moved = estimate_centring_errors(adjustment)
    assert moved is not None
    assert [(occupation.mark, occupation.role, occupation.day) for occupation in moved.occupations] == [
        ("P4", "target", DAYS[1])
    ]
    turned = adjustment.state.target_points[1, :2] / np.linalg.norm(PILLARS[1, :2])
    across = np.array([-turned[1], turned[0]])
    east = PILLARS[1, :2] / np.linalg.norm(PILLARS[1, :2])
    expected = np.array([1.5, 1.0]) @ east * turned + np.array([1.5, 1.0]) @ [-east[1], east[0]] * across
    spread = 1e3 * np.sqrt(np.diag(moved.shift_covariances[0])[:2])
    assert np.all(np.abs(1e3 * moved.shifts[0, :2] - expected) < 4 * spread)
    assert moved.chi2_with_centring < 1.3 * moved.dof_with_centring
    assert moved.noisy_targets == (("SPIRE",) if spire > 1.0 else ())
    assert f"P4 as target on {DAYS[1]} by 1." in text_of(adjustment)
    assert any(item.kind == "mistake" and "P4" in item.targets for item in check(adjustment.recording).items)


def text_of(adjustment: object) -> str:
    """The doubts of an adjustment in one text."""
    from ltsim.adjustment.quality import adjustment_warnings

    return " ".join(adjustment_warnings(adjustment))  # type: ignore[arg-type]


def test_a_point_of_directions_alone_has_a_place_in_plan_and_no_height() -> None:
    calibration = lt.adjust(local_tie(1))
    rows = {row[0]: row[1:] for row in calibration.table("targets").rows}
    spire = np.array(rows["SPIRE"], dtype=np.float64)
    turn = np.arctan2(*calibration.target_points[1, 1::-1]) - np.arctan2(*PILLARS[1, 1::-1])
    plan = SPIRE[:2] @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    assert np.all(np.abs(spire[:2] - 1e3 * plan) < 5 * spire[3:5])
    assert np.isnan(spire[[2, 5]]).all()
    assert not calibration.undetermined_targets
    assert "no reading determines the height of SPIRE: adjusted in plan only" in calibration.notes


def test_readings_of_a_tripod_next_to_its_mark_are_corrected_and_the_offset_is_reported() -> None:
    adjustment = adjust(local_tie(2, (1.5, 1.0, 0.0)))
    corrected, (correction,) = correct_centring(adjustment)
    assert (correction.effect_name, correction.targets) == ("target-moved", ("P4",))
    assert correction.displacement == pytest.approx(np.hypot(1.5e-3, 1.0e-3), abs=4 * correction.displacement_sigma)
    again = adjust(corrected, start_state=adjustment.state)
    assert again.sigma0 == pytest.approx(1.0, abs=0.15)
    assert estimate_centring_errors(again) is None
