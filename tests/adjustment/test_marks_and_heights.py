"""Slips of the office: a set-up beside its mark, a height that was not stated, a point under another name."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.blunders import detect_blunders
from ltsim.adjustment.fieldcheck import check
from ltsim.adjustment.quality import adjustment_warnings
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import from_polar, to_polar
from ltsim.physics.model.construction import ideal_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Station, Target
from tests.families import family
from tests.networks import STATIONS, mesh, network


def two_days(offset: float, seed: int = 1, along: tuple[float, ...] = (0.8, 0.6, 0.0)) -> Recording:
    """Four levelled set-ups, the last one on a second day, `offset` metres from the mark of the first."""
    recording, truth = network(stations=4)
    stations = {n: Station(levelled=True, over="M1" if n in ("S1", "S4") else None) for n in recording.stations}
    declared = recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))
    position = STATIONS[:4].copy()
    position[3] = position[0] + offset * np.array(along)
    state = NetworkState(position, truth.state.station_rotations, mesh(), np.zeros((1, 0)))
    exact = declared.with_readings(MeasurementModel(declared, ideal_construction()).predict(state))
    noise = random_stream(seed, "noise").standard_normal(exact.readings.shape)
    return exact.with_readings(exact.readings + exact.reading_sigmas() * noise)


def test_a_set_up_next_to_its_mark_gets_a_separate_position() -> None:
    for seed in range(5):
        assert adjust(two_days(0.0, seed)).rejected_references == ()
    adjustment = adjust(two_days(1.5e-3))
    (wrong,) = adjustment.rejected_references
    assert wrong.kind == "mark"
    assert (wrong.name, wrong.indistinguishable_from, wrong.is_excluded) == ("S4", ("S1",), True)
    assert np.linalg.norm(wrong.error) == pytest.approx(1.5e-3, abs=0.05e-3)
    assert "is 1.50" in adjustment_warnings(adjustment)[0] or "is 1.49" in adjustment_warnings(adjustment)[0]
    assert adjustment.sigma0 == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("height", family([0.002, -1.0, 0.1, 1.0], 2))
def test_a_wrong_height_of_an_upright_set_up_is_reported_as_such_with_its_size(height: float) -> None:
    recording = two_days(height, along=(0.0, 0.0, 1.0))
    adjustment = adjust(recording)
    (wrong,) = adjustment.rejected_references
    assert (wrong.kind, wrong.name, wrong.is_height_error) == ("mark", "S4", True)
    assert wrong.error[2] == pytest.approx(-height, abs=5.0 * wrong.error_sigmas[2])
    cause = ("above", "low") if height > 0 else ("below", "high")
    assert "{} the mark of S1 (its height is declared too {})".format(*cause) in wrong.sentence
    assert not adjustment.is_gross_pointing.any()
    assert adjustment.sigma0 == pytest.approx(1.0, abs=0.15)
    sentences = [item.sentence for item in check(recording).items if not item.passed]
    assert len(sentences) == 1
    assert "its height is declared too" in sentences[0]
    assert float(sentences[0].split()[3]) == pytest.approx(1e3 * abs(height), abs=0.05)


@pytest.mark.parametrize("height", [0.1, -1.0])
def test_a_height_over_a_reference_mark_without_a_check_is_ambiguous(height: float) -> None:
    recording, truth = network(seed=4, stations=4)
    over = {name: Station(levelled=True, over=f"M{i}") for i, name in enumerate(recording.stations)}
    marks = {f"M{i}": Target(known_mm=tuple(1e3 * place)) for i, place in enumerate(truth.state.station_positions)}
    marks["M2"] = Target(known_mm=tuple(1e3 * (truth.state.station_positions[2] - [0.0, 0.0, height])))
    setup = recording.setup.model_copy(update={"stations": over, "targets": recording.setup.targets | marks})
    adjustment = adjust(recording.replace(setup=setup))
    (wrong,) = adjustment.rejected_references
    assert (wrong.kind, wrong.name) == ("point", "M2")
    assert wrong.sentence.endswith("or the height of set-up S3 over it is wrong: excluded")


@pytest.mark.parametrize("height", [1.02, -0.1, 0.004])
def test_a_height_that_was_not_declared_is_reported_with_its_size(height: float) -> None:
    recording, _ = network(seed=3, stations=3)
    readings = recording.readings.copy()
    raised = from_polar(readings[[30]]) + [0.0, 0.0, height]
    readings[30] = to_polar(raised)[0]
    adjustment = adjust(recording.with_readings(readings))
    ((blunder, corrected, _),) = detect_blunders(adjustment)
    assert blunder.pointing_indices.tolist() == [30]
    assert blunder.displacement == pytest.approx(abs(height), abs=0.05e-3)
    assert f"{1e3 * abs(height):.0f}." in blunder.sentence
    assert blunder.sentence.endswith("the instrument is wrong, or the target moved vertically.")
    np.testing.assert_allclose(corrected[0], recording.readings[30], atol=2e-5)
    assert adjustment.sigma0 == pytest.approx(1.0, abs=0.25)


def test_a_point_under_another_name_is_no_exchange() -> None:
    recording, _ = network(seed=3, stations=3)
    target = recording.target.copy()
    booked, meant = (recording.targets[t] for t in ((target[12] + 5) % 28, target[12]))
    target[12] = (target[12] + 5) % 28
    (warning,) = adjustment_warnings(adjust(recording.replace(target=target)))
    assert warning.startswith(f"At station S1 the pointing recorded for {booked} (row 13) was made to {meant}")


def test_a_target_with_another_name_at_a_set_up_is_reported_and_neighbours_are_not() -> None:
    recording, _ = network(seed=3, stations=3)
    other = np.where((recording.station == 1) & (recording.target == 5), len(recording.targets), recording.target)
    (warning,) = adjustment_warnings(adjust(recording.replace(targets=(*recording.targets, "P-77"), target=other)))
    assert warning.startswith(f"{recording.targets[5]} and P-77 are 0.0")
    readings = recording.readings + [[0.002, 0.0, 0.0]] * (other == len(recording.targets))[:, None]
    assert (
        adjustment_warnings(
            adjust(recording.replace(targets=(*recording.targets, "P-77"), target=other, readings=readings))
        )
        == ()
    )
