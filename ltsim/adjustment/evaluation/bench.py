"""Evaluation of the bench test of a reflector (SMR): range error as a function of the incidence angle.

The reflector is rotated on a rotary table, an interferometer measures the length to the reflector,
and a probe measures the eccentricity of its sphere on the table. A rotation by alpha of a sphere with the eccentricity
c changes the length by -(c_x cos alpha - c_y sin alpha). This change is removed. An interferometer records only changes
of length, so that the range error is determined relative to its value at 0 deg. This value is part of the range offset
of a tracker.

Source: Sensors 2021, 21, 7479, sections 2.2 and 3.1.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from ltsim.core.arguments import check_argument_bounds
from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.core.limits import MAX_RESULT_LIST_ENTRIES
from ltsim.core.notation import with_sigma
from ltsim.core.results import Table, model_columns, number_columns
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.effects.smr_incidence import INCIDENCE_TABLE_ANGLES
from ltsim.recordings.files import read_text
from ltsim.recordings.result_file import Entry, Finite, ResultFile

MIN_BENCH_LENGTHS = 3
"""Smallest number of angles with lengths in a bench test: two coordinates of the mirrors' vertex, and the zero."""
MIN_PROBE_READINGS = 4
"""Smallest number of angles with probe readings in a bench test: two coordinates of the eccentricity, the zero, and one
more for the scatter."""

BENCH_TABLE = Table(
    "bench.csv",
    "readings of a reflector on the roundness table, for `bench`; empty where a length or the probe was not read",
    number_columns(
        ".4f",
        angle_deg="angle of the roundness table, 0 if the reflector faces the interferometer",
        length_um="length measured by the interferometer, from an arbitrary zero",
        probe_um="displacement of the sphere's surface at the probe, outward",
    ),
)


class EstimateEntry(Entry):
    """Estimated length and its standard deviation [um]."""

    value_um: Finite
    """Estimated value [um]."""
    sigma_um: Finite
    """Standard deviation [um] of the estimated value."""

    def __str__(self) -> str:
        return with_sigma(self.value_um, self.sigma_um, "um")


class BenchRow(Entry):
    """Range error of the reflector at one angle of incidence, relative to its error at the angle nearest 0 deg."""

    angle_deg: Finite
    """Angle of incidence [deg], equal to the angle of the rotary table that carries the reflector."""
    uncorrected_length_um: Finite
    """Measured length minus the length at the angle nearest 0 deg [um]; it contains the effect of the eccentricity of
    the sphere."""
    error_um: Finite
    """Range error of the reflector [um], measured minus true range, relative to that at the angle nearest 0 deg."""
    sigma_um: Finite
    """Standard deviation of the range error [um]."""


ANGLES_TABLE = Table(
    "angles.csv",
    "range error of the reflector as a function of the incidence angle",
    model_columns(
        BenchRow,
        angle_deg={"title": "incidence", "display_format": "+.1f"},
        uncorrected_length_um={"display_format": ".2f"},
        error_um={"title": "range error", "sigma_column": "sigma_um"},
    ),
)


