"""The bench test: geometry from first principles, eccentricity told from incidence, the table that was put in."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.virtual_bench import FULL_TURN, MIDDLE, BenchTest, measure_bench, vertex_table
from ltsim.adjustment.evaluation.bench import evaluate_reflector_bench, fit_vertex_offset
from ltsim.core.errors import InputError
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.smr_incidence import INCIDENCE_TABLE_ANGLES, PAPER_INCIDENCE_RANGE_ERRORS

PAPER = np.array(PAPER_INCIDENCE_RANGE_ERRORS) - PAPER_INCIDENCE_RANGE_ERRORS[MIDDLE]


def quiet(**changes: object) -> BenchTest:
    """A bench without noise and with a round sphere."""
    settings: dict[str, object] = {"roundness": 0.0, "probe_sigma": 0.0, "length_sigma": 0.0}
    return BenchTest(**(settings | changes))  # type: ignore[arg-type]


def test_a_turned_point_changes_the_length_as_a_rotation_says() -> None:
    point, far = np.array([30e-6, -20e-6]), 2.0
    lengths = []
    for alpha in INCIDENCE_TABLE_ANGLES:
        turn = np.array([[np.cos(alpha), -np.sin(alpha)], [np.sin(alpha), np.cos(alpha)]])
        lengths.append(far - (turn @ point)[0])
    record = measure_bench(quiet(table=np.zeros(9), eccentricity=point), 1)
    np.testing.assert_allclose(record.lengths - record.lengths[0], np.array(lengths) - lengths[0], atol=1e-15)


def test_the_probe_measures_the_same_point_from_its_side() -> None:
    point = np.array([30e-6, -20e-6])
    record = measure_bench(quiet(table=np.zeros(9), eccentricity=point), 1)
    angles = np.arctan2(point[1], point[0]) + FULL_TURN
    np.testing.assert_allclose(record.probe_displacements, np.hypot(*point) * np.sin(angles), atol=1e-15)


def test_without_noise_everything_comes_back() -> None:
    result = evaluate_reflector_bench(measure_bench(quiet(eccentricity=np.array([40e-6, 26e-6])), 3))
    np.testing.assert_allclose(result.eccentricity, [40e-6, 26e-6], atol=1e-14)
    np.testing.assert_allclose(result.range_errors, PAPER, atol=1e-14)
    assert np.abs(result.uncorrected_lengths - PAPER).max() > 10 * MICROMETRE


def test_26_um_to_the_side_look_like_13_um_at_30_deg() -> None:
    result = evaluate_reflector_bench(measure_bench(quiet(table=np.zeros(9), eccentricity=np.array([0.0, 26e-6])), 4))
    assert np.abs(result.uncorrected_lengths).max() == pytest.approx(13 * MICROMETRE, rel=1e-9)
    assert np.abs(result.range_errors).max() < 1e-12
    assert result.run_out == pytest.approx(52 * MICROMETRE, rel=1e-3)


def test_lobes_of_the_sphere_do_not_reach_the_table_over_a_full_turn() -> None:
    result = evaluate_reflector_bench(measure_bench(quiet(roundness=2e-6, eccentricity=np.array([5e-6, 8e-6])), 5))
    np.testing.assert_allclose(result.range_errors, PAPER, atol=1e-12)


def test_declared_sigmas_cover_the_spread() -> None:
    bench = BenchTest(eccentricity=np.array([3e-6, -4e-6]), roundness=0.0)
    results = [evaluate_reflector_bench(measure_bench(bench, 6, trial)) for trial in range(400)]
    spread = np.std([r.range_errors - PAPER for r in results], axis=0)
    sigmas = np.sqrt(np.mean([r.range_error_sigmas**2 for r in results], axis=0))
    is_not_middle = np.arange(9) != MIDDLE
    np.testing.assert_allclose(
        spread[is_not_middle], sigmas[is_not_middle], rtol=0.15
    )  # 3.5 % one sigma for 400 trials
    assert spread[MIDDLE] == 0.0


def test_a_vertex_off_centre_is_named() -> None:
    vertex = fit_vertex_offset(INCIDENCE_TABLE_ANGLES, vertex_table(-97e-6, 26e-6), 0.14e-6)
    assert vertex.axial_offset == pytest.approx(-97e-6, abs=1e-12)
    assert vertex.side_offset == pytest.approx(26e-6, abs=1e-12)
    assert vertex.unexplained_rms < 1e-12
    assert (
        fit_vertex_offset(INCIDENCE_TABLE_ANGLES, np.array(PAPER_INCIDENCE_RANGE_ERRORS), 0.14e-6).unexplained_rms
        > 0.2 * MICROMETRE
    )


def test_impossible_benches_are_refused_in_a_sentence() -> None:
    with pytest.raises(InputError, match="one per angle"):
        BenchTest(table=np.zeros(3))
    with pytest.raises(InputError, match="3 or more"):
        BenchTest(probe_angles=np.zeros(2))
