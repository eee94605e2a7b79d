"""Constants against earlier calibrations: a blow is told with its constant, what wanders as ever is let be."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import Adjustment, adjust
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.calibration_series import CalibrationSeries
from ltsim.calibration.files import write_calibration
from ltsim.calibration.history import History
from ltsim.calibration.network import calibrate_network
from ltsim.calibration.prior_information import EarlierCalibrationPrior
from ltsim.cli.main import run
from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.instruments import ExpectationFromEarlierCalibrations, InstrumentConstantContradiction
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings import write
from ltsim.recordings.result_file import write_result
from ltsim.recordings.setup import Instrument, Station
from tests.networks import drawn, network

BUILT = misalignment_construction()
GUARANTEE = np.array([p.prior_sigma for p in BUILT.parameters])
INDEX = BUILT.parameter_names.index("vertical-index")
SPREAD = 0.05
"""Day-to-day spread in guarantees."""


@cache
def measured(faces: int) -> tuple[Calibration, Adjustment]:
    """A calibration and an adjustment whose network all days share."""
    recording, _ = network(faces=faces, seed=4)
    return calibrate_network(recording, BUILT, recommend_measurements=False), adjust(recording, BUILT)


def estimated(faces: int, truth: Floats, rng: np.random.Generator) -> Floats:
    """What the network would estimate (p,) of constants that are `truth`, linear about the truth."""
    calibration, _ = measured(faces)
    covariance, prior = calibration.covariance, np.diag(GUARANTEE**-2)
    information = np.linalg.inv(covariance) - prior
    information = 0.5 * (information + information.T)
    share, vectors = np.linalg.eigh(information * np.outer(GUARANTEE, GUARANTEE))
    noise = vectors @ (np.sqrt(np.maximum(share, 0.0)) * rng.standard_normal(len(share))) / GUARANTEE
    return covariance @ (information @ truth + noise)


def diagnosis_with_change(
    faces: int, count: int, seed: int, blow: float = 0.0, constant: int = INDEX
) -> tuple[InstrumentConstantContradiction, ...]:
    """Contradictions of a day with some calibrations before it, one constant off by `blow` guarantees."""
    rng = random_stream(61, "days", faces, count, seed)
    calibration, adjustment = measured(faces)
    mean = GUARANTEE * rng.standard_normal(len(GUARANTEE))
    spread = SPREAD * GUARANTEE * np.exp(0.5 * rng.standard_normal(len(GUARANTEE))) * (count > 1)
    days = mean + spread * rng.standard_normal((count + 1, len(GUARANTEE)))
    days[-1, constant] += blow * GUARANTEE[constant]
    values = [estimated(faces, day, rng) for day in days]
    before = [(f"day {k}", calibration.with_changes(estimates=v[None])) for k, v in enumerate(values[:-1])]
    prior = (
        EarlierCalibrationPrior.from_source(History.from_series(CalibrationSeries.from_labelled(before)))
        if count > 1
        else EarlierCalibrationPrior.from_source(before[0][1])
    )
    return against(prior, adjustment, values[-1])


def against(
    prior: EarlierCalibrationPrior, adjustment: Adjustment, values: Floats
) -> tuple[InstrumentConstantContradiction, ...]:
    """Contradictions of an adjustment that had found other values (p,)."""
    state = SimpleNamespace(instrument_parameters=values[None])
    covariance, recording = adjustment.covariance_of_all_instruments, adjustment.recording
    other: Any = SimpleNamespace(
        construction=BUILT,
        state=state,
        covariance_of_all_instruments=covariance,
        recording=recording,
        problem=adjustment.problem,
    )
    expectation = ExpectationFromEarlierCalibrations.from_calibrations(prior, recording, BUILT)
    return expectation.find_contradicting_instrument_constants(other).contradictions


@pytest.mark.long
@pytest.mark.parametrize(("faces", "count"), [(2, 5), (1, 5), (2, 3), (2, 1)])
def test_an_instrument_that_wanders_as_ever_is_let_be(faces: int, count: int) -> None:
    """One in twenty is allowed, as for the whole search; 50 histories."""
    assert sum(bool(diagnosis_with_change(faces, count, seed)) for seed in range(14 if count > 1 else 8)) <= 1


@pytest.mark.parametrize(
    ("faces", "count", "name"), [(2, 5, "vertical-index"), (1, 5, "beam-tilt"), (2, 1, "beam-tilt")]
)
def test_a_blow_is_reported_with_its_constant_and_size(faces: int, count: int, name: str) -> None:
    constant = BUILT.parameter_names.index(name)
    diagnoses = [diagnosis_with_change(faces, count, seed, 3.0, constant) for seed in range(4)]
    assert [f[0].parameter.name for f in diagnoses if f] == [name] * 4
    assert sum(len(f) for f in diagnoses) <= 5
    gaps = np.array([(f[0].difference_from_reference - 3.0 * GUARANTEE[constant]) / f[0].sigma for f in diagnoses])
    assert np.abs(gaps).max() < 4.0
    assert ("history (5 calibrations, spread" in diagnoses[0][0].reference_text) == (count == 5)


def test_two_constants_that_changed_are_distinguished() -> None:
    calibration, adjustment = measured(2)
    today = estimated(2, GUARANTEE * ((np.arange(len(GUARANTEE)) == INDEX) * 2.0), random_stream(3, "a"))
    today[BUILT.parameter_names.index("beam-tilt")] -= GUARANTEE[BUILT.parameter_names.index("beam-tilt")]
    prior = EarlierCalibrationPrior.from_source(calibration.with_changes(estimates=np.zeros((1, len(GUARANTEE)))))
    sizes = {
        c.parameter.name: c.difference_from_reference / c.parameter.prior_sigma
        for c in against(prior, adjustment, today)
    }
    assert sizes == {"vertical-index": pytest.approx(2.0, abs=0.3), "beam-tilt": pytest.approx(-1.0, abs=0.3)}


@pytest.mark.long
def test_a_diagnosis_says_what_has_changed_and_since_when(tmp_path: Path) -> None:
    """From files, as a person has them: history.json and calibration.json."""
    mean = drawn(BUILT, 3)
    rng = random_stream(62, "days")
    days = mean + SPREAD * GUARANTEE * rng.standard_normal((5, len(GUARANTEE)))
    before = [
        (f"day {k}", calibrate_network(network(faces=2, values=v, seed=70 + k)[0], BUILT, recommend_measurements=False))
        for k, v in enumerate(days)
    ]
    write_result(tmp_path / "history", History.from_series(CalibrationSeries.from_labelled(before)), {})
    write_calibration(before[-1][1], tmp_path / "last")
    today = mean.copy()
    today[INDEX] += 2.0 * GUARANTEE[INDEX]
    recording, _ = network(faces=2, values=today, seed=80)
    alone = lt.diagnose(recording, held_out=False)
    assert alone.verdict == "consistent"
    for file in ("history", "last/calibration.json"):
        diagnosis = lt.diagnose(recording, history=tmp_path / file, held_out=False)
        first = diagnosis.findings[0]
        (index,) = first.parameters
        assert (diagnosis.verdict, first.effect, index.name) == ("mismatch", "vertical-index", "vertical-index")
        assert abs(index.value - 2.0 * GUARANTEE[INDEX] / 1e-6) < 4 * index.sigma
        assert first.sentence.startswith("The vertical index of the instrument differs by (")
        assert diagnosis.summary.startswith(first.sentence)
        assert diagnosis.content()["findings"][0]["sentence"] == first.sentence


def test_a_wrong_file_is_refused_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, _ = network(seed=4)
    write(recording, tmp_path / "rec")
    (tmp_path / "note.json").write_text("{}", encoding="utf-8")
    for file in ("nothing.json", "note.json"):
        assert run(["diagnose", str(tmp_path / "rec"), "--history", str(tmp_path / file), "--quiet"]) == 2
        complaint = capsys.readouterr().err
        assert file in complaint and complaint.count("\n") == 1
    stations = {s: Station(instrument="AB"[i % 2]) for i, s in enumerate(recording.stations)}
    several = recording.setup.model_copy(
        update={"stations": stations, "instruments": {"A": Instrument(), "B": Instrument()}}
    )
    write(recording.replace(setup=several), tmp_path / "two")
    write_calibration(measured(2)[0], tmp_path / "one")
    assert run(["diagnose", str(tmp_path / "two"), "--history", str(tmp_path / "one"), "--quiet"]) == 2
    assert "the recording has A, B; give" in capsys.readouterr().err
