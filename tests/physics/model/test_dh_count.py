"""How many of the paper's 78 Denavit-Hartenberg coefficients a network can tell apart.

The numbers stand below `DH_CHAIN` in `ltsim/geometry/kinematics.py`, derived by hand; here they are counted by rank: of
the 78 coefficients of eq. 1 to 8 (Sensors 2021, 21, 7479), 14 have no effect on a point, 11 repeat others even with
known stations and targets, 6 are absorbed by the pose of the station and 1, the range scale, by targets that are free.
The network is the reference workshop: two walls with 24 reflectors, a gauge of four near the corner, five stations.

Columns are brought to unit length, so a singular value below the gap is rounding (1e-15) and one above it is a
combination that is determined, however weakly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.geometry.rigid import cross_matrix, rotation_about_z
from ltsim.physics.model.construction import dh_construction
from ltsim.scene.sightings import Sightings

MESH, GAUGE, STATIONS = 24, 4, 5
GAP = 1e-8
LOWEST, ROUNDING = 1e-6, 1e-13

network = pytest.mark.parametrize(("faces", "seed"), [((1,), 0), ((1,), 1), ((1, 2), 0), ((1, 2), 1)])


def reference_network(faces: tuple[int, ...], seed: int) -> Sightings:
    """The reference workshop; heights of the heads, yaws and fine places are drawn."""
    rng = random_stream(seed, "reference-network")
    along = np.linspace(0.6, 5.6, 4)
    wall = np.array([[0.0, s, z] for z in (5.9, 2.0, 0.15) for s in along])
    mesh = np.concatenate([wall, wall[:, [1, 0, 2]]]) + rng.uniform(-0.1, 0.1, (MESH, 3))
    gauge = np.array([0.5, 0.5, 0.2]) + rng.uniform(-0.2, 0.2, (GAUGE, 3))
    floor = np.array([[3.0, 3.0], [4.6, 1.9], [1.9, 4.6], [5.3, 4.4], [3.9, 5.5]])
    grid = np.meshgrid(np.arange(STATIONS), np.arange(MESH + GAUGE), faces, indexing="ij")
    station, target, face = (axis.ravel() for axis in grid)
    count, targets = len(station), MESH + GAUGE
    return Sightings(
        station=station,
        target=target,
        instrument=np.zeros(count, dtype=np.int64),
        face=face,
        repeat=np.ones(count, dtype=np.int64),
        time=np.arange(count, dtype=np.float64),
        station_positions=np.column_stack([floor, rng.uniform(1.9, 2.1, STATIONS)]),
        station_rotations=np.stack([rotation_about_z(yaw) for yaw in rng.uniform(-np.pi, np.pi, STATIONS)]),
        target_points=np.concatenate([mesh, gauge]),
        nest_normals=np.full((targets, 3), np.nan),
        is_reaimed=np.ones(targets, dtype=bool),
        station_names=tuple(f"S{s}" for s in range(STATIONS)),
        target_names=tuple(f"T{t}" for t in range(targets)),
    )


@dataclass(frozen=True)
class Design:
    """Derivatives of all readings (as lengths) and of the gauge's lengths, one block a kind of unknown."""

    instrument: Floats
    pose: Floats
    target: Floats
    gauge_by_target: Floats

    def column(self, *names: str) -> Floats:
        return self.instrument[:, [dh_construction().parameter_index(name) for name in names]]

    @property
    def gauge(self) -> tuple[Floats, Floats]:
        """Instrument and nuisance columns with the six known lengths as further rows."""
        n_lengths = len(self.gauge_by_target)
        instrument = np.vstack([self.instrument, np.zeros((n_lengths, self.instrument.shape[1]))])
        lengths = np.hstack([np.zeros((n_lengths, self.pose.shape[1])), self.gauge_by_target])
        return instrument, np.vstack([np.hstack([self.pose, self.target]), lengths])


@cache
def design(faces: tuple[int, ...], seed: int) -> Design:
    sightings, made = reference_network(faces, seed), dh_construction()
    count, each = len(sightings), np.arange(len(sightings))
    _, by_value = made.reading_design(sightings.ideal_raw_readings, np.zeros(made.n_parameters))
    arm = sightings.target_points[sightings.target] - sightings.station_positions[sightings.station]
    pose = np.zeros((count, 3, STATIONS, 6))
    pose[each, :, sightings.station, :3] = -sightings.target_derivatives
    pose[each, :, sightings.station, 3:] = sightings.target_derivatives @ cross_matrix(arm)
    target = np.zeros((count, 3, MESH + GAUGE, 3))
    target[each, :, sightings.target] = sightings.target_derivatives
    across = sightings.range_ * np.cos(sightings.elevation)
    lengths = np.stack([np.ones(count), across, sightings.range_], axis=1)[:, :, None]
    instrument, pose, target = (
        (block.reshape(count, 3, -1) * lengths).reshape(3 * count, -1) for block in (by_value, pose, target)
    )
    pairs = list(combinations(range(MESH, MESH + GAUGE), 2))
    by_target = np.zeros((len(pairs), MESH + GAUGE, 3))
    for row, (i, j) in enumerate(pairs):
        ray = sightings.target_points[j] - sightings.target_points[i]
        by_target[row, j] = ray / np.linalg.norm(ray)
        by_target[row, i] = -by_target[row, j]
    return Design(instrument, pose, target, by_target.reshape(len(pairs), -1))


