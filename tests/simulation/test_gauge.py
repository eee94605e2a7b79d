from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ltsim.core.errors import InputError
from ltsim.simulation.draws import StandardNormalSource
from ltsim.simulation.measurement_geometry import make_measurement_geometry
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.sections import CoordinateMeasuringMachine, ScenarioGauge
from ltsim.simulation.simulator import error_free_recording, trial_distributions
from ltsim.simulation.workshop import (
    PAPER_GAUGE_LENGTHS_MM,
    cmm_length_sigmas,
    gauge_expansion_factor,
    gauge_points_in_workshop,
    gauge_rotation,
    make_gauge_frame,
    measure_points_by_cmm,
    points_from_distances,
)

PLACE = (750.0, 750.0, 260.0)


@pytest.mark.parametrize("reading", ["columns", "rows"])
def test_both_readings_of_table_2_are_realised(reading: str) -> None:
    frame = make_gauge_frame(ScenarioGauge.model_validate({"position_mm": PLACE, "table_reading_order": reading}))
    np.testing.assert_allclose(frame.lengths * 1e3, PAPER_GAUGE_LENGTHS_MM[reading], atol=1e-7)


def test_by_columns_the_gauge_is_a_flat_near_parallelogram_by_rows_it_is_not() -> None:
    flat = make_gauge_frame(ScenarioGauge(position_mm=PLACE))
    assert np.sqrt(np.mean(flat.points[:, 2] ** 2)) == pytest.approx(0.55e-3, abs=0.1e-3)
    middles = 0.5 * (flat.points[1] + flat.points[2]), 0.5 * (flat.points[0] + flat.points[3])
    assert np.linalg.norm(middles[0] - middles[1]) == pytest.approx(1.6e-3, abs=0.3e-3)
    solid = make_gauge_frame(ScenarioGauge(position_mm=PLACE, table_reading_order="rows"))
    assert np.sqrt(np.mean(solid.points[:, 2] ** 2)) > 0.02


@given(st.integers(3, 7), st.integers(0, 10_000))
def test_points_are_recovered_from_their_distances(count: int, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    first, second = np.array(list(combinations(range(count), 2))).T
    lengths = np.linalg.norm(points[first] - points[second], axis=1)
    restored = points_from_distances(count, first, second, lengths)
    np.testing.assert_allclose(np.linalg.norm(restored[first] - restored[second], axis=1), lengths, atol=1e-9)


def square(diagonal_mm: float) -> list[dict[str, object]]:
    pairs = [("A", "B", 300.0), ("B", "C", 300.0), ("C", "D", 300.0), ("D", "A", 300.0)]
    pairs += [("A", "C", 300 * 2**0.5), ("B", "D", diagonal_mm)]
    return [{"from": a, "to": b, "length_mm": length} for a, b, length in pairs]


def test_gauges_of_users_need_all_their_lengths_and_must_fit_in_space() -> None:
    table = {"targets": ("A", "B", "C", "D"), "position_mm": PLACE}
    assert len(make_gauge_frame(ScenarioGauge.model_validate({**table, "distance": square(300 * 2**0.5)})).lengths) == 6
    with pytest.raises(InputError, match="the lengths contradict each other"):
        make_gauge_frame(ScenarioGauge.model_validate({**table, "distance": square(500.0)}))
    with pytest.raises(InputError, match="the length B-D is missing"):
        make_gauge_frame(ScenarioGauge.model_validate({**table, "distance": square(400.0)[:-1]}))
    with pytest.raises(InputError, match="is not a pair of"):
        make_gauge_frame(
            ScenarioGauge.model_validate({**table, "distance": [{"from": "A", "to": "X", "length_mm": 1}]})
        )
    with pytest.raises(InputError, match="has 3 reflectors"):
        make_gauge_frame(ScenarioGauge(position_mm=PLACE, targets=("A", "B", "C")))


def test_aluminium_grows_by_58_um_on_the_shortest_length() -> None:
    gauge = ScenarioGauge(position_mm=PLACE)
    frame = make_gauge_frame(gauge)
    points = gauge_points_in_workshop(gauge, frame, 27.0)
    grown = np.linalg.norm(points[frame.first_targets] - points[frame.second_targets], axis=1)
    assert (grown - frame.lengths)[0] == pytest.approx(357.6066e-3 * 23.2e-6 * 7, rel=1e-6)
    assert gauge_expansion_factor(gauge, 20.0) == 1.0
    assert gauge_expansion_factor(ScenarioGauge(position_mm=PLACE, measured_at_c=30.0), 27.0) == pytest.approx(
        1 + 23.2e-5
    )


def test_certificate_scatters_as_the_machine_promises() -> None:
    work = make_measurement_geometry(load_scenario("paper-workshop"), 1)
    lengths = make_gauge_frame(work.scenario.gauge).lengths
    drawn = trial_distributions(work, error_free_recording(work)).draw(StandardNormalSource(1, np.arange(400)))
    gaps = drawn.certified_lengths.T - lengths
    sigma = cmm_length_sigmas(CoordinateMeasuringMachine(), lengths)
    assert sigma[0] * 1e6 == pytest.approx((2.3 + 357.6066 / 300) / 2)
    np.testing.assert_allclose(gaps.std(axis=0) / sigma, 1.0, atol=0.15)
    np.testing.assert_allclose(np.corrcoef(gaps.T), np.eye(6), atol=0.2)


def test_nominal_points_keep_the_machine_within_its_largest_error() -> None:
    points = np.random.default_rng(1).uniform(0, 1, (12, 3))
    names = tuple(f"C{i}" for i in range(12))
    first, second = np.triu_indices(12, k=1)
    length = np.linalg.norm(points[first] - points[second], axis=1)
    gaps = []
    for k in range(400):
        measured = measure_points_by_cmm(points, names, CoordinateMeasuringMachine(), 1, k)
        gaps.append(np.linalg.norm(measured[first] - measured[second], axis=1) - length)
    limit = 2 * cmm_length_sigmas(CoordinateMeasuringMachine(), length)
    assert 0.93 < np.mean(np.abs(gaps) < limit) <= 1.0
    assert np.mean(np.abs(gaps) < 0.3 * limit) < 0.7


def test_orientation_turns_about_x_then_y_then_z() -> None:
    turned = gauge_rotation(ScenarioGauge(position_mm=PLACE, yaw_deg=90, roll_deg=90))
    np.testing.assert_allclose(turned @ [0.0, 1.0, 0.0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(turned @ [1.0, 0.0, 0.0], [0, 1, 0], atol=1e-12)
