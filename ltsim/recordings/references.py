"""Reference values of a recording: lengths at their temperature of use, and vectors between survey marks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.core.units import MILLIMETRE, PPM
from ltsim.geometry.expansion import ThermalExpansion
from ltsim.recordings.files import SourceLocation, safe_excerpt
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import GaugeDistance, LengthGauge, ReferenceDifference, Target, symmetric_matrix

EXPANSION_ERROR_PREFIX = "expansion of "
"""Beginning of the name of the error of an expansion coefficient, which lengths of one material share."""
SCALE_ERROR_NAME = "scale of all lengths"
"""Name of the scale error that all reference lengths share."""
MIN_UNKNOWN_SCALE_SIGMA_PPM = 1000.0
"""Limit of the declared standard deviation [ppm] of the common scale of all reference lengths. Above it, the lengths
determine their ratios only, not the scale. It corresponds to a change of temperature of 40 K for aluminium.

It corresponds to a change of temperature of 40 K for aluminium."""


@dataclass(frozen=True)
class ReferenceLengths:
    """Reference lengths between targets (g lengths) with their independent errors and the errors that they share."""

    first_targets: Ints
    """Index (g,) of the target at the first end of each of the g lengths."""
    second_targets: Ints
    """Index (g,) of the target at the second end of each of the g lengths."""
    expansion_factors: Floats
    """Length at the temperature of use, divided by the length at calibration, for each of g lengths, (g,)."""
    lengths: Floats
    """Reference lengths (g,) [m] at the temperature of use."""
    certificate_sigmas: Floats
    """Standard deviation (g,) [m] of the independent error of each of g lengths, as in its calibration certificate."""
    shared_error_shifts: dict[str, Floats]
    """Change (g,) [m] of the g lengths by one standard deviation of each error that several lengths share, by name of
    the error. Such errors are those of an expansion coefficient, of a thermometer, and of the scale."""

    @classmethod
    def from_recording(cls, recording: Recording, file: object = "setup.toml") -> Self:
        """Reference lengths that the set-up of the recording declares; `file` is named in errors.

        Raises RecordError if a material is not declared, or if the column with the temperature of a length is empty.
        """
        index = {name: i for i, name in enumerate(recording.targets)}
        indexed_lengths = [(i, d) for i, d in enumerate(recording.gauge.distance) if d.from_ in index and d.to in index]
        ratios_and_changes = [
            _expansion_factor_and_changes(recording, d, {"file": file, "column": f"gauge.distance {i + 1}"})
            for i, d in indexed_lengths
        ]
        certified = np.array([d.length_mm * MILLIMETRE for _, d in indexed_lengths])
        expansion_factors = np.array([growth for growth, _ in ratios_and_changes])
        scale_change = (
            {SCALE_ERROR_NAME: recording.gauge.sigma_scale_ppm * PPM} if recording.gauge.sigma_scale_ppm else {}
        )
        changes_by_error = [change | scale_change for _, change in ratios_and_changes]
        shared = {
            name: certified * np.array([change.get(name, 0.0) for change in changes_by_error])
            for name in dict.fromkeys(name for change in changes_by_error for name in change)
        }
        return cls(
            np.array([index[d.from_] for _, d in indexed_lengths], dtype=np.int64),
            np.array([index[d.to] for _, d in indexed_lengths], dtype=np.int64),
            expansion_factors,
            certified * expansion_factors,
            np.array([d.sigma_mm * MILLIMETRE for _, d in indexed_lengths]),
            shared,
        )

    @property
    def is_scale_determined(self) -> bool:
        """True if the lengths determine the scale of the network, not only the ratios of distances."""
        return SCALE_ERROR_NAME not in self.shared_error_shifts or bool(
            np.any(self.shared_error_shifts[SCALE_ERROR_NAME] < 0.99 * MIN_UNKNOWN_SCALE_SIGMA_PPM * PPM * self.lengths)
        )

    @property
    def total_sigmas(self) -> Floats:
        """Total standard deviation (g,) [m] of each of g lengths: independent and shared errors together."""
        return np.sqrt(self.certificate_sigmas**2 + sum(change**2 for change in self.shared_error_shifts.values()))


def _expansion_factor_and_changes(
    recording: Recording, gauge_distance: GaugeDistance, location: dict[str, Any]
) -> tuple[float, dict[str, float]]:
    """Ratio of a length at the temperature of use to the length at calibration, and changes of this ratio by errors.

    The changes are due to one standard deviation of an expansion coefficient or a thermometer, by name of this error,
    which several lengths may share. `location` (file and column) is named in errors.
    """
    if gauge_distance.measured_in_place:
        return 1.0, {}
    gauge = recording.gauge
    materials = gauge.materials or {}
    if gauge_distance.material is not None and gauge_distance.material not in materials:
        expected = (
            f"one of {', '.join(materials)}" if materials else f"a table [gauge.materials.{gauge_distance.material}]"
        )
        raise RecordError(
            f"the material '{safe_excerpt(gauge_distance.material)}' is not declared, expected {expected}", **location
        )
    material = gauge if gauge_distance.material is None else materials[gauge_distance.material]
    declared = gauge.measured_at_c if gauge_distance.measured_at_c is None else gauge_distance.measured_at_c
    temperature_c = (
        _mean_temperature_of_column(recording, declared, gauge_distance, location)
        if isinstance(declared, str)
        else declared
    )
    sigma = (
        gauge.sigma_temperature_k if gauge_distance.sigma_temperature_k is None else gauge_distance.sigma_temperature_k
    )
    length_name = "" if gauge_distance.measured_at_c is None else f"{gauge_distance.from_}-{gauge_distance.to}"
    thermometer = f"temperature of {declared if isinstance(declared, str) else length_name or 'the gauge'}"
    expansion = ThermalExpansion.from_temperature_difference(
        material.expansion_per_k, temperature_c - gauge.calibrated_at_c, material.sigma_expansion_per_k, sigma
    )
    material_name = gauge_distance.material or "the gauge"
    change_by_error = {
        f"{EXPANSION_ERROR_PREFIX}{material_name}": expansion.ratio_change_per_coefficient_sigma,
        thermometer: expansion.ratio_change_per_temperature_sigma,
    }
    return expansion.length_ratio, {name: change for name, change in change_by_error.items() if change}


def _mean_temperature_of_column(
    recording: Recording, name: str, gauge: GaugeDistance, location: dict[str, Any]
) -> float:
    """Mean temperature [deg C] in the column `name` over the pointings to both ends of the reference length `gauge`.

    Raises RecordError, which names `location`, if the recording lacks the column or has no value in these pointings.
    """
    if name not in recording.covariates:
        columns = ", ".join(recording.covariates) or "none"
        message = f"measured_at_c is '{safe_excerpt(name)}', expected a column of numbers ({columns}) or a temperature"
        raise RecordError(message, **location)
    end_targets = [recording.targets.index(target) for target in (gauge.from_, gauge.to)]
    column_values = recording.covariates[name][np.isin(recording.target, end_targets)]
    if not np.isfinite(column_values).any():
        message = f"the column {name} contains no temperature in the pointings to {gauge.from_} and {gauge.to}"
        raise RecordError(message, **location)
    return float(np.nanmean(column_values))


MAX_EXACT_MARK_SIGMA_RATIO = 0.1
"""Limit of the standard deviation of a mark's coordinates, divided by that of a known vector between two marks. Below
it, the vector treats the unmeasured mark as exact."""


def mark_indices(recording: Recording) -> dict[str, int]:
    """Index of each survey mark by its name, for a recording with T targets and S set-ups.

    A measured mark has the index of its target (0 to T - 1). A mark under a set-up has T plus the index of the first
    set-up over it. Any other mark with known coordinates has the index T + S.
    """
    n_targets, unmeasured_index = len(recording.targets), len(recording.targets) + len(recording.stations)
    index_by_mark = {
        name: unmeasured_index for name, target in recording.setup.targets.items() if target.known_mm is not None
    }
    marks_of_stations = [recording.station_setup(name).over for name in recording.stations]
    index_by_mark |= {mark: n_targets + s for s, mark in reversed([*enumerate(marks_of_stations)]) if mark}
    return index_by_mark | {name: i for i, name in enumerate(recording.targets)}


def check_reference_difference_ends(recording: Recording, file: object) -> None:
    """Check that each end of each known vector was measured, or has coordinates that count as exact.

    Raises RecordError, which names `file`.
    """
    index_by_mark, unmeasured_index = mark_indices(recording), len(recording.targets) + len(recording.stations)
    for difference in recording.setup.differences:
        for name in (difference.from_, difference.to):
            if index_by_mark.get(name, unmeasured_index) == unmeasured_index and not _is_exact_mark(
                recording.target_setup(name), difference
            ):
                criterion = f"known along {difference.known_axes}, at least ten times better than this difference"
                message = (
                    f"'{safe_excerpt(name)}' was never measured, expected a measured mark, or one that is {criterion}"
                )
                raise SourceLocation(file, column=f"difference {difference.label}").error(message)


def _is_exact_mark(target: Target, difference: ReferenceDifference) -> bool:
    """True if known coordinates of a mark are at least ten times more precise than the known vector `difference`."""
    axes = ["xyz".index(axis) for axis in difference.known_axes]
    is_control = target.known_mm is not None and {*difference.known_axes} <= {*target.known_axes}
    return is_control and bool(
        _coordinate_sigmas(target)[axes].max()
        <= MAX_EXACT_MARK_SIGMA_RATIO * _coordinate_sigmas(difference)[axes].min()
    )


def _coordinate_sigmas(reference: Target | ReferenceDifference) -> Floats:
    """Standard deviations (3,) [mm] of the known coordinates of a target, or of a known vector between two marks."""
    if reference.known_covariance_mm2 is None:
        return np.full(3, reference.known_sigma_mm)
    return np.sqrt(np.diag(symmetric_matrix(reference.known_covariance_mm2)))


def common_expansion_per_k(gauge: LengthGauge) -> float:
    """Coefficient of thermal expansion [1/K] of all reference lengths; 0 if it is not declared, or if they differ."""
    materials = gauge.materials or {}
    coefficients = {
        (gauge if length.material is None else materials[length.material]).expansion_per_k
        for length in gauge.distance
        if not length.measured_in_place
    }
    return coefficients.pop() if len(coefficients) == 1 else 0.0