def scaled(columns: Floats) -> Floats:
    length = np.linalg.norm(columns, axis=0)
    return columns / np.where(length > 0, length, 1.0)


def gapped_rank(columns: Floats) -> int:
    """Rank of column-scaled derivatives; fails where the singular values leave it open."""
    spread = np.linalg.svd(columns, compute_uv=False)
    spread = spread / spread[0]
    rank = int(np.count_nonzero(spread > GAP))
    assert spread[rank - 1] > LOWEST, "a determined combination is too weak to be told from rounding"
    assert rank == len(spread) or spread[rank] < ROUNDING, "a lost combination is more than rounding"
    return rank


def without(columns: Floats, nuisance: Floats) -> Floats:
    """What is left of column-scaled derivatives once the nuisance columns have taken what they can."""
    range_basis, spread, _ = np.linalg.svd(scaled(nuisance), full_matrices=False)
    span = range_basis[:, spread > GAP * spread[0]]
    rest = scaled(columns)
    for _ in range(2):
        rest = rest - span @ (span.T @ rest)
    return rest


def remaining_fraction(columns: Floats, nuisance: Floats) -> float:
    """Largest length of a unit column outside the span of others: 0 means they reproduce it."""
    return float(np.linalg.norm(without(columns, nuisance), axis=0).max())


@network
def test_the_count(faces: tuple[int, ...], seed: int) -> None:
    d = design(faces, seed)
    lengths = np.linalg.norm(d.instrument, axis=0)
    effective = int(np.count_nonzero(lengths > ROUNDING))
    rank_with_references = gapped_rank(scaled(d.instrument))
    rank_with_targets = gapped_rank(without(d.instrument, d.pose))
    free_targets = gapped_rank(without(d.instrument, np.hstack([d.pose, d.target])))
    with_gauge = gapped_rank(without(*d.gauge))
    assert (dh_construction().n_parameters, effective) == (78, 78 - 14)
    assert (rank_with_references, rank_with_targets, free_targets, with_gauge) == (53, 47, 46, 47)


@network
def test_the_network_itself_lacks_only_its_datum(faces: tuple[int, ...], seed: int) -> None:
    d = design(faces, seed)
    assert gapped_rank(scaled(d.pose)) == 6 * STATIONS
    assert gapped_rank(scaled(np.hstack([d.pose, d.target]))) == 6 * STATIONS + 3 * (MESH + GAUGE) - 6


def test_the_fourteen_without_effect() -> None:
    d = design((1, 2), 0)
    silent = {
        n
        for n, c in zip(dh_construction().parameter_names, d.instrument.T, strict=True)
        if np.linalg.norm(c) < ROUNDING
    }
    beam = {f"J2.eZ_{suffix}" for suffix in ("c", "sin", "cos", "sin2", "cos2")}
    assert silent == beam | {f"T.e{axis}_{k}" for axis in "XYZ" for k in range(3)}


@pytest.mark.parametrize(
    ("lost", "others"),
    [
        ("J1.dZ_c", ("T.dX_0",)),
        ("J2.dY_c", ("T.dX_0",)),
        ("J2.dX_c", ("T.dY_0",)),
        ("J2.dZ_c", ("T.dZ_0",)),
        ("J2.eX_c", ("T.dX_1",)),
        ("J1.eZ_c", ("T.dY_1",)),
        ("J2.eY_c", ("T.dY_1",)),
        ("J1.eX_c", ("J2.eX_sin",)),
        ("J1.eY_c", ("J2.eX_cos",)),
        ("J1.dX_c", ("J2.dZ_cos", "J2.dX_sin")),
        ("J1.dY_c", ("J2.dZ_sin", "J2.dX_cos")),
    ],
)
def test_the_eleven_redundant_ones(lost: str, others: tuple[str, ...]) -> None:
    d = design((1, 2), 0)
    assert remaining_fraction(d.column(lost), d.column(*others)) < ROUNDING


@network
def test_the_six_that_poses_absorb(faces: tuple[int, ...], seed: int) -> None:
    """Height, yaw, two for the place on the floor, two for the tilt: names as in `kinematics.py`."""
    d = design(faces, seed)
    assert remaining_fraction(d.column("J1.dY_c", "J1.eY_c"), d.pose) < ROUNDING
    for kind in "de":
        first = d.column(*(f"J1.{kind}{axis}_{wave}" for axis in "XZ" for wave in ("sin", "cos")))
        assert gapped_rank(scaled(first)) == 4
        assert gapped_rank(without(first, d.pose)) == 2


@network
def test_the_parameter_that_free_targets_absorb_is_the_range_scale(faces: tuple[int, ...], seed: int) -> None:
    d = design(faces, seed)
    scale = d.column("T.dZ_1")
    assert remaining_fraction(scale, d.pose) > 0.01
    assert remaining_fraction(scale, np.hstack([d.pose, d.target])) < ROUNDING
