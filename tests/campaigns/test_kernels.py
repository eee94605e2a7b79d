"""The compiled chain against the one of the model room, and its gradient against differences of its cost."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest

from ltsim.campaigns.batch_network import BatchNetwork
from ltsim.campaigns.compilation import compile_function
from ltsim.campaigns.kernels import compute_points
from ltsim.campaigns.kinematic_chain import ChainArrays
from ltsim.campaigns.trial_calibrators import BatchCalibrator
from ltsim.campaigns.true_network import TRIALS_PER_STREAM, TrueNetwork
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.model.construction import dh_construction, misalignment_construction

CONSTRUCTIONS = {"misalignment": misalignment_construction, "dh": dh_construction, "dh-4": lambda: dh_construction(4)}


@pytest.mark.parametrize("faces", [1, 2])
@pytest.mark.parametrize("name", CONSTRUCTIONS)
def test_points_and_readings_are_those_of_the_construction(
    name: str, faces: int, make_truth: Callable[..., TrueNetwork]
) -> None:
    built = CONSTRUCTIONS[name]()
    truth = make_truth(built, faces=faces)
    rng = np.random.default_rng(4)
    values = truth.distributions.instrument_error_sigmas[:, :, None] * rng.standard_normal(
        (*truth.distributions.instrument_error_sigmas.shape, TRIALS_PER_STREAM)
    )
    deviation = truth._exact_reading_deviations(values)
    points = np.empty_like(deviation)
    compute_points(truth.kinematic_chain(truth.construction), truth.recording.instrument, deviation, values, points)
    for k in range(0, TRIALS_PER_STREAM, 50):
        raw = truth.recording.readings + deviation[:, :, k]
        exact = built.readings_from_points(truth.sightings.local_points, truth.recording.face, values[0, :, k])
        gap = raw - exact
        gap[:, 1:] = wrap_angle(gap[:, 1:])
        assert np.abs(deviation[:, :, k]).max() > 1e-5
        assert np.abs(gap).max() < 5e-12  # 1e-6 sigma: second derivatives of the bases
        assert np.abs(points[:, :, k] - built.points_from_readings(raw, values[0, :, k])).max() < 2e-11


def test_without_second_derivatives_agreement_is_rounding(make_truth: Callable[..., TrueNetwork]) -> None:
    """Bases that are constant or linear in the reading are carried exactly: 1e-13 and better."""
    truth = make_truth()
    values = np.zeros((1, 16, TRIALS_PER_STREAM))
    values[:, :7] = truth.distributions.instrument_error_sigmas[:, :7, None] * np.random.default_rng(5).standard_normal(
        (1, 7, TRIALS_PER_STREAM)
    )
    deviation = truth._exact_reading_deviations(values)
    for k in range(0, TRIALS_PER_STREAM, 50):
        exact = truth.construction.readings_from_points(
            truth.sightings.local_points, truth.recording.face, values[0, :, k]
        )
        gap = truth.recording.readings + deviation[:, :, k] - exact
        gap[:, 1:] = wrap_angle(gap[:, 1:])
        assert np.abs(gap).max() < 1e-13


def test_motions_that_nothing_moves_are_dropped(make_truth: Callable[..., TrueNetwork]) -> None:
    truth = make_truth()
    program = ChainArrays.from_construction(misalignment_construction(), truth.recording.readings)
    assert len(program.is_rotation) == 8
    assert sorted(program.parameter_indices) == list(range(16))


def test_gradient_is_that_of_the_cost(engine: BatchCalibrator) -> None:
    """Along random directions, by differences of the cost, at a state three sigma away in every unknown."""
    network: BatchNetwork = engine.batch_network
    block = engine.true_network.draw_batch(3, 0)
    size = network.block_end_indices[-1]
    rng = np.random.default_rng(6)
    spread = np.sqrt(np.diag(network.covariance))[:, None]
    x = 3 * spread * rng.standard_normal((size, TRIALS_PER_STREAM))
    direction = spread * rng.standard_normal((size, 1))

    def cost_and_gradient(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gradient, cost, predicted = (
            np.empty_like(at),
            np.empty(TRIALS_PER_STREAM),
            np.zeros_like(block.reading_deviations),
        )
        for _ in range(3):  # the predicted readings settle
            network._write_gradient_and_cost(
                at, block.reading_deviations, block.length_errors, predicted, gradient, cost
            )
        return cost, gradient

    step = 1e-2
    ahead, behind = (cost_and_gradient(x + s * direction)[0] for s in (step, -step))
    slope = -0.5 * (ahead - behind) / (2 * step)
    derivative = np.sum(cost_and_gradient(x)[1] * direction, axis=0)
    scale = np.abs(slope).mean()
    assert scale > 100
    assert np.abs(derivative - slope).max() < 3e-4 * scale  # the ideal derivative carries residuals to the target


def test_without_a_place_to_keep_machine_code_it_is_compiled_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """A read-only installation and no home."""

    def nowhere(*, cache: bool, **options: Any) -> Any:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return numba.njit(cache=cache, **options)

    monkeypatch.setattr("ltsim.campaigns.compilation.numba", SimpleNamespace(njit=nowhere))
    assert compile_function(lambda x: x * x)(3.0) == 9.0


def test_machine_code_of_another_version_is_compiled_anew(tmp_path: Path) -> None:
    """An index that names a module of an earlier version: numba reads it before it compares the date of the source."""
    (tmp_path / "squares.py").write_text("def square(x):\n    return x * x\n")
    spec = spec_from_file_location("squares", tmp_path / "squares.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    assert compile_function(module.square)(3.0) == 9.0
    (index,) = tmp_path.rglob("*.nbi")
    index.write_bytes(pickle.dumps(numba.__version__) + b"cmodule_of_an_earlier_version\nname\n.")
    assert compile_function(module.square)(4.0) == 16.0
