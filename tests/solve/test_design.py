"""A design is the same whether it is kept dense or sparse."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp

from ltsim.core.randomness import random_stream
from ltsim.solve import design
from ltsim.solve.design import DesignMatrix, SparsityPattern, inverse_column_norms, scale_columns, to_dense


@pytest.mark.parametrize("limit", [10**6, 0])
def test_a_pattern_puts_values_where_they_belong(monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    monkeypatch.setattr(design, "MAX_DENSE_ENTRIES", limit)
    rng = random_stream(0, "pattern")
    columns = [rng.integers(0, 7, (5, 4)), np.zeros((0, 3), dtype=np.int64), rng.integers(0, 7, (3, 1))]
    values = [rng.standard_normal(kind.shape) for kind in columns]
    expected = np.zeros((8, 9))  # the last two columns are empty
    rows = [np.repeat(np.arange(5), 4), np.zeros(0, dtype=np.int64), np.arange(5, 8)]
    for row, kind, value in zip(rows, columns, values, strict=True):
        np.add.at(expected, (row, kind.ravel()), value.ravel())
    pattern = SparsityPattern(columns, 9)
    for factor in (1.0, 2.0):
        made = pattern.make_design_matrix([factor * value for value in values])
        assert isinstance(made, sp.csr_array if limit == 0 else np.ndarray)
        np.testing.assert_allclose(to_dense(made), factor * expected)


@pytest.mark.parametrize("kind", [np.array, sp.csr_array])
def test_scaled_columns_are_of_unit_length_and_empty_ones_stay(kind: Callable[[np.ndarray], DesignMatrix]) -> None:
    rows = np.array([[0.0, 3e-9, 3.0, 0.0], [4.0, 4e-9, 0.0, 0.0]])
    scale = inverse_column_norms(kind(rows))
    np.testing.assert_allclose(scale_columns(sp.csr_array(rows), scale).toarray(), [[0, 0.6, 1, 0], [1, 0.8, 0, 0]])
    assert scale[3] == 1.0
