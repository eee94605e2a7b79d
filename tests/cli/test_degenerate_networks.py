"""Random networks that are degenerate in several ways at once, through the verbs that adjust: an answer or a sentence.

A failure prints the seed of each network, its ways, the verb and its last lines; `network(seed)` makes it again.
"""

from __future__ import annotations

import contextlib
import io
import os
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.identification import identify_causes
from ltsim.cli.main import run
from ltsim.core.errors import LtsimError
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import swap_front_and_raw, to_polar
from ltsim.recordings.recording import Recording
from ltsim.recordings.settings import validate_setup

NETWORKS, BLOCK = 320, 10
SECONDS = 30.0
"""[s] Processor time of one verb."""
VERBS = (("check",), ("adjust",), ("adjust", "--robust", "--noise-from-data"), ("calibrate",), ("diagnose",))

Points = np.ndarray
Rng = np.random.Generator
Place = Callable[[int, Rng], Points]


def in_a_box(count: int, rng: Rng) -> Points:
    return rng.uniform(-5.0, 5.0, (count, 3))


def on_a_line(count: int, rng: Rng) -> Points:
    return rng.uniform(-5.0, 5.0, 3) + np.outer(rng.uniform(-5.0, 5.0, count), rng.standard_normal(3))


def on_a_vertical_line(count: int, rng: Rng) -> Points:
    return rng.uniform(-5.0, 5.0, 3) + np.outer(rng.uniform(-5.0, 5.0, count), [0.0, 0.0, 1.0])


def in_a_plane(count: int, rng: Rng) -> Points:
    return rng.uniform(-5.0, 5.0, (count, 2)) @ rng.standard_normal((2, 3))


def in_a_horizontal_plane(count: int, rng: Rng) -> Points:
    return rng.uniform(-5.0, 5.0, (count, 3)) * [1.0, 1.0, 0.0]


def on_a_circle(count: int, rng: Rng) -> Points:
    turn = 2.0 * np.pi * np.arange(count) / count
    return 4.0 * np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)


def on_a_sphere(count: int, rng: Rng) -> Points:
    way = rng.standard_normal((count, 3))
    return 5.0 * way / np.linalg.norm(way, axis=1, keepdims=True)


def at_common_place(count: int, rng: Rng) -> Points:
    return np.tile(rng.uniform(-5.0, 5.0, 3), (count, 1))


def in_two_places(count: int, rng: Rng) -> Points:
    return rng.uniform(-5.0, 5.0, (2, 3))[np.arange(count) % 2]


def close_together(count: int, rng: Rng) -> Points:
    return rng.uniform(-5.0, 5.0, 3) + rng.uniform(-1e-4, 1e-4, (count, 3))


def far_away(count: int, rng: Rng) -> Points:
    return np.array([1e5, 0.0, 0.0]) + rng.uniform(-5.0, 5.0, (count, 3))


def over_all_scales(count: int, rng: Rng) -> Points:
    return rng.standard_normal((count, 3)) * 10.0 ** rng.uniform(-3.0, 5.0, (count, 1))


PLACES: tuple[Place, ...] = (
    *(in_a_box, on_a_line, on_a_vertical_line, in_a_plane, in_a_horizontal_plane, on_a_circle, on_a_sphere),
    *(at_common_place, in_two_places, close_together, far_away, over_all_scales),
)
SIZES = ((1, 1), (1, 2), (1, 12), (2, 1), (2, 2), (2, 3), (2, 4), (3, 5), (4, 12), (6, 3), (9, 2), (3, 25))
"""Numbers of set-ups and targets."""
NOISES = (0.0, 1e-12, 1e-6, 1e-4, 1e-2, 1.0)
"""Standard deviations of readings [m, rad]; the declared ones are about 1e-5."""
SETTINGS = (
    {},
    {"instrument": {"noise": {"distance_mm": 1e-6, "azimuth_arcsec": 1e-6, "elevation_arcsec": 1e-6}}},
    {"instrument": {"noise": {"distance_mm": 1e6, "azimuth_arcsec": 1e6, "elevation_arcsec": 1e6}}},
    {"instrument": {"noise": {"distance_mm": 1e-6, "azimuth_arcsec": 1e6, "elevation_arcsec": 1e6}}},
    {"instrument": {"prior": {"range_offset_mm": 1e9, "angle_arcsec": 1e9, "offset_mm": 1e9, "range_scale_ppm": 1e9}}},
    {"instrument": {"prior": {"range_offset_mm": 1e-6, "angle_arcsec": 1e-6, "offset_mm": 1e-6}}},
    {"gauge": {"distance": [{"from": "T0", "to": "T1", "length_mm": 1000.0, "sigma_mm": 1e-6}]}},
    {"gauge": {"distance": [{"from": "T0", "to": "T1", "length_mm": 1e-6, "sigma_mm": 0.01}]}},
    {"gauge": {"distance": [{"from": "T0", "to": "T1", "length_mm": 1e9, "sigma_mm": 1e6}]}},
    {"targets": {f"T{i}": {"known_mm": [0.0, 0.0, 0.0], "known_sigma_mm": 0.01} for i in range(3)}},
    {"targets": {f"T{i}": {"known_mm": [1e9 * i, 0.0, 0.0], "known_sigma_mm": 1e-6} for i in range(3)}},
    {"stations": {f"S{i}": {"position_mm": [0.0, 0.0, 0.0], "yaw_deg": 0.0} for i in range(2)}},
    {"stations": {f"S{i}": {"over": "T0"} for i in range(2)}},
    {"stations": {f"S{i}": {"levelled": True} for i in range(9)}},
    {"curved": True},
)
"""Tables of a set-up; those that do not fit the network are refused, which is an answer as well."""


