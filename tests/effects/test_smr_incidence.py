from __future__ import annotations

import numpy as np
import pytest

from ltsim.arrays import Floats
from ltsim.effects.smr_incidence import EDGE, PAPER_TABLE, TABLE_ANGLES, SmrIncidence
from ltsim.scene.sightings import Sightings
from ltsim.units import DEGREE, MICROMETRE

NORMAL = np.array([1.0, 0.0, 0.0])


def sightings(incidence: Floats, direction: Floats, *, reaimed: bool = False, known: bool = True) -> Sightings:
    """One target at the origin that looks along +x; a station in each wanted direction, 4 m away."""
    count = len(incidence)
    side, above = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    sideways = np.cos(direction)[:, None] * side + np.sin(direction)[:, None] * above
    toward = np.cos(incidence)[:, None] * NORMAL + np.sin(incidence)[:, None] * sideways
    index = np.arange(count)
    return Sightings(
        station=index,
        target=np.zeros(count, dtype=np.int64),
        instrument=np.zeros(count, dtype=np.int64),
        face=np.ones(count, dtype=np.int64),
        repeat=np.ones(count, dtype=np.int64),
        time=index.astype(np.float64),
        position=4.0 * toward,
        rotation=np.tile(np.eye(3), (count, 1, 1)),
        points=np.zeros((1, 3)),
        nest_normal=NORMAL[None, :] if known else np.full((1, 3), np.nan),
        reaimed=np.array([reaimed]),
        station_names=tuple(f"S{i}" for i in index),
        target_names=("T",),
    )


def signed(angles: Floats) -> tuple[Floats, Floats]:
    """Incidence and direction of signed angles in the plane of the table."""
    return np.abs(angles), np.where(angles < 0, np.pi, 0.0)


def test_table_has_the_size_and_asymmetry_of_the_paper() -> None:
    table = np.array(PAPER_TABLE) / MICROMETRE
    middle = np.abs(TABLE_ANGLES) < 8 * DEGREE
    assert table[middle].mean() == pytest.approx(3.0, abs=0.5)
    assert table.max() == table[0] == pytest.approx(13.0)
    assert np.all(table[:4] > table[:4:-1])
    assert np.all(np.diff(table[:4]) < 0) and np.all(np.diff(table[4:]) > 0)


def test_exact_form_meets_the_table_at_its_own_angles() -> None:
    scene = sightings(*signed(TABLE_ANGLES))
    change = SmrIncidence(table=PAPER_TABLE).shift(scene, np.zeros(5))
    np.testing.assert_allclose(change[:, 0], PAPER_TABLE, atol=1e-12)
    assert not change[:, 1:].any()


def test_direction_turns_the_table_around_the_nest() -> None:
    chi = 0.7
    incidence, direction = signed(TABLE_ANGLES)
    turned = SmrIncidence(table=PAPER_TABLE, direction=chi).shift(sightings(incidence, direction + chi), np.zeros(5))
    np.testing.assert_allclose(turned[:, 0], PAPER_TABLE, atol=1e-12)


def test_across_the_plane_only_the_even_part_is_left() -> None:
    angle = np.full(2, 30 * DEGREE)
    across = SmrIncidence(table=PAPER_TABLE).shift(sightings(angle, np.array([0.5, -0.5]) * np.pi), np.zeros(5))
    np.testing.assert_allclose(across[:, 0], 0.5 * (PAPER_TABLE[0] + PAPER_TABLE[-1]), atol=1e-12)


def test_interpolation_stays_between_neighbours_and_is_smooth_in_the_middle() -> None:
    fine = np.linspace(-30, 30, 481) * DEGREE
    error = SmrIncidence(table=PAPER_TABLE).table_error(*signed(fine))
    assert error.min() >= min(PAPER_TABLE) - 0.05 * MICROMETRE
    assert error.max() <= max(PAPER_TABLE) + 1e-12
    step = np.diff(error) / np.diff(fine)
    assert np.max(np.abs(np.diff(step))) < 0.1 * np.ptp(step)


def test_reaimed_reflectors_keep_the_central_value_only() -> None:
    incidence, direction = signed(TABLE_ANGLES)
    effect = SmrIncidence(table=PAPER_TABLE)
    scene = sightings(incidence, direction, reaimed=True)
    np.testing.assert_allclose(effect.shift(scene, np.ones(5))[:, 0], PAPER_TABLE[4], atol=1e-12)
    assert not effect.design(scene).any()


def test_unknown_nests_give_no_terms_and_nothing_undefined() -> None:
    scene = sightings(np.array([0.3]), np.array([0.2]), known=False)
    assert not SmrIncidence().design(scene).any()
    assert np.isfinite(SmrIncidence(table=PAPER_TABLE).shift(scene, np.zeros(5))).all()


def test_first_order_terms_have_their_size_at_the_edge() -> None:
    scene = sightings(np.full(4, EDGE), np.array([0.0, np.pi / 2, np.pi / 3, np.pi / 6]))
    design = SmrIncidence().design(scene)
    linear = np.array([[1, 0], [0, 1], [0.5, np.sqrt(0.75)], [np.sqrt(0.75), 0.5]])
    np.testing.assert_allclose(design[:, 0, :2], -linear, atol=1e-9)
    np.testing.assert_allclose(design[:, 0, 2], -1.0, atol=1e-9)
    np.testing.assert_allclose(design[:, 0, 3:], -np.array([[1, 0], [0, -1], [-1, 0], [0, 1]]), atol=1e-9)
    assert not design[:, 1:].any()


def test_first_order_terms_fit_most_of_the_table() -> None:
    """What the search fits leaves little of what the simulator adds, in the plane and off it."""
    rng = np.random.default_rng(3)
    scene = sightings(rng.uniform(0, EDGE, 200), rng.uniform(-np.pi, np.pi, 200))
    error = SmrIncidence(table=PAPER_TABLE, direction=0.4).shift(scene, np.zeros(5))[:, 0]
    columns = np.column_stack([SmrIncidence().design(scene)[:, 0], np.ones(200)])
    left = error - columns @ np.linalg.lstsq(columns, error, rcond=None)[0]
    assert np.std(left) < 0.25 * np.std(error)


def test_acts_where_it_is_confined_to() -> None:
    scene = sightings(np.full(3, 0.3), np.zeros(3))
    confined = SmrIncidence(("S1",), table=PAPER_TABLE).shift(scene, np.full(5, 1e-6))
    assert np.flatnonzero(confined[:, 0]).tolist() == [1]
