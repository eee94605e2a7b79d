"""The incidence error of fixed nests in the forward model: where it is, and its prior after a bench test."""

from __future__ import annotations

import numpy as np
import pytest

import ltsim as lt
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.effects.smr_incidence import INCIDENCE_TABLE_ANGLES, PAPER_INCIDENCE_RANGE_ERRORS, SmrIncidence
from ltsim.physics.model.construction import ideal_construction
from ltsim.physics.model.incidence import incidence_errors, incidence_prior_from_bench_test
from ltsim.physics.model.measurement import MeasurementModel
from ltsim.recordings import Recording
from ltsim.recordings.setup import BenchTest

TABLE = np.array(PAPER_INCIDENCE_RANGE_ERRORS) / MICROMETRE


def recorded(**changes: object) -> Recording:
    return lt.simulate(lt.scenario("paper-workshop", changes), seed=3).recording


def bench(sigma: float = 0.2, **settings: object) -> BenchTest:
    angles = tuple((INCIDENCE_TABLE_ANGLES / DEGREE).tolist())
    return BenchTest(angle_deg=angles, error_um=tuple(TABLE.tolist()), sigma_um=(sigma,) * len(angles), **settings)


def extra(recording: Recording, *effects: SmrIncidence) -> int:
    return MeasurementModel(recording, ideal_construction(), effects).n_extra_parameters


def test_it_is_estimated_where_nests_are_fixed_and_the_plan_turns_them() -> None:
    fixed = recorded()
    assert extra(fixed) == len(SmrIncidence.parameters)
    assert extra(recorded(**{"smr.nest_orientation": "re-aimed"})) == 0
    nowhere = {
        name: s.model_copy(update={"position_mm": None, "yaw_deg": None}) for name, s in fixed.setup.stations.items()
    }
    assert extra(fixed.replace(setup=fixed.setup.model_copy(update={"stations": nowhere}))) == 0


def test_an_effect_without_a_prior_takes_its_place() -> None:
    fixed = recorded()
    assert extra(fixed, SmrIncidence()) == len(SmrIncidence.parameters)
    assert extra(fixed, SmrIncidence(("S2",))) == 2 * len(SmrIncidence.parameters)


def test_each_reflector_has_a_separate_error() -> None:
    fixed = recorded(**{"targets.T01.reflector": "B", "targets.T02.reflector": "B"})
    first, second = incidence_errors(fixed)
    np.testing.assert_array_equal(first.reflector_indicator + second.reflector_indicator, 1.0)
    named = {
        fixed.targets[t]
        for t in fixed.target[
            (first.reflector_indicator if first.reflector_indicator.sum() < 70 else second.reflector_indicator) > 0
        ]
    }
    assert named == {"T01", "T02"}


def test_a_bench_test_is_met_within_its_uncertainty_and_leaves_what_it_did_not_see() -> None:
    mean, root = incidence_prior_from_bench_test(bench(direction_deg=20.0))
    truth = SmrIncidence(table=PAPER_INCIDENCE_RANGE_ERRORS, direction=20.0 * DEGREE).parameter_values_of_table
    angles = np.abs(INCIDENCE_TABLE_ANGLES), np.where(INCIDENCE_TABLE_ANGLES < 0, np.pi, 0.0) + 20.0 * DEGREE
    design = SmrIncidence.range_correction_design(*angles)
    np.testing.assert_allclose(design @ mean, design @ truth, atol=0.5e-6)
    assert np.sqrt(np.sum((design @ root) ** 2, axis=1)).max() < 0.5e-6
    across = SmrIncidence.range_correction_design(np.full(1, 30 * DEGREE), np.full(1, 110.0 * DEGREE))
    assert np.linalg.norm(across @ root) > 3e-6


def test_a_bench_test_from_any_zero_conditions_the_prior_exactly() -> None:
    """Mean and covariance are those of Bayes' rule written out, without roots."""
    test = bench(1.5)
    mean, root = incidence_prior_from_bench_test(test.model_copy(update={"error_um": tuple((TABLE + 40.0).tolist())}))
    terms = -SmrIncidence.range_correction_design(
        np.abs(INCIDENCE_TABLE_ANGLES), np.where(INCIDENCE_TABLE_ANGLES < 0, np.pi, 0.0)
    )
    rows, gap = np.delete(terms - terms[4], 4, axis=0), np.delete(TABLE - TABLE[4], 4) * MICROMETRE
    prior = np.diag(SmrIncidence().plausible_sizes ** 2)
    gain = prior @ rows.T @ np.linalg.inv(rows @ prior @ rows.T + np.eye(8) * (1.5 * MICROMETRE) ** 2)
    np.testing.assert_allclose(mean, gain @ gap, atol=1e-12)
    np.testing.assert_allclose(root @ root.T, prior - gain @ rows @ prior, atol=1e-18)


@pytest.mark.long
def test_calibration_uses_the_bench_test_of_the_setup() -> None:
    """It halves what the error of reflectors adds to the variance of the lateral beam offset, at least."""
    plain = recorded()
    tested = plain.replace(setup=plain.setup.model_copy(update={"bench": (bench(),)}))
    aimed = recorded(**{"smr.nest_orientation": "re-aimed", "smr.incidence_error": False})
    variances = []
    for recording in (plain, tested, aimed):
        calibration = lt.calibrate(recording, advise=False)
        variances.append(
            calibration.sigma[0, calibration.instrument_parameter_names.index("azimuth-eccentricity-sin")] ** 2
        )
    without, with_bench, none = variances
    assert with_bench - none < 0.5 * (without - none)


def test_a_bench_test_comes_back_from_its_file(tmp_path) -> None:  # type: ignore[no-untyped-def]
    plain = recorded()
    tested = plain.replace(setup=plain.setup.model_copy(update={"bench": (bench(reflector="A"), bench(0.3))}))
    lt.write(tested, tmp_path / "rec")
    assert lt.read(tmp_path / "rec").setup.bench == tested.setup.bench


def test_a_bench_test_of_unequal_columns_is_refused() -> None:
    with pytest.raises(ValueError, match="9 values of angle_deg, 2 of error_um and 9 of sigma_um"):
        BenchTest.model_validate(bench().model_dump() | {"error_um": (1.0, 2.0)})