class BenchFile(ResultFile):
    """Result of the bench test of a reflector, with the content of `bench.json`."""

    FILE: ClassVar[str] = "bench.json"
    format: Literal["ltsim-bench/1"] = "ltsim-bench/1"
    """Format and version of this file."""
    eccentricity_forward: EstimateEntry
    """Eccentricity of the sphere [um] when the table is at 0 deg, component towards the interferometer."""
    eccentricity_side: EstimateEntry
    """Eccentricity of the sphere [um] when the table is at 0 deg, horizontal component across the beam. Positive is the
    direction into which the table turns a point that is nearest to the interferometer."""
    run_out_um: Finite
    """Difference of the largest and the smallest probe reading [um]."""
    range_errors: tuple[BenchRow, ...] = Field(alias="table")
    """Range error at each angle of incidence."""
    vertex_axial: EstimateEntry
    """Offset [um] of the mirrors' vertex from the sphere's centre that would explain the range errors: component out of
    the open side of the reflector."""
    vertex_offset_lateral: EstimateEntry
    """Offset [um] of the mirrors' vertex from the sphere's centre that would explain the range errors: component across
    the axis of the reflector. Positive is the direction into which the table turns the open side of the reflector."""
    unexplained_rms_um: Finite
    """Rms range error [um] that no offset of the vertex explains, caused by the optics."""

    def _summary_lines(self) -> list[str]:
        worst_angle = max(self.range_errors, key=lambda row: abs(row.error_um))
        worst_error_text = with_sigma(worst_angle.error_um, worst_angle.sigma_um, "um")
        phrase = f"{self.eccentricity_forward} forward, {self.eccentricity_side} to the side"
        lines = [
            f"Bench: {len(self.range_errors)} angles, range error at most {worst_error_text} "
            f"at {worst_angle.angle_deg:+.1f} deg",
            f"eccentricity of the sphere on the table: {phrase}; run-out {self.run_out_um:.1f} um",
            f"offset of the mirrors' vertex from the sphere's centre (smr-centring): {self.vertex_axial} axial, "
            f"{self.vertex_offset_lateral} to the side",
            f"remaining error, which no offset explains (smr-incidence): {self.unexplained_rms_um:.2f} um rms",
        ]
        if [round(r.angle_deg, 3) for r in self.range_errors] == [
            round(float(a) / DEGREE, 3) for a in INCIDENCE_TABLE_ANGLES
        ]:
            values = ", ".join(f"{r.error_um:.2f}" for r in self.range_errors)
            lines.append(f"for a scenario: [smr] incidence_error = true, range_error_table_um = [{values}]")
        for key, form in (("angle_deg", "g"), ("error_um", ".2f"), ("sigma_um", ".2f")):
            values = ", ".join(format(getattr(row, key), form) for row in self.range_errors)
            lines.append(f"{'for a recording, in [[bench]]: ' if key == 'angle_deg' else ''}{key} = [{values}]")
        return lines

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {"angles": lambda: ANGLES_TABLE.with_rows(self.range_errors)}


@dataclass(frozen=True)
class ReflectorBenchReadings:
    """Readings of the bench test of a reflector, in SI units."""

    table_angles_of_lengths: Floats
    """Angle of the roundness table for each length [rad]."""
    lengths: Floats
    """Lengths by the interferometer [m], from an arbitrary zero."""
    table_angles_of_probe: Floats
    """Angle of the roundness table for each probe reading [rad]."""
    probe_direction: float
    """Angle [rad] from the interferometer to the probe as seen from the axis of the roundness table, counted against
    the rotation of the table."""
    probe_displacements: Floats
    """Displacement [m] of the sphere's surface at the probe, positive outward, for each probe reading."""
    length_sigma: float
    """Standard deviation of a length [m]."""


@dataclass(frozen=True)
class ReflectorBenchEstimates:
    """Estimates from the bench test of a reflector, in SI units, with range errors at k angles of incidence."""

    eccentricity: Floats
    """Eccentricity of the sphere when the table is at 0 deg, (2,) [m]: towards the interferometer, and across the beam,
    positive where the table turns the side that is nearest to the interferometer."""
    eccentricity_covariance: Floats
    """Covariance of the eccentricity, (2, 2) [m^2]."""
    run_out: float
    """Difference of the largest and the smallest probe reading [m]."""
    uncorrected_lengths: Floats
    """Length at each of k angles minus the length at the angle nearest 0 deg, (k,) [m]; it contains the effect of the
    eccentricity."""
    range_errors: Floats
    """Range error of the reflector at each of k angles, relative to its error at the angle nearest 0 deg, (k,) [m]."""
    range_error_sigmas: Floats
    """Standard deviation of each of the k `range_errors`, (k,) [m]."""


