"""Known lengths with materials, temperatures and errors that several share; lengths that were measured in place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.rows import GaugeRows
from ltsim.core.errors import LtsimError, RecordError
from ltsim.geometry.expansion import ThermalExpansion
from ltsim.measurands.evaluation import evaluate_tasks
from ltsim.measurands.spec import TASKS_FORMAT, validate_tasks
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import ReferenceLengths
from ltsim.recordings.setup import GaugeDistance, LengthGauge
from ltsim.solve.design import to_dense
from tests.networks import mesh, network

STEEL = {"expansion_per_k": 11.5e-6, "sigma_expansion_per_k": 1e-6}
INVAR = {"expansion_per_k": 1.2e-6, "sigma_expansion_per_k": 0.3e-6}


def line(first: str, second: str, length: float = 2000.0, **more: Any) -> GaugeDistance:
    return GaugeDistance.model_validate({"from": first, "to": second, "length_mm": length, "sigma_mm": 0.001, **more})


def with_gauge(recording: Recording, *lines: GaugeDistance, **more: Any) -> Recording:
    gauge = LengthGauge.model_validate({"materials": {"steel": STEEL, "invar": INVAR}, "distance": lines, **more})
    return recording.replace(setup=recording.setup.model_copy(update={"gauge": gauge}))


@pytest.fixture(scope="module")
def measured() -> Recording:
    return network(seed=3)[0]


def test_a_length_expands_with_its_material_and_temperature(measured: Recording) -> None:
    recording = with_gauge(
        measured,
        line("T01", "T02", material="steel", measured_at_c=27.0, sigma_temperature_k=0.1),
        line("T03", "T04", material="steel"),
        line("T05", "T06", material="invar"),
        line("T07", "T08", measured_in_place=True, measured_at_c=27.0),
        measured_at_c=23.0,
        sigma_temperature_k=0.5,
        expansion_per_k=23e-6,
    )
    lengths = ReferenceLengths.from_recording(recording)
    np.testing.assert_allclose(lengths.expansion_factors - 1.0, [7 * 11.5e-6, 3 * 11.5e-6, 3 * 1.2e-6, 0.0], atol=1e-15)
    np.testing.assert_allclose(lengths.lengths, 2.0 * lengths.expansion_factors, rtol=1e-15)
    expected = {
        "expansion of steel": [14e-6, 6e-6, 0, 0],
        "temperature of T01-T02": [2.3e-6, 0, 0, 0],
        "temperature of the gauge": [0, 11.5e-6, 1.2e-6, 0],
        "expansion of invar": [0, 0, 1.8e-6, 0],
    }
    assert set(lengths.shared_error_shifts) == set(expected)
    for name, change in expected.items():
        np.testing.assert_allclose(lengths.shared_error_shifts[name], change, atol=1e-12, err_msg=name)


def test_a_column_gives_the_temperature_while_both_ends_were_measured(measured: Recording) -> None:
    warm = np.where(np.isin(measured.target, [0, 1]), 25.0 + measured.station, np.nan)
    recording = measured.replace(covariates={**measured.covariates, "bar_c": warm})
    with_column = with_gauge(recording, line("T01", "T02", material="steel", measured_at_c="bar_c"))
    assert ReferenceLengths.from_recording(with_column).expansion_factors[0] == pytest.approx(
        1 + 7 * 11.5e-6, abs=1e-12
    )
    for wrong, message in (
        (line("T01", "T02", measured_at_c="bar_k"), "expected a column of numbers"),
        (line("T03", "T04", measured_at_c="bar_c"), "contains no temperature in the pointings to T03 and T04"),
        (line("T01", "T02", material="brass"), "expected one of steel, invar"),
    ):
        with pytest.raises(RecordError, match=message):
            ReferenceLengths.from_recording(with_gauge(recording, wrong))


def test_the_rows_have_the_covariance_of_what_lengths_share(measured: Recording) -> None:
    lines = [line(f"T0{i}", f"T0{i + 1}", 1000.0 * i, material="steel") for i in (1, 3, 5)]
    recording = with_gauge(measured, *lines, measured_at_c=30.0, sigma_temperature_k=0.2)
    gauge = GaugeRows.from_recording(recording)
    length = np.array([1.0, 3.0, 5.0])
    shared = (10 * 1e-6) ** 2 + (11.5e-6 * 0.2) ** 2
    covariance = shared * np.outer(length, length) + 1e-6**2 * np.eye(3)
    np.testing.assert_allclose(
        gauge.covariance_cholesky_factor @ gauge.covariance_cholesky_factor.T, covariance, rtol=1e-12
    )
    white = gauge.decorrelate(np.eye(3))
    np.testing.assert_allclose(white @ covariance @ white.T, np.eye(3), atol=1e-12)
    idle = replace(gauge, is_unweighted=np.array([False, True, False]))
    indices = np.ix_([0, 2], [0, 2])
    decorrelated = idle.decorrelate(np.eye(3))
    np.testing.assert_allclose((decorrelated.T @ decorrelated)[indices], np.linalg.inv(covariance[indices]), rtol=1e-12)
    assert not decorrelated[:, 1].any()
    adjustment = adjust(recording)
    rows = to_dense(adjustment.solution.system.design)[int(adjustment.problem.is_used_reading.sum()) :][:3]
    columns = adjustment.problem.unknowns.target_columns[gauge.first_targets]
    along = gauge.line_directions(adjustment.state.target_points)
    np.testing.assert_allclose(np.stack([rows[:, c] for c in columns], axis=1) @ np.eye(3), white[:, :, None] * along)


def test_lengths_share_a_scale_or_tell_none(measured: Recording) -> None:
    lines = [line("T01", "T02", 2000.0), line("T03", "T04", 1000.0, measured_in_place=True)]
    gauge = GaugeRows.from_recording(with_gauge(measured, *lines, sigma_scale_ppm=20.0))
    covariance = 1e-6**2 * np.eye(2) + np.outer([40e-6, 20e-6], [40e-6, 20e-6])
    np.testing.assert_allclose(
        gauge.covariance_cholesky_factor @ gauge.covariance_cholesky_factor.T, covariance, rtol=1e-12
    )
    dof = {scale: adjust(with_gauge(measured, *lines, sigma_scale_ppm=scale)).dof for scale in (None, 20.0, 1000.0)}
    assert dof == {None: dof[None], 20.0: dof[None], 1000.0: dof[None] - 1}  # of two lengths one ratio is left


def test_a_length_measured_in_place_is_an_observation_with_its_sigma(measured: Recording) -> None:
    """An interferometer's length and a known one are the same row, in a workshop of any temperature."""
    points = adjust(measured).state.target_points
    ends = {"first": "T01", "second": "T08"}
    length = 1e3 * float(np.linalg.norm(points[0] - points[7]))
    plain = with_gauge(measured, line(*ends.values(), length))
    warm = with_gauge(measured, line(*ends.values(), length, measured_in_place=True), measured_at_c=35.0, **STEEL)
    adjustment, other = adjust(plain), adjust(warm)
    assert adjustment.dof == other.dof == adjust(with_gauge(measured)).dof + 1
    np.testing.assert_allclose(other.state.target_points, adjustment.state.target_points, atol=1e-12)
    tied = adjust(with_gauge(measured, line(*ends.values(), length + 0.02, measured_in_place=True)))
    gap = 1e3 * float(np.linalg.norm(tied.state.target_points[0] - tied.state.target_points[7])) - length
    assert 0.016 < gap < 0.02  # held to 1 um, against readings of some 10 um


