"""Centring errors: another reflector in every nest of a set-up, reflectors displaced at random, and their absence."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.identification import CauseSelection, FitInput, NetworkFit, cause_tests, select_causes
from ltsim.adjustment.identification.centring_errors import local_centring_hypotheses
from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.physics.effects.motions import reading_change_by_displacement
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.centring_errors import CentringUncertainty
from ltsim.recordings.native import read_recording, write_recording
from ltsim.recordings.occupations import target_occupations
from ltsim.recordings.recording import Recording
from tests.families import family
from tests.networks import network

STATION = "S2"


@cache
def hall() -> tuple[Recording, Floats, Floats]:
    """Four stations, two faces; unit vectors (T, 3) from the middle of the hall to the targets, and true targets."""
    recording, truth = network(faces=2, seed=3, stations=4)
    points = truth.state.target_points
    outwards = points - points.mean(axis=0)
    axis = np.argmax(np.abs(outwards), axis=1)  # the walls, floor and ceiling of a box
    normal = np.sign(outwards) * (np.arange(3) == axis[:, None])
    return recording, normal, points


def displaced(displacement: Floats, *, station: str | None = STATION) -> Recording:
    """The hall with reflectors displaced by (T, 3), or for each of all stations by (S, T, 3) [m]."""
    recording = hall()[0]
    by_station = np.broadcast_to(displacement, (len(recording.stations), *displacement.shape[-2:]))
    motion = by_station[recording.station, recording.target].copy()
    if station is not None:
        motion[recording.station != recording.stations.index(station)] = 0.0
    return recording.with_readings(
        recording.readings + reading_change_by_displacement(adjust(recording).sightings, motion)
    )


def identified(recording: Recording) -> CauseSelection:
    return select_causes(FitInput(recording, misalignment_construction()))


@pytest.mark.parametrize(
    ("length_mm", "cause"),
    [
        (12.7, "a 0.5 inch SMR in place of a 1.5 inch one"),
        (-4.76, "a 7/8 inch SMR in place of a 0.5 inch one"),
        pytest.param(34.4, "another SMR or adaptor", marks=pytest.mark.long),
    ],
)
def test_another_reflector_in_every_nest_of_a_set_up(length_mm: float, cause: str) -> None:
    selection = identified(displaced(1e-3 * length_mm * hall()[1]))
    (test,) = (t for t in cause_tests(selection) if t.kind != "outlier")
    assert (test.kind, test.where.stations, test.where.targets) == ("reflector-radius", (STATION,), ())
    assert test.estimate == pytest.approx(-length_mm, abs=0.05)
    assert test.sigma is not None and abs(test.estimate + length_mm) < 4.0 * test.sigma + 1e-3
    assert cause in test.sentence
    assert "nest_normal" in test.sentence
    assert selection.requires_adjustment_with_causes
    error = selection.fit.state.target_points - adjust(hall()[0]).state.target_points
    assert np.sqrt(np.mean(error**2)) < 20e-6


@pytest.mark.parametrize("length_mm", family([-12.7, 7.9375]))
def test_another_reflector_in_every_nest_of_a_set_up_without_repeated_pointings(length_mm: float) -> None:
    """Without repeats, it was reported as scale errors and noise of the set-up and as heights of single targets."""
    recording = displaced(1e-3 * length_mm * hall()[1])
    selection = identified(recording.select(recording.face == 1))
    (test,) = (t for t in cause_tests(selection) if t.kind != "outlier")
    assert (test.kind, test.where.stations, test.where.targets) == ("reflector-radius", (STATION,), ())
    assert test.estimate == pytest.approx(-length_mm, abs=0.05)
    assert selection.requires_adjustment_with_causes


def test_random_displacements_are_no_cause_without_repeated_pointings() -> None:
    displacement = 8e-3 * random_stream(5, "centring").standard_normal(hall()[1].shape)
    recording = displaced(displacement)
    selection = identified(recording.select(recording.face == 1))
    assert not {c.hypothesis.kind for c in selection.selected_hypotheses} & {"centring", "reflector-radius"}


@pytest.mark.parametrize("sigma_mm", family([0.1, 2.0]))
def test_reflectors_of_a_set_up_displaced_at_random(sigma_mm: float) -> None:
    shape = hall()[1].shape
    selection = identified(displaced(1e-3 * sigma_mm * random_stream(5, "centring").standard_normal(shape)))
    (test,) = (t for t in cause_tests(selection) if t.kind != "outlier")
    assert (test.kind, test.where.stations, test.where.targets) == ("centring", (STATION,), ())
    assert test.estimate == pytest.approx(sigma_mm, rel=0.3)


def test_a_target_displaced_at_random_at_every_set_up() -> None:
    recording, normal, _ = hall()
    motion = np.zeros((len(recording.stations), *normal.shape))
    motion[:, 7] = 1e-3 * random_stream(8, "centring").standard_normal((len(recording.stations), 3))
    selection = identified(displaced(motion, station=None))
    (test,) = (t for t in cause_tests(selection) if t.kind != "outlier")
    assert (test.kind, test.where.targets) == ("centring", (recording.targets[7],))
    assert 0.4 < test.estimate < 2.5  # type: ignore[operator]


def test_noise_of_a_set_up_is_no_centring_error() -> None:
    recording = hall()[0]
    larger = recording.reading_sigmas() * (recording.station == recording.stations.index(STATION))[:, None]
    noise = 5.0 * larger * random_stream(9, "noise").standard_normal(larger.shape)
    selection = identified(recording.with_readings(recording.readings + noise))
    assert [c.hypothesis.kind for c in selection.selected_hypotheses] == ["noise-level"]


def test_declared_centring_errors_are_estimated_with_the_network(tmp_path) -> None:  # type: ignore[no-untyped-def]
    recording, normal, _ = hall()
    shape = len(recording.stations), *normal.shape
    motion = 5e-4 * random_stream(10, "centring").standard_normal(shape)
    measured = displaced(motion, station=None)
    declared = CentringUncertainty(sigma_mm=0.5)
    setup = measured.setup.model_copy(update={"centring": (declared,)})
    write_recording(measured.replace(setup=setup), tmp_path)
    again = read_recording(tmp_path)
    assert again.setup.centring == (declared,)
    plain, estimated = adjust(measured), adjust(again)
    assert plain.sigma0 > 5.0
    assert estimated.dof == plain.dof
    assert estimated.sigma0 == pytest.approx(1.0, abs=0.15)
    assert len(np.unique(target_occupations(again, declared))) == shape[0] * shape[1]


def test_occupations_of_labels_and_days() -> None:
    recording = hall()[0]
    day = tuple("day 1" if s < 2 else "day 2" for s in recording.station)
    dated = recording.replace(labels={"date": day})
    occupation = target_occupations(dated, CentringUncertainty(sigma_mm=1.0, occupation="day"))
    assert len(np.unique(occupation)) == 2 * len(recording.targets)
    centring = CentringUncertainty(sigma_mm=1.0, occupation="day", targets=recording.targets[:3], stations=("S1",))
    occupation = target_occupations(dated, centring)
    assert set(occupation.tolist()) == {-1, 0, 1, 2}
    assert (occupation[recording.station != recording.stations.index("S1")] == -1).all()


@pytest.mark.parametrize("scatter", family([0.5, 0.1], 1))
def test_repeats_that_share_errors_are_no_motion(scatter: float) -> None:
    """Three shots each from one face: their errors are common, and they scatter `scatter` times as much as declared."""
    once, _ = network(seed=21, stations=5, faces=1)
    recording = once.select(np.repeat(np.arange(len(once)), 3))
    noise = (
        scatter * recording.reading_sigmas() * random_stream(22, "scatter").standard_normal(recording.readings.shape)
    )
    selection = identified(recording.with_readings(recording.readings + noise))
    kinds = [(test.kind, test.where.stations, test.where.targets) for test in cause_tests(selection)]
    assert kinds[0] == ("centring", (), ())
    assert {kind for kind, _, _ in kinds} <= {"centring", "noise-level"}
    assert cause_tests(selection)[0].sentence.startswith(
        "Repeated pointings of a target from one set-up have common errors"
    )
    assert selection.fit.adjustment.p_value > 0.01


def test_independent_repeats_share_no_errors() -> None:
    recording, _ = network(seed=21, stations=5, faces=1, repeats=3)
    assert cause_tests(identified(recording)) == ()


def test_displacements_are_fitted_where_a_target_was_not_read() -> None:
    """The numbers of the occupations then have a gap."""
    recording = displaced(2e-3 * random_stream(5, "centring").standard_normal(hall()[1].shape))
    readings = recording.readings.copy()
    readings[(recording.station == 1) & (recording.target == 3)] = np.nan
    fit = NetworkFit.from_start(FitInput(recording.with_readings(readings), misalignment_construction()))
    assert fit is not None
    stations = {hypothesis.stations for _, hypothesis in local_centring_hypotheses(fit)}
    assert (STATION,) in stations
