"""Least absolute deviations against the linear program."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.solve.least_absolute import solve_least_absolute


def program(design: Floats, goal: Floats) -> Floats:
    rows, count = design.shape
    solution = linprog(
        np.r_[np.zeros(count), np.ones(2 * rows)],
        A_eq=np.hstack([design, np.eye(rows), -np.eye(rows)]),
        b_eq=goal,
        bounds=[(None, None)] * count + [(0, None)] * (2 * rows),
    )
    return np.asarray(solution.x[:count], dtype=np.float64)


@pytest.mark.parametrize("seed", range(6))
def test_solution_is_that_of_the_linear_program(seed: int) -> None:
    draw = random_stream(seed, "rows")
    design, goal = draw.standard_normal((150, 4)), draw.standard_normal(150)
    assert solve_least_absolute(design, goal) == pytest.approx(program(design, goal), abs=1e-5)


def test_rows_that_hang_together() -> None:
    """Differences between all pairs of five values, as in the distance objective: three equal ones meet three rows."""
    draw = random_stream(7, "pairs")
    design, goal = draw.standard_normal((30, 5, 3)), draw.standard_normal((30, 5))
    goal[:10] = goal[:10, :1]
    first, second = np.triu_indices(5, k=1)
    rows = (design[:, first] - design[:, second]).reshape(-1, 3)
    gap = (goal[:, first] - goal[:, second]).ravel()
    ours, theirs = (np.abs(gap - rows @ x).sum() for x in (solve_least_absolute(rows, gap), program(rows, gap)))
    assert ours == pytest.approx(theirs, rel=1e-6)


def test_outliers_take_nothing() -> None:
    draw = random_stream(8, "outliers")
    design, x = draw.standard_normal((200, 3)), np.array([1.0, -2.0, 3.0])
    goal = design @ x
    goal[::10] += 100.0
    assert solve_least_absolute(design, goal) == pytest.approx(x, abs=1e-6)


def test_a_start_changes_nothing() -> None:
    draw = random_stream(9, "start")
    design, goal = draw.standard_normal((150, 4)), draw.standard_normal(150)
    solution = solve_least_absolute(design, goal)
    assert solve_least_absolute(design, goal, start_solution=solution + 0.3) == pytest.approx(solution, abs=1e-12)
    assert np.array_equal(solve_least_absolute(design, np.zeros(150)), np.zeros(4))
