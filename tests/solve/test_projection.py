"""Projection by the factor of a large system is that by an orthonormal basis."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from ltsim.core.randomness import random_stream
from ltsim.solve.elimination import BlockSystem, FactorisedNormals
from ltsim.solve.projection import BasisResidualProjector, FactorResidualProjector, make_residual_projector

N_REDUCED, BLOCKS, ROWS = 320, 130, 2600


def chained(seed: int = 1) -> BlockSystem:
    """Rows that touch a few neighbouring kept columns, two shared ones and one block: a ring of set-ups in small."""
    rng = random_stream(seed, "design")
    design = sp.lil_array((ROWS, N_REDUCED + 3 * BLOCKS))
    for i in range(ROWS):
        near = np.arange(6) + (i * N_REDUCED // ROWS) // 6 * 6
        block = N_REDUCED + 3 * ((i * BLOCKS // ROWS + int(rng.integers(0, 3))) % BLOCKS) + np.arange(3)
        columns = np.unique(np.concatenate([near % (N_REDUCED - 2), [N_REDUCED - 2, N_REDUCED - 1], block]))
        design[i, columns] = rng.standard_normal(len(columns)) * 10.0 ** rng.uniform(-2, 2)
    ties = sp.eye_array(N_REDUCED + 3 * BLOCKS) * 0.1
    rows = sp.csr_array(sp.vstack([design.tocsr(), ties]))
    return BlockSystem(rows, rng.standard_normal(rows.shape[0]), N_REDUCED)


SYSTEM = chained()
ROOT = np.linalg.qr(SYSTEM.design.toarray())[0]
BASIS = BasisResidualProjector.from_design(SYSTEM.design)
SPARSE = FactorResidualProjector.from_design(SYSTEM.design, FactorisedNormals(SYSTEM))
EXTRA = np.linalg.qr(BASIS.project(random_stream(3, "extra").standard_normal((len(ROOT), 2))))[0]
PAIRS = [(BASIS, ROOT), (SPARSE, ROOT)]
PAIRS += [(p.with_removed_columns(EXTRA), np.hstack([ROOT, EXTRA])) for p, _ in PAIRS]
NAMES = ["basis", "factor", "basis extended", "factor extended"]


@pytest.mark.parametrize(("projection", "root"), PAIRS, ids=NAMES)
def test_projection_and_leverage_are_those_of_the_hat_matrix(projection, root):
    vectors = random_stream(2, "vectors").standard_normal((len(root), 7)) * 10.0 ** np.arange(-3, 4)
    gap = projection.project(vectors) - (vectors - root @ (root.T @ vectors))
    assert np.abs(gap / np.linalg.norm(vectors, axis=0)).max() < 1e-10
    np.testing.assert_allclose(projection.leverage(), (root**2).sum(axis=1), atol=1e-9)


@pytest.mark.parametrize(("projection", "root"), PAIRS, ids=NAMES)
@pytest.mark.parametrize(
    "rows", [np.arange(100, 160), np.arange(100, 400), slice(None)], ids=["few rows", "many rows", "all rows"]
)
def test_products_of_residuals_are_those_of_projected_vectors(projection, root, rows):
    vectors = np.zeros((len(root), 5))
    vectors[rows] = random_stream(4, "columns").standard_normal(vectors[rows].shape)
    projected = vectors - root @ (root.T @ vectors)
    grams = projection.gram_matrices(vectors[rows], np.array([0, 2, 5]), rows)
    for gram, part in zip(grams, (slice(2), slice(2, 5)), strict=True):
        np.testing.assert_allclose(gram, projected[:, part].T @ projected[:, part], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("projection", "root"), PAIRS, ids=NAMES)
def test_blocks_of_few_rows_are_not_those_of_a_projector_that_removes_more(projection, root):
    rows, edges = np.arange(100, 160), np.array([0, 2])
    columns = random_stream(5, "columns").standard_normal((60, 2))
    (before,) = projection.gram_matrices(columns, edges, rows)
    np.testing.assert_array_equal(projection.gram_matrices(columns, edges, rows)[0], before)
    vector = np.zeros((len(root), 1))
    vector[rows[:5]] = 1.0
    removed = projection.project(vector)
    removed /= np.linalg.norm(removed)
    (after,) = projection.with_removed_columns(removed).gram_matrices(columns, edges, rows)
    inside = columns.T @ removed[rows]
    np.testing.assert_allclose(after, before - inside @ inside.T, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("projection", "root"), PAIRS, ids=NAMES)
@pytest.mark.parametrize(
    "groups",
    [
        [np.arange(3), np.arange(40, 47), np.array([5, 900, 2000])],
        [np.arange(0, 2600, 3)],
        [np.arange(2000), np.arange(2000, 2003)],
    ],
    ids=["few rows", "scattered", "more rows than unknowns"],
)
def test_spectra_give_back_the_blocks_of_the_hat_matrix(projection, root, groups):
    for rows, (values, vectors) in zip(groups, projection.hat_matrix_spectra(groups), strict=True):
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(len(values)), atol=1e-6)
        np.testing.assert_allclose((vectors * values) @ vectors.T, root[rows] @ root[rows].T, atol=1e-9)


def test_a_small_system_or_a_system_without_factor_gets_a_basis(monkeypatch):
    assert isinstance(make_residual_projector(SYSTEM, None), BasisResidualProjector)
    monkeypatch.setattr("ltsim.solve.projection.MAX_DESIGN_ENTRIES_FOR_BASIS", int(np.prod(SYSTEM.design.shape)))
    small = BlockSystem(SYSTEM.design, SYSTEM.whitened_residuals, SYSTEM.n_retained)
    assert isinstance(make_residual_projector(small, FactorisedNormals(small)), BasisResidualProjector)
    tall = BlockSystem(
        sp.csr_array(sp.vstack([SYSTEM.design] * 3)), np.tile(SYSTEM.whitened_residuals, 3), SYSTEM.n_retained
    )
    assert isinstance(make_residual_projector(tall, FactorisedNormals(tall)), FactorResidualProjector)
