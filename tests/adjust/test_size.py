"""Large networks: the same answer by the sparse way, everything known."""

import numpy as np
import pytest

from ltsim.adjust import adjust
from ltsim.solve import blocks

network = pytest.importorskip("benchmarks.adjust_size", reason="the benchmarks are not here").network


def test_a_ring_of_210_set_ups_with_all_statistics():
    recording = network("ring", 210, 370, 3340)
    assert (len(recording), len(recording.targets)) == (3340, 370)
    found = adjust(recording)
    sigma = np.sqrt(np.einsum("tii->ti", found.target_covariance))
    poses, redundancy = found.pose_covariance, found.redundancy
    assert found.solution.converged
    assert not found.gross.any()
    assert 0.001 < found.p_value < 0.999
    assert np.isfinite(sigma).all() and np.isfinite(poses).all()
    assert np.nansum(redundancy) == pytest.approx(found.dof, abs=1e-3)


def test_sparse_and_dense_elimination_give_the_same_adjustment(monkeypatch):
    recording = network("ring", 60, 106, 960)
    sparse = adjust(recording)
    monkeypatch.setattr(blocks, "DENSE", 10**9)
    dense = adjust(recording)
    np.testing.assert_allclose(sparse.state.points, dense.state.points, atol=1e-9)
    np.testing.assert_allclose(sparse.target_covariance, dense.target_covariance, rtol=1e-5, atol=1e-18)
    np.testing.assert_allclose(sparse.pose_covariance, dense.pose_covariance, rtol=1e-5, atol=1e-18)
    np.testing.assert_allclose(sparse.redundancy, dense.redundancy, atol=1e-7)
    sigma = found_sigma(dense)
    assert sigma.max() > 5 * sigma.min()  # The far side of the ring is known less well than the first station's.


def found_sigma(adjustment):
    """Largest standard deviation of each target."""
    return np.sqrt(np.linalg.eigvalsh(adjustment.target_covariance)[:, -1])
