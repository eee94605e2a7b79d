"""Large networks: the same answer by the sparse way, everything known."""

import tracemalloc
import warnings

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.frame import StationTargetPairs
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.model.construction import ideal_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Setup
from ltsim.solve import design

network = pytest.importorskip("benchmarks.adjust_size", reason="the benchmarks are not here").network


def test_a_ring_of_210_set_ups_with_all_statistics():
    recording = network("ring", 210, 370, 3340)
    assert (len(recording), len(recording.targets)) == (3340, 370)
    adjustment = adjust(recording)
    sigma = np.sqrt(np.einsum("tii->ti", adjustment.target_covariances))
    poses, redundancy = adjustment.pose_covariance, adjustment.redundancy
    assert adjustment.solution.has_converged
    assert not adjustment.is_gross_pointing.any()
    assert 0.001 < adjustment.p_value < 0.999
    assert np.isfinite(sigma).all() and np.isfinite(poses).all()
    assert np.nansum(redundancy) == pytest.approx(adjustment.dof, abs=1e-3)


def test_sparse_and_dense_elimination_give_the_same_adjustment(monkeypatch):
    recording = network("ring", 60, 106, 960)
    sparse = adjust(recording)
    monkeypatch.setattr(design, "MAX_DENSE_ENTRIES", 10**9)
    dense = adjust(recording)
    np.testing.assert_allclose(sparse.state.target_points, dense.state.target_points, atol=1e-9)
    np.testing.assert_allclose(sparse.target_covariances, dense.target_covariances, rtol=1e-5, atol=1e-18)
    np.testing.assert_allclose(sparse.pose_covariance, dense.pose_covariance, rtol=1e-5, atol=1e-18)
    np.testing.assert_allclose(sparse.redundancy, dense.redundancy, atol=1e-7)
    sigma = estimated_sigma(dense)
    assert sigma.max() > 5 * sigma.min()  # The far side of the ring is known less well than the first station's.


def estimated_sigma(adjustment):
    """Largest standard deviation of each target."""
    return np.sqrt(np.linalg.eigvalsh(adjustment.target_covariances)[:, -1])


def tunnel(stations, each=50):
    """Set-ups in a row, each of which shares half of its targets with the next."""
    rng, half = random_stream(4, "tunnel", stations), each // 2
    count = half * (stations + 1)
    position = np.stack([6.3 * np.arange(stations), np.zeros(stations), rng.normal(1.6, 0.1, stations)], axis=1)
    along = 6.3 * (np.arange(count) // half) - 3.15 + rng.uniform(-2, 2, count)
    side = rng.choice([-2.0, 2.0], count) + rng.normal(0, 0.3, count)
    points = np.stack([along, side, rng.uniform(0.2, 3.0, count)], axis=1)
    rotation = np.stack([rotation_about_z(float(a)) for a in rng.uniform(-3, 3, stations)])
    ones = np.ones(stations * each, dtype=np.int64)
    recording = Recording(
        setup=Setup(),
        stations=tuple(f"S{i}" for i in range(stations)),
        targets=tuple(f"T{i}" for i in range(count)),
        station=np.repeat(np.arange(stations), each),
        target=(half * np.arange(stations)[:, None] + np.arange(each)).ravel(),
        face=ones,
        repeat=ones,
        time=np.arange(len(ones), dtype=np.float64),
        readings=np.zeros((len(ones), 3)),
    )
    exact = MeasurementModel(recording, ideal_construction()).predict(
        NetworkState(position, rotation, points, np.zeros((1, 0)))
    )
    recording = recording.with_readings(exact)
    return recording.with_readings(exact + recording.reading_sigmas() * rng.standard_normal(exact.shape))


@pytest.mark.long
def test_memory_follows_the_pointings_and_not_the_square_of_the_set_ups():
    """400 set-ups: one table of all stations and targets would be 240 MB, a few of them a gigabyte."""
    recording = tunnel(400)
    tracemalloc.start()
    adjustment = adjust(recording)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert adjustment.solution.has_converged
    assert not adjustment.is_gross_pointing.any()
    assert 0.001 < adjustment.p_value < 0.999
    assert np.isfinite(adjustment.target_covariances).all()
    assert most < 200e6


def test_the_list_of_pairs_is_what_a_table_would_be():
    recording = tunnel(5, 20)
    twice = recording.replace(
        **{n: np.tile(getattr(recording, n), 3) for n in ("station", "target", "face", "repeat", "time")},
        readings=np.concatenate([recording.readings + s for s in (0.0, 1e-3, 5e-3)]),
    )
    pairs = StationTargetPairs.from_recording(twice)
    points = from_polar(twice.readings)
    for s in range(5):
        pair_slice = pairs.pair_slice_of_station(s)
        for target, point in zip(pairs.target_indices[pair_slice], pairs.local_points[pair_slice], strict=True):
            rows = (twice.station == s) & (twice.target == target)
            np.testing.assert_array_equal(point, np.median(points[rows], axis=0))
    values = pairs.local_points.copy()
    values[pairs.pair_slice_of_station(2)] = np.nan
    table = np.full((5, len(recording.targets), 3), np.nan)
    table[pairs.station_indices, pairs.target_indices] = values
    which = np.array([3, 11, 25, 30, 59])
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = np.nanmedian(table[:, which], axis=0)
    np.testing.assert_array_equal(pairs.medians_by_target(values, which), expected)