def no_change(recording: Recording, rng: Rng) -> Recording:
    return recording


def without_readings(recording: Recording, rng: Rng) -> Recording:
    gone = rng.random(recording.readings.shape) < rng.uniform(0.1, 0.9)
    return _with(recording, np.where(gone, np.nan, recording.readings))


def without_observables(recording: Recording, rng: Rng) -> Recording:
    gone = rng.permutation([True, bool(rng.integers(2)), False])
    return _with(recording, np.where(gone, np.nan, recording.readings))


def observables_by_station(recording: Recording, rng: Rng) -> Recording:
    gone = rng.random((len(recording.stations), 3)) < 0.5
    return _with(recording, np.where(gone[recording.station], np.nan, recording.readings))


def constant(recording: Recording, rng: Rng) -> Recording:
    readings = recording.readings.copy()
    column = int(rng.integers(3))
    readings[:, column] = readings[0, column] if rng.integers(2) else (1.0, 0.0, 0.0)[column]
    return _with(recording, readings)


def every_pointing_again(recording: Recording, rng: Rng) -> Recording:
    return recording.select(np.repeat(np.arange(len(recording)), 3))


def other_targets(recording: Recording, rng: Rng) -> Recording:
    return recording.replace(target=rng.permutation(recording.target))


def few_pointings(recording: Recording, rng: Rng) -> Recording:
    return recording.select(rng.permutation(len(recording))[: int(rng.integers(1, 8))])


def second_face(recording: Recording, rng: Rng) -> Recording:
    return recording.replace(face=rng.integers(1, 3, len(recording)))


def extreme_readings(recording: Recording, rng: Rng) -> Recording:
    readings, row = recording.readings.copy(), int(rng.integers(len(recording)))
    column = int(rng.integers(3))
    readings[row, column] = ((1e-6, 1e6), (-4.0 * np.pi, 4.0 * np.pi), (-0.5 * np.pi, 1.5 * np.pi))[column][
        int(rng.integers(2))
    ]
    return _with(recording, readings)


def mirrored(recording: Recording, rng: Rng) -> Recording:
    sense = np.where(rng.random(len(recording.stations)) < 0.5, -1.0, 1.0)[recording.station]
    return _with(recording, recording.readings * np.stack([sense**2, sense, sense**2], axis=1))


def at_equal_times(recording: Recording, rng: Rng) -> Recording:
    return recording.replace(time=np.full(len(recording), float(rng.choice([0.0, 1e9]))), has_clock=True)


def backwards(recording: Recording, rng: Rng) -> Recording:
    return recording.replace(time=-np.arange(len(recording)) * 1e6, has_clock=True)


def weather(recording: Recording, rng: Rng) -> Recording:
    values = rng.choice([20.0, np.nan, -60.0, 80.0], len(recording))
    return recording.replace(covariates={"air_temperature_c": values, "constant": np.full(len(recording), 1e15)})


CHANGES: tuple[Callable[[Recording, Rng], Recording], ...] = (
    *(no_change, without_readings, without_observables, observables_by_station, constant, every_pointing_again),
    *(other_targets, few_pointings, second_face, extreme_readings, mirrored, at_equal_times, backwards, weather),
)