class VertexOffset(NamedTuple):
    """Offset [m] of the mirrors' vertex from the sphere's centre that explains the range errors of a bench test."""

    axial_offset: float
    """Component [m] of the offset along the axis of symmetry of the mirrors, positive out of the reflector."""
    side_offset: float
    """Component [m] of the offset perpendicular to the axis of symmetry of the mirrors, positive in the direction into
    which the roundness table turns the open side of the reflector."""
    axial_sigma: float
    """Standard deviation of `axial_offset` [m]."""
    side_sigma: float
    """Standard deviation of `side_offset` [m]."""
    unexplained_rms: float
    """Rms range error [m] that no offset of the vertex explains, caused by the optics."""


def eccentricity_design_matrix(angles: Floats) -> Floats:
    """Changes (k, 2) of the lengths at k `angles` (k,) [rad] per unit of the two components of the eccentricity.

    The components are those when the table is at 0 deg: towards the interferometer, and across the beam, positive where
    the table turns the side that is nearest to the interferometer.
    """
    return np.stack([-np.cos(angles), np.sin(angles)], axis=1)


def read_reflector_bench(path: Path, *, probe_direction: float, length_sigma: float) -> ReflectorBenchReadings:
    """Readings of a bench test from a CSV file with the columns ``angle_deg,length_um,probe_um``.

    `probe_direction` [rad] is the angle from the interferometer to the probe, counted against the rotation of the
    roundness table; `length_sigma` [m] is the standard deviation of a length. Raises RecordError for too few angles.
    """
    text = read_text(path)
    if text.count("\n") > MAX_RESULT_LIST_ENTRIES:  # the result has an entry for each row
        message = f"the file has more rows than the limit of {MAX_RESULT_LIST_ENTRIES}; average or remove rows"
        raise RecordError(message, file=path)
    angle, length, probe = BENCH_TABLE.parse_csv(text, path).float_array(*BENCH_TABLE.header).T
    lost = np.flatnonzero(~np.isfinite(angle))
    if len(lost):
        raise RecordError("an angle is missing, expected one per row", file=path, row=int(lost[0]) + 1)
    for what, column, fewest in (("length_um", length, MIN_BENCH_LENGTHS), ("probe_um", probe, MIN_PROBE_READINGS)):
        different = len(np.unique(np.round(angle[np.isfinite(column)] % 360.0, 3)))
        if different < fewest:
            raise RecordError(f"{what} has values at {different} angles, expected {fewest} or more", file=path)
    measured, probed = np.isfinite(length), np.isfinite(probe)
    return ReflectorBenchReadings(
        table_angles_of_lengths=angle[measured] * DEGREE,
        lengths=length[measured] * MICROMETRE,
        table_angles_of_probe=angle[probed] * DEGREE,
        probe_direction=probe_direction,
        probe_displacements=probe[probed] * MICROMETRE,
        length_sigma=length_sigma,
    )


def evaluate_reflector_bench(readings: ReflectorBenchReadings) -> ReflectorBenchEstimates:
    """Estimates from the readings of a bench test: eccentricity of the sphere, and range error at each angle.

    The first harmonic of the probe readings is the eccentricity, and the scatter of the readings about this harmonic
    gives its uncertainty. The effect of the eccentricity on the lengths is removed.
    """
    angles = readings.table_angles_of_probe - readings.probe_direction
    design = np.stack([np.ones_like(angles), np.cos(angles), -np.sin(angles)], axis=1)
    estimate = np.linalg.lstsq(design, readings.probe_displacements, rcond=None)[0]
    residual = readings.probe_displacements - design @ estimate
    variance = float(residual @ residual) / max(len(angles) - 3, 1)
    covariance = variance * np.linalg.inv(design.T @ design)[1:, 1:]
    middle_index = int(np.argmin(np.abs(readings.table_angles_of_lengths)))
    range_changes = readings.lengths - readings.lengths[middle_index]
    change = (
        eccentricity_design_matrix(readings.table_angles_of_lengths)
        - eccentricity_design_matrix(readings.table_angles_of_lengths)[middle_index]
    )
    length_variance = np.where(np.arange(len(change)) == middle_index, 0.0, 2.0 * readings.length_sigma**2)
    return ReflectorBenchEstimates(
        eccentricity=estimate[1:],
        eccentricity_covariance=covariance,
        run_out=float(np.ptp(readings.probe_displacements)),
        uncorrected_lengths=range_changes,
        range_errors=range_changes - change @ estimate[1:],
        range_error_sigmas=np.sqrt(length_variance + np.einsum("ai,ij,aj->a", change, covariance, change)),
    )


