"""Residual space, held-out error and blind spots against brute force."""

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace, orthonormal
from ltsim.diagnosis.held_out import held_out_rms, pairs
from ltsim.laws.carriers import CARRIERS
from ltsim.laws.drivers import Driver, simple
from ltsim.laws.law import Law
from ltsim.model.construction import misalignment
from tests.networks import drawn, network


@pytest.fixture(scope="module")
def space() -> ResidualSpace:
    recording, _ = network(values=drawn(misalignment(), 1), seed=1)
    return ResidualSpace.of(adjust(recording, misalignment()))


def law(carrier: str, driver: Driver) -> Law:
    return Law((), (), CARRIERS[carrier][0], driver)


def test_the_drop_of_chi2_is_that_of_a_refit(space):
    wave = law("distance", Driver("wave", ("azimuth",), constant=3.0))
    signature = space.signature(wave)
    columns = orthonormal(space.project(signature), np.linalg.norm(signature, axis=0))
    again = adjust(space.adjustment.recording, misalignment(), effects=[wave])
    assert columns.shape[1] == 2
    drop = float(((columns.T @ space.residual) ** 2).sum())
    assert drop == pytest.approx(space.adjustment.chi2 - again.chi2, abs=1e-2)


def test_beside_what_was_found_the_drop_is_that_of_a_joint_refit(space):
    first, second = law("elevation", simple("time", "power")), law("elevation", simple("distance", "power", 2.0))
    extended = space.extended(space.signature(first))
    signature = space.signature(second)
    columns = orthonormal(extended.project(signature), np.linalg.norm(signature, axis=0))
    one = adjust(space.adjustment.recording, misalignment(), effects=[first])
    both = adjust(space.adjustment.recording, misalignment(), effects=[first, second])
    drop = float(((columns.T @ extended.residual) ** 2).sum())
    assert drop == pytest.approx(one.chi2 - both.chi2, abs=1e-2)


def test_held_out_error_is_that_of_refits_without_the_fold(space):
    recording = space.adjustment.recording
    folds = pairs(space)
    chosen = np.unique(folds)[:6]
    square, count = 0.0, 0
    by_reading = folds.reshape(-1, 3)[:, 0]
    for fold in chosen:
        out = by_reading == fold
        use = np.broadcast_to(~out[:, None], (len(recording), 3))
        rest = adjust(recording, misalignment(), use=use, start=space.adjustment.state)
        full = rest.problem.__class__.of(rest.problem.model)
        system = full.linearise(rest.state)
        held = np.flatnonzero(np.repeat(out, 3))
        rows, gap = system.design[held] @ np.eye(system.design.shape[1]), system.residual[held]
        spread = rows @ rest.factor.covariance_columns(rows.T)
        square += float(gap @ np.linalg.solve(np.eye(len(gap)) + spread, gap))
        count += len(gap)
        assert rest.problem.use.sum() == full.use.sum() - len(gap)
    assert held_out_rms(space, chosen) == pytest.approx(np.sqrt(square / count), rel=1e-3)


def test_held_out_error_is_one_where_the_model_holds(space):
    assert held_out_rms(space) == pytest.approx(1.0, abs=0.1)