def scene(**changes: Any) -> lt.Scenario:
    """The paper's workshop at 27 C with two bars of steel and one of invar in place of the gauge."""
    bars = [
        {"from": "T01", "to": "T24", "sigma_um": 1.0, "material": "steel"},
        {"from": "T03", "to": "T20", "sigma_um": 1.0, "material": "steel", "measured_at_c": "air_temperature_c"},
        {"from": "T05", "to": "T12", "sigma_um": 1.0, "material": "invar", "sigma_temperature_k": 0.1},
        {"from": "T02", "to": "T10", "sigma_um": 1.0, "measured_in_place": True},
    ]
    table = {"gauge": "none", "materials": {"steel": STEEL, "invar": INVAR}, "lengths": bars, **changes}
    return lt.scenario("paper-workshop", table)


@pytest.mark.long
def test_simulated_certificates_err_as_they_say_and_together() -> None:
    gaps, spread = [], np.zeros((0, 0))
    for seed in range(250):
        recording, truth = lt.simulate(scene(**{"work.repeats": 1}), seed=seed)
        gauge = GaugeRows.from_recording(recording)
        places = truth.target_points[[truth.target_names.index(name) for name in recording.targets]]
        gaps.append(gauge.decorrelate(gauge.lengths - gauge.predict(places)))
        spread = gauge.covariance_cholesky_factor
    both = np.array(gaps)
    np.testing.assert_allclose(np.corrcoef(both.T), np.eye(4), atol=0.2)
    np.testing.assert_allclose(both.std(axis=0), 1.0, atol=0.15)
    correlated = spread @ spread.T
    assert correlated[0, 1] / np.sqrt(correlated[0, 0] * correlated[1, 1]) > 0.9