def fit_vertex_offset(angles: Floats, range_errors: Floats, sigma: float) -> VertexOffset:
    """Offset of the mirrors' vertex from the sphere's centre that best explains range errors (k,) [m] at k `angles`.

    `angles` (k,) [rad] are angles of incidence, `sigma` [m] is the standard deviation of one range error.
    """
    design = np.concatenate([np.ones((len(angles), 1)), eccentricity_design_matrix(angles)], axis=1)
    estimate = np.linalg.lstsq(design, range_errors, rcond=None)[0]
    spread = sigma * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    rms_residual = float(np.sqrt(np.mean((range_errors - design @ estimate) ** 2)))
    return VertexOffset(float(estimate[1]), float(estimate[2]), float(spread[1]), float(spread[2]), rms_residual)


def bench(source: str | Path, *, probe_direction: float = 90.0, length_sigma: float = 0.1) -> BenchFile:
    """Range error of a reflector as a function of the incidence angle, from its bench test on a roundness table.

    Parameters
    ----------
    source : str or Path
        CSV file with the columns ``angle_deg,length_um,probe_um``; a cell is empty if its value was not read.
    probe_direction : float, [deg]
        Angle [deg] from the interferometer to the probe, counted against the rotation of the table.
    length_sigma : float, [um]
        Standard deviation [um] of a length measured by the interferometer.

    Raises
    ------
    RecordError
        When the file is malformed, or contains too few angles.

    Examples
    --------
    >>> import ltsim as lt
    >>> from pathlib import Path
    >>> rows = [[str(a), str(0.1 * a) if abs(a) <= 30 else "", "0.0"] for a in range(-180, 180, 15)]
    >>> lines = [",".join(row) for row in [["angle_deg", "length_um", "probe_um"], *rows]]
    >>> _ = Path("reflector.csv").write_text(chr(10).join(lines))
    >>> [round(row.error_um, 1) for row in lt.bench("reflector.csv").range_errors]
    [-3.0, -1.5, 0.0, 1.5, 3.0]
    """
    check_argument_bounds(length_sigma=length_sigma, required_argument="length_sigma")
    options = {"probe_direction": probe_direction * DEGREE, "length_sigma": length_sigma * MICROMETRE}
    record = read_reflector_bench(Path(source), **options)
    result = evaluate_reflector_bench(record)
    vertex = fit_vertex_offset(
        record.table_angles_of_lengths, result.range_errors, float(result.range_error_sigmas.max())
    )
    eccentricity_sigmas = np.sqrt(np.diag(result.eccentricity_covariance))

    def estimate_entry(value: float, sigma: float) -> EstimateEntry:
        return EstimateEntry(value_um=value / MICROMETRE, sigma_um=sigma / MICROMETRE)

    columns = zip(
        result.uncorrected_lengths / MICROMETRE,
        result.range_errors / MICROMETRE,
        result.range_error_sigmas / MICROMETRE,
        strict=True,
    )
    return BenchFile(
        eccentricity_forward=estimate_entry(result.eccentricity[0], eccentricity_sigmas[0]),
        eccentricity_side=estimate_entry(result.eccentricity[1], eccentricity_sigmas[1]),
        run_out_um=result.run_out / MICROMETRE,
        table=tuple(
            BenchRow(angle_deg=angle, uncorrected_length_um=read, error_um=error, sigma_um=sigma)
            for angle, (read, error, sigma) in zip(record.table_angles_of_lengths / DEGREE, columns, strict=True)
        ),
        vertex_axial=estimate_entry(vertex.axial_offset, vertex.axial_sigma),
        vertex_offset_lateral=estimate_entry(vertex.side_offset, vertex.side_sigma),
        unexplained_rms_um=vertex.unexplained_rms / MICROMETRE,
    )
