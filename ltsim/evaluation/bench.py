"""The reflector's bench test evaluated: the eccentricity taken off the lengths gives the error against incidence.

The geometry is that of `simulate.bench`: turned by alpha, a sphere off the table's axis by c changes the length by
-(c_x cos alpha - c_y sin alpha), and a probe tells c. An interferometer records changes only: the table is found less
its value at 0 deg, a constant that a tracker's range offset takes up.

Source: Sensors 2021, 21, 7479, sections 2.2 and 3.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import RecordError
from ltsim.evaluation.schema import BENCH, BenchFile, BenchRow, EstimateEntry
from ltsim.units import DEGREE, MICROMETRE

FEWEST_LENGTHS, FEWEST_PROBED = 3, 4
"""A vertex has two coordinates beside the zero; an eccentricity too, and one reading more shows the scatter."""


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


def along_beam(angles: Floats) -> Floats:
    """(a, 2): change of the length per unit of a point off the table's axis, when the table is turned."""
    return np.stack([-np.cos(angles), np.sin(angles)], axis=1)


def read_bench(path: Path, *, probe_direction: float, length_sigma: float) -> BenchRecord:
    """A bench recording: a table ``angle_deg,length_um,probe_um``, cells empty where one of them was not read.

    Parameters
    ----------
    path : Path
    probe_direction : float, [rad]
        Where the probe stands, from the interferometer, against the way in which the table turns.
    length_sigma : float, [m]
        One standard deviation of the interferometer.

    Raises
    ------
    RecordError
        When the file is malformed or holds too little; one sentence.
    """
    columns = BENCH.read(path)[1]
    angle, length, probe = (columns[name] for name in BENCH.header)
    lost = np.flatnonzero(~np.isfinite(angle))
    if len(lost):
        raise RecordError("an angle is missing, expected one a row", file=path, row=int(lost[0]) + 1)
    for what, column, fewest in (("length_um", length, FEWEST_LENGTHS), ("probe_um", probe, FEWEST_PROBED)):
        different = len(np.unique(np.round(angle[np.isfinite(column)] % 360.0, 3)))
        if different < fewest:
            raise RecordError(f"holds {what} at {different} angles, expected {fewest} or more", file=path)
    seen, probed = np.isfinite(length), np.isfinite(probe)
    return BenchRecord(
        angles=angle[seen] * DEGREE,
        lengths=length[seen] * MICROMETRE,
        probe_angles=angle[probed] * DEGREE,
        probe_direction=probe_direction,
        displacements=probe[probed] * MICROMETRE,
        length_sigma=length_sigma,
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
    change = along_beam(record.angles) - along_beam(record.angles)[middle]
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
    design = np.concatenate([np.ones((len(angles), 1)), along_beam(angles)], axis=1)
    found = np.linalg.lstsq(design, table, rcond=None)[0]
    spread = sigma * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    remainder = float(np.sqrt(np.mean((table - design @ found) ** 2)))
    return Vertex(float(found[1]), float(found[2]), float(spread[1]), float(spread[2]), remainder)


def bench_file(record: BenchRecord, found: BenchResult) -> BenchFile:
    """The outcome for a program, in the units that people read."""
    vertex = as_vertex(record.angles, found.table, float(found.sigma.max()))
    off = np.sqrt(np.diag(found.eccentricity_covariance))

    def entry(value: float, sigma: float) -> EstimateEntry:
        return EstimateEntry(value_um=value / MICROMETRE, sigma_um=sigma / MICROMETRE)

    return BenchFile(
        eccentricity_forward=entry(found.eccentricity[0], off[0]),
        eccentricity_side=entry(found.eccentricity[1], off[1]),
        run_out_um=found.run_out / MICROMETRE,
        table=tuple(
            BenchRow(angle_deg=a / DEGREE, as_read_um=u / MICROMETRE, error_um=t / MICROMETRE, sigma_um=s / MICROMETRE)
            for a, u, t, s in zip(record.angles, found.uncorrected, found.table, found.sigma, strict=True)
        ),
        vertex_axial=entry(vertex.axial, vertex.axial_sigma),
        vertex_side=entry(vertex.side, vertex.side_sigma),
        remainder_um=vertex.remainder / MICROMETRE,
    )
