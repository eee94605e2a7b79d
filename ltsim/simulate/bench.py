"""The reflector's bench test: a roundness table, a probe and an interferometer give the error against incidence.

The reflector stands on the table and is turned through +-30 deg; an interferometer looks along -x and records the
length, a probe the displacement of the sphere's surface (Sensors 2021, 21, 7479, sections 2.2 and 3.1, fig. 2, 8, 9).
Turned by alpha, a sphere off the table's axis by c changes the length by -(c_x cos alpha - c_y sin alpha). That is no
error of the reflector, but it looks like one: 26 um to the side are 13 um at 30 deg. The probe tells it: the first
harmonic of its record is the eccentricity, higher ones are the roundness of the sphere.

An interferometer records changes only: the table is found less its value at 0 deg, a constant that a tracker's range
offset takes up.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.smr_incidence import PAPER_TABLE, TABLE_ANGLES
from ltsim.errors import SetupError
from ltsim.randomness import stream
from ltsim.units import DEGREE, MICROMETRE

FULL_TURN = np.arange(0.0, 360.0, 7.5) * DEGREE
MIDDLE = int(np.argmin(np.abs(TABLE_ANGLES)))
LOBES = (2, 3, 5)
"""Lobes of the sphere's out-of-roundness."""


@dataclass(frozen=True)
class BenchTest:
    """What is true on the bench; SI."""

    table: Floats = field(default_factory=lambda: np.array(PAPER_TABLE))
    """(a,) [m]: range error of the reflector (reading - truth, of the sphere's centre) at `angles`."""
    angles: Floats = field(default_factory=lambda: TABLE_ANGLES.copy())
    """(a,) [rad]."""
    eccentricity: Floats = field(default_factory=lambda: np.zeros(2))
    """(2,) [m]: sphere's centre off the table's axis at 0 deg: towards the interferometer, and to the side."""
    roundness: float = 0.3 * MICROMETRE
    """[m]: amplitude of each of the `LOBES` of the sphere."""
    probe_angles: Floats = field(default_factory=lambda: FULL_TURN.copy())
    """(k,) [rad]: turns of the table at which the probe is read."""
    probe_direction: float = 90.0 * DEGREE
    """[rad]: where the probe stands, from the interferometer."""
    probe_sigma: float = 0.1 * MICROMETRE
    length_sigma: float = 0.1 * MICROMETRE
    """[m]: one standard deviation of the probe with the table's run-out, and of the interferometer."""

    def __post_init__(self) -> None:
        if len(self.table) != len(self.angles):
            raise SetupError(f"the table holds {len(self.table)} errors for {len(self.angles)} angles; give one each")
        if len(self.probe_angles) < 3:
            raise SetupError(f"the probe is read at {len(self.probe_angles)} angles; the eccentricity needs 3 or more")


@dataclass(frozen=True)
class BenchRecord:
    """What is written down on the bench: angles [rad], lengths (a,) [m], displacements of the surface (k,) [m]."""

    angles: Floats
    lengths: Floats
    probe_angles: Floats
    probe_direction: float
    displacements: Floats
    length_sigma: float


@dataclass(frozen=True)
class BenchResult:
    """What the record says; SI."""

    eccentricity: Floats
    """(2,) [m]."""
    eccentricity_covariance: Floats
    """(2, 2) [m^2]."""
    run_out: float
    """[m]: largest less smallest displacement that the probe saw."""
    uncorrected: Floats
    """(a,) [m]: lengths less that nearest 0 deg: the error with the eccentricity still in it."""
    table: Floats
    """(a,) [m]: the reflector's own error, less that nearest 0 deg."""
    sigma: Floats
    """(a,) [m]: standard deviation of `table`."""


@dataclass(frozen=True)
class Vertex:
    """A table explained by the vertex of the mirrors off the sphere's centre, and what is left."""

    axial: float
    side: float
    """[m]: vertex off the centre, out of the open face and to the side."""
    axial_sigma: float
    side_sigma: float
    """[m] each."""
    remainder: float
    """[m]: rms of what no offset explains: optics."""


def _along_beam(angles: Floats) -> Floats:
    """(a, 2): change of the length per unit of a point off the table's axis, when the table is turned."""
    return np.stack([-np.cos(angles), np.sin(angles)], axis=1)


def vertex_table(axial: float, side: float, angles: Floats = TABLE_ANGLES) -> Floats:
    """Range error (a,) [m] at `angles` of a vertex off the sphere's centre by `axial` and `side` [m]."""
    return _along_beam(angles) @ np.array([axial, side])


def measure_bench(bench: BenchTest, seed: int, *key: str | int) -> BenchRecord:
    """Do the test once: lengths at the table's angles, displacements of the surface at the probe's."""

    def noise(what: str, count: int) -> Floats:
        return stream(seed, *key, "bench", what).standard_normal(count)

    lengths = bench.table + _along_beam(bench.angles) @ bench.eccentricity
    turned = bench.probe_angles - bench.probe_direction
    surface = np.stack([np.cos(turned), -np.sin(turned)], axis=1) @ bench.eccentricity
    phase = 2 * np.pi * stream(seed, *key, "bench", "lobes").random(len(LOBES))
    for lobes, start in zip(LOBES, phase, strict=True):
        surface = surface + bench.roundness * np.cos(lobes * turned + start)
    return BenchRecord(
        angles=bench.angles,
        lengths=lengths + bench.length_sigma * noise("length", len(lengths)),
        probe_angles=bench.probe_angles,
        probe_direction=bench.probe_direction,
        displacements=surface + bench.probe_sigma * noise("probe", len(surface)),
        length_sigma=bench.length_sigma,
    )


def evaluate_bench(record: BenchRecord) -> BenchResult:
    """Take the eccentricity, as the probe tells it, off the lengths.

    The scatter of the probe about its first harmonic, roundness included, gives the eccentricity's uncertainty.
    """
    turned = record.probe_angles - record.probe_direction
    design = np.stack([np.ones_like(turned), np.cos(turned), -np.sin(turned)], axis=1)
    found = np.linalg.lstsq(design, record.displacements, rcond=None)[0]
    left = record.displacements - design @ found
    variance = float(left @ left) / max(len(turned) - 3, 1)
    covariance = variance * np.linalg.inv(design.T @ design)[1:, 1:]
    middle = int(np.argmin(np.abs(record.angles)))
    uncorrected = record.lengths - record.lengths[middle]
    change = _along_beam(record.angles) - _along_beam(record.angles)[middle]
    own = np.where(np.arange(len(change)) == middle, 0.0, 2.0 * record.length_sigma**2)
    return BenchResult(
        eccentricity=found[1:],
        eccentricity_covariance=covariance,
        run_out=float(np.ptp(record.displacements)),
        uncorrected=uncorrected,
        table=uncorrected - change @ found[1:],
        sigma=np.sqrt(own + np.einsum("ai,ij,aj->a", change, covariance, change)),
    )


def as_vertex(angles: Floats, table: Floats, sigma: float) -> Vertex:
    """Explain a table (a,) [m] at `angles` by an offset of the vertex; `sigma` [m] of one entry."""
    design = np.concatenate([np.ones((len(angles), 1)), _along_beam(angles)], axis=1)
    found = np.linalg.lstsq(design, table, rcond=None)[0]
    spread = sigma * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    remainder = float(np.sqrt(np.mean((table - design @ found) ** 2)))
    return Vertex(float(found[1]), float(found[2]), float(spread[1]), float(spread[2]), remainder)
