"""Residual space, held-out error and blind spots against brute force."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace, orthonormal_columns
from ltsim.diagnosis.cross_validation import cross_validated_errors, random_fold_row_indices
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis
from ltsim.diagnosis.search import Searcher
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import Regressor, scalar_regressor
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME
from ltsim.physics.model.construction import misalignment_construction
from tests.networks import drawn, network


@pytest.fixture(scope="module")
def space() -> ResidualSpace:
    recording, _ = network(values=drawn(misalignment_construction(), 1), seed=1)
    return ResidualSpace.from_adjustment(adjust(recording, misalignment_construction()))


def law(carrier: str, driver: Regressor) -> EmpiricalLaw:
    return EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME[carrier][0], driver)


def test_the_drop_of_chi2_is_that_of_a_refit(space):
    wave = law("distance", Regressor("wave", ("azimuth",), constant=3.0))
    design_columns = space.whitened_design(wave)
    columns = orthonormal_columns(space.project(design_columns), np.linalg.norm(design_columns, axis=0))
    again = adjust(space.adjustment.recording, misalignment_construction(), effects=[wave])
    assert columns.shape[1] == 2
    drop = float(((columns.T @ space.whitened_residuals) ** 2).sum())
    assert drop == pytest.approx(space.adjustment.chi2 - again.chi2, abs=1e-2)


def test_with_a_selected_model_the_decrease_is_that_of_a_joint_refit(space):
    first, second = (
        law("elevation", scalar_regressor("time", "power")),
        law("elevation", scalar_regressor("distance", "power", 2.0)),
    )
    extended = space.with_design_columns(space.whitened_design(first))
    design_columns = space.whitened_design(second)
    columns = orthonormal_columns(extended.project(design_columns), np.linalg.norm(design_columns, axis=0))
    adjustment = adjust(space.adjustment.recording, misalignment_construction(), effects=[first])
    both = adjust(space.adjustment.recording, misalignment_construction(), effects=[first, second])
    drop = float(((columns.T @ extended.whitened_residuals) ** 2).sum())
    assert drop == pytest.approx(adjustment.chi2 - both.chi2, abs=1e-2)


def test_held_out_error_is_that_of_refits_without_the_fold(space):
    recording = space.adjustment.recording
    square, count = 0.0, 0
    for rows in random_fold_row_indices(space, 0):
        out = np.zeros(len(recording), dtype=bool)
        out[rows // 3] = True
        use = np.broadcast_to(~out[:, None], (len(recording), 3))
        rest = adjust(recording, misalignment_construction(), reading_mask=use, start_state=space.adjustment.state)
        system = rest.problem.__class__.from_model(rest.problem.model).linearise(rest.state)
        held = np.flatnonzero(np.repeat(out, 3))
        design, gap = system.design[held] @ np.eye(system.design.shape[1]), system.whitened_residuals[held]
        spread = design @ rest.factorised_normals.multiply_by_covariance(design.T)
        square += float(gap @ np.linalg.solve(np.eye(len(gap)) + spread, gap))
        count += len(gap)
    assert cross_validated_errors(space, 0).rms_without_model == pytest.approx(np.sqrt(square / count), rel=1e-3)


def test_held_out_error_is_1_where_the_model_holds(space):
    assert cross_validated_errors(space, 0).rms_without_model == pytest.approx(1.0, abs=0.1)


def test_folds_are_whole_pointings_and_all_of_them(space):
    groups = random_fold_row_indices(space, 3)
    assert sorted(np.concatenate(groups)) == list(range(int(space.is_used_reading.sum())))
    assert all(set(rows // 3) == set(rows[::3] // 3) and len(rows) % 3 == 0 for rows in groups)


def test_all_pointings_of_a_target_from_a_set_up_are_in_the_same_fold():
    recording, _ = network(seed=3, stations=3, repeats=2)
    groups = random_fold_row_indices(ResidualSpace.from_adjustment(adjust(recording, misalignment_construction())), 3)
    pair = recording.station * len(recording.targets) + recording.target
    folds = [set(pair[rows // 3]) for rows in groups]
    assert len(set().union(*folds)) == sum(map(len, folds))


def test_held_out_readings_contradict_a_law_that_they_do_not_follow(space):
    """The same law is subtracted from readings that follow it, and from those that follow its negative."""
    wave = space.whitened_design(law("distance", Regressor("wave", ("azimuth",), constant=3.0)))
    change, rows = 8e-6 * space.project(wave[:, 0]), np.count_nonzero(space.is_used_reading)
    follows, opposes = (
        replace(space, whitened_residuals=space.whitened_residuals + sign * change) for sign in (1.0, -1.0)
    )
    effect = Hypothesis(law("distance", Regressor("wave", ("azimuth",), constant=3.0)), 0.0, 0.0, "unknown")
    model = EffectModel(
        (effect,), (space.project(wave),), np.linalg.norm(wave, axis=0)[None], follows.whitened_residuals
    )
    search = SimpleNamespace(without_rows=lambda _: SimpleNamespace(select_effects=lambda *_, **__: model))
    supported, contradicted = (cross_validated_errors(data, 0, search) for data in (follows, opposes))
    assert supported.log_odds_of_model == 0.0
    assert contradicted.log_odds_of_model < -10.0
    for error in (supported, contradicted):
        assert error.log_score_gain == pytest.approx(
            0.5 * rows * (error.rms_without_model**2 - error.rms_with_model**2)
        )


@pytest.mark.long
def test_a_spurious_finding_does_not_predict_held_out_readings():
    """On clean recordings the search is made to find something: the error on held-out readings rises in most."""
    falls = 0
    for seed in range(6):
        recording, _ = network(seed=seed, stations=3)
        clean = ResidualSpace.from_adjustment(adjust(recording, misalignment_construction()))
        error = cross_validated_errors(clean, seed, Searcher(clean, seed))
        falls += error.rms_with_model < error.rms_without_model
    assert falls <= 3


@pytest.mark.long
def test_a_real_finding_predicts_held_out_readings(space):
    wave = space.whitened_design(law("distance", Regressor("wave", ("azimuth",), constant=3.0)))[:, 0]
    hidden = replace(space, whitened_residuals=space.whitened_residuals + 8e-6 * space.project(wave))
    error = cross_validated_errors(hidden, 0, Searcher(hidden, 0))
    assert error.rms_with_model < 0.97 * error.rms_without_model
    assert error.log_odds_of_model == 0.0
