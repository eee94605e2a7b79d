"""Rank is decided by the stated tolerances: near them, far from them, for any unit."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp

from ltsim.core.randomness import random_stream
from ltsim.solve.design import (
    DESIGN_RANK_TOLERANCE,
    MIN_RELIABLE_PIVOT,
    NORMAL_RANK_TOLERANCE,
    DesignMatrix,
    cholesky_where_determined,
    scale_to_unit_diagonal,
)
from ltsim.solve.elimination import BlockSystem, FactorisedNormals, SingularSystemError


def nearly_dependent(size: int, image: float, seed: int = 0) -> np.ndarray:
    """Unit columns (2 size, size) whose weakest unit combination has an image of this squared length."""
    rng = random_stream(seed, "nearly dependent", size)
    basis = np.linalg.qr(rng.standard_normal((2 * size, size)))[0]
    mix = rng.standard_normal(size - 1)
    last = basis[:, :-1] @ mix / np.linalg.norm(mix) + np.sqrt(2 * image) * basis[:, -1]
    return np.hstack([basis[:, :-1], last[:, None] / np.linalg.norm(last)])


CASES = (
    (100 * DESIGN_RANK_TOLERANCE, True),
    (3 * DESIGN_RANK_TOLERANCE, True),
    (DESIGN_RANK_TOLERANCE / 3, False),
    (0.0, False),
)


@pytest.mark.parametrize("kind", [np.array, sp.csr_array])
@pytest.mark.parametrize(("image", "determined"), CASES)
@pytest.mark.parametrize(("size", "n_reduced"), [(12, 12), (300, 300), (3, 0)])
def test_the_solver_decides_by_the_image_of_the_weakest_direction(
    size: int, n_reduced: int, image: float, determined: bool, kind: Callable[[np.ndarray], DesignMatrix]
) -> None:
    """Among the kept unknowns, or in a block that is eliminated; whatever the units."""
    design = nearly_dependent(size, image) * 10.0 ** random_stream(1, "unit").uniform(-6, 6, size)
    system = BlockSystem(kind(design), np.zeros(len(design)), n_reduced)
    if determined:
        assert FactorisedNormals(system).smallest_pivot < MIN_RELIABLE_PIVOT
    else:
        with pytest.raises(SingularSystemError):
            FactorisedNormals(system)
    FactorisedNormals(system, damping=1e-9)


def test_a_batch_decides_by_its_smallest_eigenvalue() -> None:
    images = np.array(
        [
            1.0,
            100 * NORMAL_RANK_TOLERANCE,
            3 * NORMAL_RANK_TOLERANCE,
            NORMAL_RANK_TOLERANCE / 3,
            DESIGN_RANK_TOLERANCE,
            0.0,
        ]
    )
    designs = [nearly_dependent(40, image) for image in images]
    normal = np.stack([d.T @ d for d in designs])
    roots, determined = cholesky_where_determined(normal)
    assert determined.tolist() == [True, True, True, False, False, False]
    np.testing.assert_allclose(roots[:3] @ np.swapaxes(roots[:3], 1, 2), normal[:3], atol=1e-14)
    assert np.isnan(roots[3:]).all()


def test_scaling_takes_the_unit_out_of_a_matrix() -> None:
    matrix = np.array([[[4e-20, 1e-10], [1e-10, 9.0]]])
    unit, scale = scale_to_unit_diagonal(matrix, np.einsum("bii->bi", matrix))
    np.testing.assert_allclose(unit, [[[1.0, 1.0 / 6.0], [1.0 / 6.0, 1.0]]])
    np.testing.assert_allclose(scale, [[0.5e10, 1 / 3]])