def _with(recording: Recording, readings: np.ndarray) -> Recording:
    """The recording with other readings, without pointings that have none."""
    usable = np.isfinite(readings).any(axis=1)
    usable[0] = True
    readings[0] = np.where(np.isfinite(readings[0]).any(), readings[0], recording.readings[0])
    return recording.with_readings(readings).select(usable)


def network(seed: int) -> tuple[str, Recording]:
    """Ways in which a network is degenerate, and its recording."""
    rng = random_stream(seed, "degenerate networks")
    stations, targets = SIZES[int(rng.integers(len(SIZES)))]
    places = [PLACES[int(rng.integers(len(PLACES)))] for _ in range(2)]
    standing, points = places[0](stations, rng), places[1](targets, rng)
    turn = rng.uniform(-np.pi, np.pi, stations) * rng.integers(2)
    station, target = map(np.ravel, np.meshgrid(np.arange(stations), np.arange(targets), indexing="ij"))
    arm = points[target] - standing[station]
    arm[np.linalg.norm(arm, axis=1) < 1e-6] = [0.0, 0.0, 1e-5]
    cos, sin = np.cos(turn[station]), np.sin(turn[station])
    readings = to_polar(np.stack([cos * arm[:, 0] + sin * arm[:, 1], cos * arm[:, 1] - sin * arm[:, 0], arm[:, 2]], 1))
    faces = int(rng.integers(1, 3))
    station, target = np.tile(station, faces), np.tile(target, faces)
    face = np.repeat(np.arange(1, faces + 1), len(readings))
    readings = swap_front_and_raw(np.tile(readings, (faces, 1)), face)
    noise = NOISES[int(rng.integers(len(NOISES)))]
    readings += noise * rng.standard_normal(readings.shape)
    readings[:, 0] = np.clip(np.abs(readings[:, 0]), 1e-6, 1e6)
    settings = SETTINGS[int(rng.integers(len(SETTINGS))) if rng.integers(2) else 0]
    recording = Recording(
        setup=validate_setup({"format": "ltsim-recording/1", **settings}, "setup.toml"),
        stations=tuple(f"S{i}" for i in range(stations)),
        targets=tuple(f"T{i}" for i in range(targets)),
        station=station,
        target=target,
        face=face,
        repeat=np.ones(len(station), dtype=np.int64),
        time=np.arange(len(station)) * 10.0,
        readings=readings,
        covariates={},
        labels={},
        has_clock=bool(rng.integers(2)),
    )
    changes = [CHANGES[int(rng.integers(len(CHANGES)))] for _ in range(2)]
    for change in changes:
        recording = change(recording, rng)
    ways = [f"{stations} set-ups", f"{targets} targets", *(way.__name__ for way in (*places, *changes))]
    return f"{', '.join(ways)}, noise {noise:g}, {settings}", recording


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def fault(words: tuple[str, ...]) -> str:
    """Fault of one verb on the recording `network`; empty for an answer or one sentence."""
    stream = io.StringIO()
    begun = os.times().user
    with (
        warnings.catch_warnings(record=True) as warned,
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(stream),
    ):
        warnings.simplefilter("always")
        status = run([words[0], "network", *words[1:], "--out", "out", "--force"])
    errors = [line for line in stream.getvalue().splitlines() if line.startswith("error: ")]
    right = status in (0, 1) or (status == 2 and len(errors) == 1)
    if right and "Traceback" not in stream.getvalue() and not warned and os.times().user - begun < SECONDS:
        return ""
    places = sorted({f"{Path(w.filename).name}:{w.lineno} {w.message}" for w in warned})
    details = f"{os.times().user - begun:.0f} s, {places}, {stream.getvalue()[-1500:]}"
    return f"{' '.join(words)}: {status}, {details}"


def faults(first: int, count: int) -> list[str]:
    """Faults of the verbs on some networks, in the working folder."""
    problems = []
    for seed in range(first, first + count):
        ways, recording = network(seed)
        try:
            lt.write(recording, Path("network"))
        except LtsimError:
            continue  # the set-up does not fit the network
        problems += [f"network {seed} ({ways}): {problem}" for words in VERBS if (problem := fault(words))]
    return problems


def test_readings_that_all_contradict_each_other_are_not_all_rejected() -> None:
    """No network, in place of a network without readings, whose noise would be a mean of no values."""
    assert identify_causes(network(46200)[1]) is None


@pytest.mark.long
@pytest.mark.parametrize("first", range(0, NETWORKS, BLOCK))
def test_degenerate_networks_end_in_an_answer_or_a_sentence(first: int, workplace: Path) -> None:
    problems = faults(first, BLOCK)
    assert not problems, "\n\n".join(problems)
