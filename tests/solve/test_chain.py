"""Sparse elimination and the chain of blocks against dense algebra."""

import numpy as np
import pytest
import scipy.sparse as sp

from ltsim.core.randomness import random_stream
from ltsim.solve.chain import MAX_SINGLE_BLOCK_COLUMNS, BlockChainFactor, chain_order_and_block_limits
from ltsim.solve.elimination import DenseElimination, SparseElimination


def ring(
    stations: int, shared: int, *, closed: bool = True, instruments: int = 1, seed: int = 0
) -> tuple[np.ndarray, int]:
    """Rows of stations (six unknowns) that see the targets (three) near them, and a few unknowns of each instrument.

    Each instrument stands at an equal part of the ring, and has an equal part of the shared unknowns.
    """
    rng = random_stream(seed, "ring")
    targets = 2 * stations
    n_border = 6 * stations + shared
    rows = []
    for s in range(stations):
        for t in range(2 * s - 5, 2 * s + 7):
            if not closed and not 0 <= t < targets:
                continue
            for _ in range(3):
                row = np.zeros(n_border + 3 * targets)
                row[6 * s : 6 * s + 6] = rng.standard_normal(6)
                row[6 * stations : n_border] = rng.standard_normal(shared)
                row[6 * stations : n_border] *= (
                    np.arange(shared) * instruments // max(shared, 1) == s * instruments // stations
                )
                at = n_border + 3 * (t % targets)
                row[at : at + 3] = rng.standard_normal(3)
                rows.append(row)
    alone = np.zeros((6 + shared, n_border + 3 * targets))
    alone[np.arange(6), np.arange(6)] = 3.0
    alone[6 + np.arange(shared), 6 * stations + np.arange(shared)] = 1.0
    design = np.vstack([*rows, alone])
    shuffled = rng.permutation(6 * stations)
    design[:, : 6 * stations] = design[:, shuffled]
    return design / np.linalg.norm(design, axis=0), n_border


@pytest.mark.parametrize("shared", [0, 5])
@pytest.mark.parametrize("closed", [True, False])
def test_a_ring_becomes_a_chain_and_gives_what_dense_algebra_gives(shared, closed):
    design, n_border = ring(90, shared, closed=closed)
    dense, sparse = DenseElimination(design, n_border, 0.0), SparseElimination(sp.csr_array(design), n_border, 0.0)
    assert sparse._schur_factor.n_blocks > 2
    right = random_stream(1, "right").standard_normal((design.shape[1], 2))
    np.testing.assert_allclose(sparse.solve(right), dense.solve(right), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(sparse.retained_inverse, dense.retained_inverse, rtol=1e-7, atol=1e-9)
    for ours, theirs in zip(sparse.inverse_blocks_and_leverage, dense.inverse_blocks_and_leverage, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-9)
    columns = np.array([[0, 1], [5, 5]]) if not shared else np.array([[n_border - 1, n_border - 2], [3, n_border - 1]])
    np.testing.assert_allclose(
        sparse.inverse_submatrices(columns), dense.inverse_submatrices(columns), rtol=1e-7, atol=1e-9
    )


@pytest.mark.parametrize("instruments", [2, 4])
def test_parameters_of_several_instruments_are_the_border_of_a_chain(instruments: int) -> None:
    design, n_border = ring(96, 24, instruments=instruments)
    dense, sparse = DenseElimination(design, n_border, 0.0), SparseElimination(sp.csr_array(design), n_border, 0.0)
    factor = sparse._schur_factor
    assert factor.n_blocks > 2 and np.all(factor.block_of_column[n_border - 24 :] == factor.n_blocks)
    right = random_stream(1, "right").standard_normal((design.shape[1], 2))
    np.testing.assert_allclose(sparse.solve(right), dense.solve(right), rtol=1e-7, atol=1e-9)


def test_distant_sets_are_solved_too():
    design, n_border = ring(90, 0)
    dense, sparse = DenseElimination(design, n_border, 0.0), SparseElimination(sp.csr_array(design), n_border, 0.0)
    block_of = sparse._schur_factor.block_of_column
    far = np.array([[int(np.argmin(block_of)), int(np.argmax(block_of))]])
    np.testing.assert_allclose(sparse.inverse_submatrices(far), dense.inverse_submatrices(far), rtol=1e-7, atol=1e-9)


def test_damping_is_that_of_the_unit_diagonal():
    design, n_border = ring(60, 2)
    right = random_stream(1, "right").standard_normal((design.shape[1], 1))
    expected = np.linalg.solve(design.T @ design + 0.3 * np.eye(design.shape[1]), right)
    for elimination in (
        DenseElimination(design, n_border, 0.3),
        SparseElimination(sp.csr_array(design), n_border, 0.3),
    ):
        np.testing.assert_allclose(elimination.solve(right), expected, atol=1e-9)


def test_a_matrix_without_a_narrow_order_is_a_single_block():
    rng = random_stream(2, "matrix")
    size = MAX_SINGLE_BLOCK_COLUMNS + 60
    root = rng.standard_normal((size, size)) + size * np.eye(size)
    matrix = root @ root.T
    chain = BlockChainFactor(sp.csr_array(matrix))
    assert chain.n_blocks == 1
    np.testing.assert_allclose(chain.inverse(), np.linalg.inv(matrix), rtol=1e-8, atol=1e-12)


def test_the_order_of_a_shuffled_band_is_narrow_again():
    rng = random_stream(3, "band")
    size = 1000
    band = sp.diags_array([np.ones(size - abs(k)) for k in range(-4, 5)], offsets=range(-4, 5)).tocsr()
    shuffle = rng.permutation(size)
    order, edges = chain_order_and_block_limits(sp.csr_array(band[shuffle][:, shuffle]))
    assert len(edges) > 15
    assert sorted(order.tolist()) == list(range(size))


def test_entries_that_are_stored_as_zero_ask_for_nothing():
    """As a level line of sight has in its height: a product with it is 0 and has no entry, by the readings' seed."""
    rng, n_border, blocks = random_stream(4, "zeros"), 2, 3
    design = np.zeros((9 * blocks, n_border + 3 * blocks))
    design[:, :n_border] = rng.standard_normal((len(design), n_border))
    row = np.arange(len(design))
    first = n_border + 3 * (row % blocks)
    design[row, first + row // blocks % 3] = 1.0 + rng.random(len(design))
    at = np.concatenate([np.tile(np.arange(n_border), (len(design), 1)), first[:, None] + np.arange(3)], axis=1)
    stored = sp.csr_array((design[row[:, None], at].ravel(), (np.repeat(row, n_border + 3), at.ravel())), design.shape)
    assert stored.nnz > np.count_nonzero(design)
    dense, sparse = DenseElimination(design, n_border, 0.3), SparseElimination(stored, n_border, 0.3)
    edges = np.arange(0, len(design) + 1, 3)
    for ours, theirs in zip(
        sparse.covariances_of_functions(stored, edges), dense.covariances_of_functions(stored, edges), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)