def test_the_budget_names_what_lengths_share_and_adds_up(tmp_path: Path) -> None:
    recording, _ = lt.simulate(scene(), seed=1)
    lt.write(recording, tmp_path / "rec")
    assert lt.read(tmp_path / "rec").setup == recording.setup
    task = {"name": "far", "kind": "distance", "targets": ["T01", "T20"]}
    tables = {"format": TASKS_FORMAT, "source": "", "task": [task], "monte_carlo": {"max_trials": 10_000}}
    evaluation = evaluate_tasks(recording, validate_tasks(tables, "tasks"))
    shares = evaluation.linear_uncertainty.variance_by_source
    assert {"known lengths", "expansion of steel", "expansion of invar", "temperature of the gauge"} <= set(shares)
    assert evaluation.linear_uncertainty.evaluation_types["expansion of steel"] == "B"
    total = sum(share[0] for share in shares.values())
    assert total == pytest.approx(evaluation.linear_uncertainty.covariance[0, 0], rel=1e-9)
    adjusted = evaluation.inputs.network_or_coordinates
    names = [adjusted.recording.targets.index(name) for name in ("T01", "T20")]
    arm = adjusted.state.target_points[names[0]] - adjusted.state.target_points[names[1]]
    unit = np.concatenate([arm, -arm]) / np.linalg.norm(arm)
    at = adjusted.problem.unknowns.target_columns[names].ravel()
    pick = np.zeros((adjusted.problem.unknowns.n_columns, 6))
    pick[at, np.arange(6)] = 1.0
    whole = unit @ adjusted.factorised_normals.multiply_by_covariance(pick)[at] @ unit
    assert total == pytest.approx(whole, rel=1e-6)


def test_impossible_input_is_refused_in_a_sentence() -> None:
    for changes, message in (
        ({"lengths.1.from": "T99"}, "lengths.1.from names 'T99'"),
        ({"lengths.1.material": "brass"}, "not one of steel, invar"),
        ({"lengths.2.measured_at_c": "bar_c"}, "expected a number or 'air_temperature_c'"),
    ):
        with pytest.raises(LtsimError, match=message):
            scene(**changes)


def test_expansion_by_hand() -> None:
    grown = ThermalExpansion.from_temperature_difference(11.5e-6, -5.0, 1e-6, 0.1)
    assert grown.length_ratio == pytest.approx(1 - 57.5e-6)
    assert (grown.ratio_change_per_coefficient_sigma, grown.ratio_change_per_temperature_sigma) == pytest.approx(
        (-5e-6, 1.15e-6)
    )


@pytest.mark.parametrize(("scale", "is_accepted"), [(0.0, True), (12e-6, False)])
def test_what_a_check_accepts_is_rejected_by_no_verb(scale: float, is_accepted: bool) -> None:
    """The uncertainty of a scale error includes the specification of the instrument in all verbs."""
    recording = network(seed=31, faces=2)[0]
    scaled = recording.with_readings(recording.readings * [1.0 + scale, 1.0, 1.0])
    result = lt.check(scaled)
    assert result.passed == is_accepted
    assert is_accepted or "known lengths" in result.sentence
    plain, full = adjust(scaled), adjust(scaled, misalignment_construction())
    assert not is_accepted or not plain.rejected_references
    errors = [{t.name: t.error_sigmas for t in a.reference_tests if t.kind == "length"} for a in (plain, full)]
    assert errors[0].keys() == errors[1].keys()
    for name, sigma in errors[0].items():
        np.testing.assert_allclose(sigma, errors[1][name], rtol=0.01)


@pytest.mark.parametrize(("scale", "kinds"), [(5e-6, []), (15e-6, ["scale"])])
def test_a_scale_error_within_the_specification_is_no_wrong_length(scale: float, kinds: list[str]) -> None:
    """The specification of the scale is 2 ppm; the lengths determine it to 0.5 ppm."""
    recording, points = network(seed=32, faces=2)[0], mesh()
    lines = [
        line(f"T{a:02d}", f"T{b:02d}", 1e3 * float(np.linalg.norm(points[a - 1] - points[b - 1])))
        for a, b in ((1, 24), (4, 21), (2, 12))
    ]
    scaled = with_gauge(recording.with_readings(recording.readings * [1.0 + scale, 1.0, 1.0]), *lines)
    assert [test.kind for test in adjust(scaled).rejected_references] == kinds
