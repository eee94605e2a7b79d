"""Parts of the diagnosis by themselves, each on a network whose answer is known."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
import pytest

from ltsim.adjust import Adjustment, adjust
from ltsim.diagnose.detect import Detection
from ltsim.diagnose.refit import refit
from ltsim.diagnose.schema import Where
from ltsim.diagnose.separate import separating_measurement
from ltsim.diagnose.words import law_sentence
from ltsim.effects.effect import Effect
from ltsim.effects.range_cyclic import RangeCyclic
from ltsim.effects.station_settling import StationSettling
from ltsim.model.construction import misalignment
from ltsim.model.measurement import MeasurementModel
from ltsim.randomness import stream
from ltsim.recording.recording import Recording
from ltsim.remedies.deciding import DECISIVE
from ltsim.solve.gauss_newton import Status
from tests.networks import network

# --- refit ------------------------------------------------------------------------------------------------------------


def with_effect(effect: Effect, values: list[float], *, noise: float) -> Recording:
    """A recording, its noise times `noise`, of a tracker without errors and with an effect of known size [SI]."""
    recording, truth = network(faces=2)
    model = MeasurementModel(recording, misalignment(), (effect,))
    exact = model.predict(replace(truth.state, extra=np.array(values)))
    drawn = stream(11, "noise").standard_normal(exact.shape)
    return recording.with_readings(exact + noise * recording.sigma() * drawn)


def refitted(effect: Effect, guess: Effect, values: list[float], *, noise: float = 1.0) -> tuple[Adjustment, dict]:
    recording = with_effect(effect, values, noise=noise)
    plain = adjust(recording, misalignment())
    found = refit(
        recording,
        misalignment(),
        [guess],
        start=plain.state,
        sigma=recording.sigma(),
        use=np.ones((len(recording), 3), dtype=bool),
    )
    return found.adjustment, {estimate.name: estimate for estimate in found.estimates[0]}


def test_a_refit_gives_back_sizes_and_constants_within_their_sigmas() -> None:
    true = StationSettling(("S3",), time_constant=480.0)
    _, told = refitted(true, true.reshaped(time_constant=700.0), [30e-6, -20e-6, 40e-6])
    expected = {"tilt-x": 30.0, "tilt-y": -20.0, "rise": 40.0, "time_constant": 8.0}  # urad, um, min
    assert set(told) == set(expected)
    for name, value in expected.items():
        assert told[name].sigma > 0
        assert abs(told[name].value - value) < 4 * told[name].sigma, name


def test_a_refit_without_noise_ends_at_the_truth() -> None:
    true = RangeCyclic(wavelength=0.75)
    found, told = refitted(true, true.reshaped(wavelength=0.76), [10e-6, 0.0], noise=0.0)
    assert found.chi2 < 1.0
    assert told["wavelength"].value == pytest.approx(750.0, rel=1e-3)  # mm


def test_constants_at_which_the_network_does_not_settle_are_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A refit ends at the last constants with which the adjustment converged, however low a capped one came."""
    module = import_module("ltsim.diagnose.refit")
    bad = 0

    def capped(*args: Any, **kwargs: Any) -> Adjustment:
        nonlocal bad
        found = adjust(*args, **kwargs)
        if len(kwargs["effects"]) == 1 and kwargs["effects"][0] != guess:
            bad += 1
            return replace(found, solution=replace(found.solution, status=Status.CAPPED))
        return found

    true = RangeCyclic(wavelength=0.75)
    guess = true.reshaped(wavelength=0.76)
    monkeypatch.setattr(module, "adjust", capped)
    found, told = refitted(true, guess, [10e-6, 0.0], noise=0.0)
    assert bad
    assert found.solution.converged
    assert told["wavelength"].value == pytest.approx(760.0)


# --- separate ---------------------------------------------------------------------------------------------------------


def test_what_is_no_question_gets_no_measurement() -> None:
    found = adjust(network(faces=2, seed=6)[0], misalignment())
    assert separating_measurement(found, "range-step", [], ()) == ""
    assert separating_measurement(found, "range-step", ["unknown"], ()) == ""
    assert separating_measurement(found, "range-step", ["station-noise"], ()) == ""
    assert separating_measurement(found, "station-noise", ["range-step"], ()) == ""


def test_a_bump_and_a_settling_are_told_apart_by_another_order_of_the_work() -> None:
    settled = StationSettling(("S3",), time_constant=480.0)
    found = adjust(with_effect(settled, [8e-6, -5e-6, 5e-6], noise=1.0), misalignment())
    advice = separating_measurement(found, "station-settling", ["station-bump"], ())
    assert advice.startswith("measure every station's targets again in the reverse order: expected chi-square")
    before, after = map(float, re.findall(r"from (\d+) to (\d+)", advice)[0])
    assert before < DECISIVE < after


# --- detect -----------------------------------------------------------------------------------------------------------


def test_chances_are_those_of_the_simulated_recordings_and_fall_exponentially_beyond_them() -> None:
    null = stream(3, "null").permutation(np.arange(1000.0))
    found = Detection(0.0, 1.0, null)
    assert found.threshold(0.05) == pytest.approx(949.05)
    assert found.chance(-1.0) == 1.0
    assert found.chance(500.0) == pytest.approx(501 / 1001)
    last = found.chance(np.sort(null)[-15])
    assert last == pytest.approx(16 / 1001)
    assert found.chance(np.sort(null)[-15] + np.log(10.0)) == pytest.approx(last / 10)
    assert found.chance(1e4) < 1e-300


@pytest.mark.parametrize(
    ("law", "where", "told"),
    [
        ("vertical index follows hall_c", Where(instruments=("B",), covariates=("hall_c",)), "of instrument B follows"),
        ("vertical index differs", Where(stations=("S4",)), "vertical index at station S4 differs"),
    ],
)
def test_the_place_of_a_law_stands_beside_what_varies(law, where, told):
    assert told in law_sentence(where, [], 0.9, law)
