"""Reference values of a recording: lengths at their temperature of use, and differences between marks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.core.units import MILLIMETRE, PPM
from ltsim.geometry.expansion import ThermalExpansion
from ltsim.recordings.files import SourceLocation, quoted_text
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import GaugeDistance, ReferenceDifference, Target, symmetric_matrix

EXPANSION_ERROR_PREFIX = "expansion of "
"""Prefix of the name of the expansion error that lengths of one material share."""
SCALE_ERROR_NAME = "scale of all lengths"
MIN_UNKNOWN_SCALE_PPM = 1000.0
"""Standard deviation [ppm] of the common scale of lengths from which the lengths determine ratios only; it corresponds
to 40 K for aluminium."""


@dataclass(frozen=True)
class ReferenceLengths:
    """Reference lengths (g) between targets of a recording, with independent errors and errors that several share."""

    first_targets: Ints
    """Index of the target at the first end of each length, (g,)."""
    second_targets: Ints
    """Index of the target at the second end of each length, (g,)."""
    growth_factors: Floats
    """Growth factor from calibration to use, (g,)."""
    lengths: Floats
    """Length at use, (g,) [m]."""
    certificate_sigmas: Floats
    """Standard deviation of the independent error of each length, (g,) [m]."""
    shared_error_changes: dict[str, Floats]
    """Change of the lengths by one standard deviation of each shared error (expansion coefficient, thermometer), (g,)
    [m] by name.
    """

    @classmethod
    def from_recording(cls, recording: Recording, file: object = "setup.toml") -> Self:
        """Lengths whose targets the recording holds; `file` is named in errors.

        Raises RecordError when a material is not declared, or a column has no temperature of a length.
        """
        index = {name: i for i, name in enumerate(recording.targets)}
        rows = [(i, d) for i, d in enumerate(recording.gauge.distance) if d.from_ in index and d.to in index]
        grown = [
            _growth_and_changes(recording, d, {"file": file, "column": f"gauge.distance {i + 1}"}) for i, d in rows
        ]
        certified = np.array([d.length_mm * MILLIMETRE for _, d in rows])
        factor = np.array([growth for growth, _ in grown])
        common = {SCALE_ERROR_NAME: recording.gauge.sigma_scale_ppm * PPM} if recording.gauge.sigma_scale_ppm else {}
        changes = [change | common for _, change in grown]
        shared = {
            name: certified * np.array([change.get(name, 0.0) for change in changes])
            for name in dict.fromkeys(name for change in changes for name in change)
        }
        return cls(
            np.array([index[d.from_] for _, d in rows], dtype=np.int64),
            np.array([index[d.to] for _, d in rows], dtype=np.int64),
            factor,
            certified * factor,
            np.array([d.sigma_mm * MILLIMETRE for _, d in rows]),
            shared,
        )

    @property
    def determine_scale(self) -> bool:
        """True if the lengths constrain their common scale."""
        return SCALE_ERROR_NAME not in self.shared_error_changes or bool(
            np.any(self.shared_error_changes[SCALE_ERROR_NAME] < 0.99 * MIN_UNKNOWN_SCALE_PPM * PPM * self.lengths)
        )

    @property
    def sigma(self) -> Floats:
        """Total standard deviation of each length, (g,) [m]."""
        return np.sqrt(self.certificate_sigmas**2 + sum(change**2 for change in self.shared_error_changes.values()))


def _growth_and_changes(
    recording: Recording, line: GaugeDistance, location: dict[str, Any]
) -> tuple[float, dict[str, float]]:
    """Growth factor of a length, and its change by one standard deviation of its coefficient and its thermometer."""
    if line.measured_in_place:
        return 1.0, {}
    gauge = recording.gauge
    materials = gauge.materials or {}
    if line.material is not None and line.material not in materials:
        expected = f"one of {', '.join(materials)}" if materials else f"a table [gauge.materials.{line.material}]"
        raise RecordError(
            f"the material '{quoted_text(line.material)}' is not declared, expected {expected}", **location
        )
    material = gauge if line.material is None else materials[line.material]
    given = gauge.measured_at_c if line.measured_at_c is None else line.measured_at_c
    measured = _mean_of_column(recording, given, line, location) if isinstance(given, str) else given
    sigma = gauge.sigma_temperature_k if line.sigma_temperature_k is None else line.sigma_temperature_k
    ends = "" if line.measured_at_c is None else f"{line.from_}-{line.to}"
    thermometer = f"temperature of {given if isinstance(given, str) else ends or 'the gauge'}"
    grown = ThermalExpansion.from_temperature(
        material.expansion_per_k, measured - gauge.calibrated_at_c, material.sigma_expansion_per_k, sigma
    )
    changes = {
        f"{EXPANSION_ERROR_PREFIX}{line.material or 'the gauge'}": grown.change_by_coefficient,
        thermometer: grown.change_by_temperature,
    }
    return grown.length_ratio, {name: change for name, change in changes.items() if change}


def _mean_of_column(recording: Recording, name: str, line: GaugeDistance, location: dict[str, Any]) -> float:
    """Mean of a column over the pointings to both ends of a length."""
    if name not in recording.covariates:
        columns = ", ".join(recording.covariates) or "none"
        message = f"measured_at_c names '{quoted_text(name)}', which is not a column of numbers; there are {columns}"
        raise RecordError(message, **location)
    end_targets = [recording.targets.index(target) for target in (line.from_, line.to)]
    values = recording.covariates[name][np.isin(recording.target, end_targets)]
    if not np.isfinite(values).any():
        message = f"the column {name} is empty where {line.from_} and {line.to} were measured, expected temperatures"
        raise RecordError(message, **location)
    return float(np.nanmean(values))


MAX_EXACT_SIGMA_RATIO = 0.1
"""Largest ratio of the sigma of an unmeasured mark to that of a difference to it at which the mark counts as exact."""


def mark_indices(recording: Recording) -> dict[str, int]:
    """Index of each mark: its target (0 to T - 1), else T plus the first set-up over it.

    It is T + S, after T targets and S set-ups, for an unmeasured mark with known coordinates.
    """
    count, last = len(recording.targets), len(recording.targets) + len(recording.stations)
    places = {name: last for name, target in recording.setup.targets.items() if target.known_mm is not None}
    overs = [recording.station_setup(name).over for name in recording.stations]
    places |= {mark: count + s for s, mark in reversed([*enumerate(overs)]) if mark}
    return places | {name: i for i, name in enumerate(recording.targets)}


def check_differences(recording: Recording, file: object) -> None:
    """Check that each end of a reference difference is measured or known much better; raises RecordError."""
    places, last = mark_indices(recording), len(recording.targets) + len(recording.stations)
    for difference in recording.setup.differences:
        for name in (difference.from_, difference.to):
            if places.get(name, last) == last and not _is_exact_mark(recording.target_setup(name), difference):
                wanted = f"known along {difference.known_axes}, at least ten times better than this difference"
                message = f"'{quoted_text(name)}' was never measured, expected a mark that was, or one that is {wanted}"
                raise SourceLocation(file, column=f"difference {difference.label}").error(message)


def _is_exact_mark(target: Target, difference: ReferenceDifference) -> bool:
    axes = ["xyz".index(axis) for axis in difference.known_axes]
    is_control = target.known_mm is not None and {*difference.known_axes} <= {*target.known_axes}
    return is_control and bool(
        _coordinate_sigmas(target)[axes].max() <= MAX_EXACT_SIGMA_RATIO * _coordinate_sigmas(difference)[axes].min()
    )


def _coordinate_sigmas(reference: Target | ReferenceDifference) -> Floats:
    """Standard deviations (3,) [mm] of known coordinates."""
    if reference.known_covariance_mm2 is None:
        return np.full(3, reference.known_sigma_mm)
    return np.sqrt(np.diag(symmetric_matrix(reference.known_covariance_mm2)))
