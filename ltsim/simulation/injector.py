"""Injection of an effect into an existing recording: the change that the effect predicts is added to the readings.

Noise, outliers and instrument errors of the existing recording remain. The change is computed at the adjusted positions
of stations and targets. A position error of 1 mm at a range of 10 m alters the change by 1e-4 of its size.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.core.results import ColumnValues, Result, Table, number_columns
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.core.units import MICROMETRE, MICRORADIAN
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.effects.effect import Blunder, Effect, NoiseEffect
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.effects.verbs import displayed_shape_parameters
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording
from ltsim.simulation.simulator import with_certified_reference_lengths

INJECTION_FORMAT = "ltsim-injection/1"
"""Format and version of a file with the true values of injections."""
NONCENTRALITY_TOLERANCE = 1e-4
"""Largest relative difference between the noncentrality of a scaled effect and the requested noncentrality. When it is
reached, the scaling ends."""
MAX_NONCENTRALITY_SCALING_STEPS = 60
"""Largest number of iterations in the scaling of an effect to the requested noncentrality."""
MAX_CHANGE_SIGMAS_PER_ROOT_NONCENTRALITY = 30.0
"""Largest permitted change of a reading by an injected effect. The unit is the standard deviation of the reading, times
the square root of the requested noncentrality. An effect that needs a larger change is rejected, because the unknowns
of the network absorb nearly all of it."""


@dataclass(frozen=True, repr=False)
class InjectedEffect(Result):
    """Effect that was injected into a recording, with the values of its parameters."""

    effect: CandidateEffect
    """Injected effect, with the stations and targets where it acts."""
    effect_specification: str
    """Specification of the effect as the user wrote it, such as `range-offset:S3`."""
    parameter_values: Floats
    """Values of the parameters of the effect, shape (parameters,) [SI]."""
    noncentrality: float
    """Noncentrality of the effect in the residuals: expected decrease of chi-square if the effect is modelled. For an
    effect on the noise, expected decrease of minus twice the log-likelihood."""
    largest_changes: dict[str, float]
    """Largest absolute change of a reading, by observable: distance [um], azimuth and elevation [urad]. For an effect
    on the noise, the largest added standard deviation."""

    def _summary_lines(self) -> list[str]:
        sizes_text = ", ".join(
            f"{p.name} {value / p.si_per_display_unit:.4g} {p.unit}".rstrip() for p, value in self._parameter_entries()
        )
        place = f" at {self.effect.place_text}" if self.effect.place_text else ""
        return [f"Injected: {self.effect_specification}{place}: {sizes_text}; noncentrality {self.noncentrality:.3g}"]

    def _parameter_entries(self) -> list[tuple[Any, float]]:
        """Pairs of a parameter of the effect and its value [SI]."""
        return list(zip(self.effect.parameters, self.parameter_values.tolist(), strict=True))

    def _table_makers(self) -> dict[str, Any]:
        return {"parameters": self._parameter_columns}

    def _parameter_columns(self) -> ColumnValues:
        """Columns of the table of parameters: name, value and unit."""
        size_entries = self._parameter_entries()
        return {
            "parameter": [p.name for p, _ in size_entries],
            "value": [value / p.si_per_display_unit for p, value in size_entries],
            "unit": [p.unit for p, _ in size_entries],
        }

    def to_json(self) -> dict[str, Any]:
        """Entry of the effect, as JSON data, in the truth file of an injection."""
        cause = self.effect
        shape = displayed_shape_parameters(cause) if isinstance(cause, Effect) else {}
        return {
            "effect": cause.name, "words": self.effect_specification,
            "stations": list(cause.stations), "targets": list(cause.targets),
            "observables": list(cause.observables), "covariates": list(cause.covariates), "shape": shape,
            "parameters": self.table().json_rows(),
            "noncentrality": self.noncentrality, "largest": self.largest_changes,
        }  # fmt: skip


@dataclass(frozen=True, repr=False)
class InjectionTruth(Result):
    """Effects that were injected into a recording, with the seed of the random values."""

    seed: int
    """Seed of the random values of the injection."""
    injected_effects: tuple[InjectedEffect, ...]
    """Effects in the order of their injection."""

    def _summary_lines(self) -> list[str]:
        return [repr(cause) for cause in self.injected_effects]

    def to_json(self) -> dict[str, Any]:
        """Content of the truth file of an injection, as JSON data."""
        return {
            "format": INJECTION_FORMAT,
            "seed": self.seed,
            "injected": [cause.to_json() for cause in self.injected_effects],
        }


class RecordingWithInjection(NamedTuple):
    """Recording with injected effects, and the true parameter values of these effects."""

    recording: Recording
    """Recording with the changed readings."""
    truth: InjectionTruth
    """Injected effects with their true parameter values."""


DETECTION_CURVE_TABLE = Table(
    "curve.csv",
    "Injections of an effect at several noncentralities, each diagnosed with default options; 95 % intervals (Wilson).",
    (
        *number_columns(format_text=".4g", noncentrality="Noncentrality of the effect after the adjustment."),
        *number_columns(format_text=".4g", largest_um="Largest change of a distance, averaged over the injections."),
        *number_columns(format_text=".4g", largest_urad="Largest change of an angle, averaged over the injections."),
        *number_columns(injections="Number of injections."),
        *number_columns(
            detections="Number of injections after which the diagnosis reports a new finding.",
            placed="Number of injections with a new finding at the stations or targets of the injected effect.",
            named="Number of injections with a new finding that has the name of the injected effect.",
            right="Number of injections whose first new finding has the name and place of the injected effect.",
        ),
        *number_columns(format_text=".3f", detections_low="", detections_high=""),
        *number_columns(format_text=".3f", placed_low="", placed_high="", named_low="", named_high=""),
    ),
)  # fmt: skip


@dataclass(frozen=True, repr=False)
class DetectionCurve(Result):
    """Detection curve of an effect: how many of its injections are detected, located and named, by noncentrality."""

    effect_specification: str
    """Specification of the injected effect, such as `range-offset:S3`."""
    effects_without_injection: tuple[str, ...]
    """Names of the effects that the diagnosis reports in the recording without an injection."""
    rows: tuple[Mapping[str, float], ...]
    """Rows of the curve, one for each noncentrality, as values by column name."""

    def _summary_lines(self) -> list[str]:
        reported = ", ".join(self.effects_without_injection) or "nothing"
        lines = [f"Injections of {self.effect_specification}; effects reported without an injection: {reported}"]
        return lines + [
            f"noncentrality {row['noncentrality']:.0f}: detected {row['detections']}, located {row['placed']}, "
            f"named {row['named']} of {row['injections']}"
            for row in self.rows
        ]

    def _table_makers(self) -> dict[str, Any]:
        return {"curve": lambda: DETECTION_CURVE_TABLE.with_rows(self.rows)}


@dataclass(frozen=True, eq=False)
class Injector:
    """Injector of effects into a recording, with the adjustment of the recording."""

    recording: Recording
    """Recording before the injection."""
    residual_space: ResidualSpace
    """Whitened equations of the adjusted recording, projected off all unknowns of the network. The projection gives the
    part of a change of the readings that no change of the unknowns can absorb; noncentralities are computed from this
    part."""

    @property
    def adjusted_state(self) -> NetworkState:
        """Adjusted poses of the stations and positions of the targets."""
        return self.residual_space.adjustment.state

    def reading_change(self, effect: CandidateEffect, parameter_values: Floats) -> Floats:
        """Change of the readings by an effect, shape (pointings, 3) [m, rad, rad]; 0 for effects on the noise.

        `parameter_values` (parameters,) [SI] are the parameters of the effect. The change is NaN for a missing reading.
        """
        sightings, readings = self.residual_space.sightings, self.recording.readings
        if not isinstance(effect, Blunder):
            return effect.reading_change(sightings, parameter_values)
        done, instrument = effect.measured_sightings(sightings), self.adjusted_state.instrument_parameters
        errors = instrument[0] if len(instrument) == 1 else instrument[sightings.instrument]
        construction = self.residual_space.adjustment.problem.model.construction
        moved, plain = (construction.readings_from_points(s.local_points, s.face, errors) for s in (done, sightings))
        change: Floats = effect.recorded_readings(sightings, readings + moved - plain) - readings
        return np.stack([change[:, 0], *wrap_angle(change[:, 1:]).T], axis=1)

    def reference_length_change(self, effect: CandidateEffect, parameter_values: Floats) -> Floats:
        """Change (lengths,) [m] of the reference lengths by an effect with parameters `parameter_values` [SI]."""
        gauge = self.residual_space.adjustment.problem.gauge_rows
        return (
            effect.gauge_design(gauge.first_targets, gauge.second_targets, self.adjusted_state.target_points)
            @ parameter_values
        )

    def added_noise_sigma(self, effect: NoiseEffect, parameter_values: Floats) -> Floats:
        """Standard deviation (pointings, 3) [m, rad, rad] of the noise that an effect adds to the readings.

        `parameter_values` (parameters,) [SI] are the parameters of the effect.
        """
        sigma = self.recording.reading_sigmas()
        added = effect.variance(self.residual_space.sightings, sigma, parameter_values) - sigma**2
        if np.nanmin(added) < -1e-9 * np.nanmax(sigma) ** 2:
            raise ModelError(f"{effect.name} would reduce the noise of the recording; give larger values")
        return np.sqrt(np.maximum(np.nan_to_num(added), 0.0))

    def noncentrality(self, effect: CandidateEffect, parameter_values: Floats) -> float:
        """Noncentrality of an effect with parameters `parameter_values` [SI]; 0 if the network's unknowns absorb it."""
        space = self.residual_space
        if isinstance(effect, NoiseEffect):
            used = np.flatnonzero(space.is_used_reading)
            factor = (
                1.0 + (self.added_noise_sigma(effect, parameter_values) / space.reading_sigmas).reshape(-1)[used] ** 2
            )
            return float((space.redundancy[: len(used)] * (factor - 1.0 - np.log(factor))).sum())
        change = np.nan_to_num(self.reading_change(effect, parameter_values))
        whitened_change = space.whiten(
            change[:, :, None], self.reference_length_change(effect, parameter_values)[:, None]
        )[:, 0]
        projected_design = space.project(whitened_change)
        square = float(projected_design @ projected_design)
        return square if square > NORMAL_EQUATIONS_TOLERANCE * float(whitened_change @ whitened_change) else 0.0

    def scale_to_noncentrality(
        self, effect: CandidateEffect, parameter_values: Floats, noncentrality_goal: float
    ) -> Floats:
        """Parameters (parameters,) [SI] at which an effect has the noncentrality `noncentrality_goal`.

        The result is `parameter_values` times a scale factor. ModelError is raised if the unknowns of the network
        absorb the effect.
        """
        if isinstance(effect, Blunder):
            raise ModelError(f"{effect.name} has no parameter to scale; leave out the noncentrality")
        factor, bound = 1.0, MAX_CHANGE_SIGMAS_PER_ROOT_NONCENTRALITY * np.sqrt(noncentrality_goal)
        for _ in range(MAX_NONCENTRALITY_SCALING_STEPS):
            noncentrality = self.noncentrality(effect, factor * parameter_values)
            if not noncentrality > 0.0 or (
                noncentrality < (1.0 + NONCENTRALITY_TOLERANCE) * noncentrality_goal
                and self._largest_relative_change(effect, factor * parameter_values) > bound
            ):
                break
            if abs(noncentrality / noncentrality_goal - 1.0) < NONCENTRALITY_TOLERANCE:
                return factor * parameter_values
            factor *= float(np.clip(np.sqrt(noncentrality_goal / noncentrality), 1e-3, 1e3))
        raise ModelError(
            f"the network absorbs {effect.name} {effect.place_text}: "
            f"no plausible size gives a noncentrality of {noncentrality_goal:g}"
        )

    def _largest_relative_change(self, effect: CandidateEffect, parameter_values: Floats) -> float:
        """Largest change of a reading, or noise added to a reading, divided by the reading's standard deviation."""
        reading_changes = (
            self.added_noise_sigma(effect, parameter_values)
            if isinstance(effect, NoiseEffect)
            else self.reading_change(effect, parameter_values)
        )
        return float(np.nanmax(np.abs(reading_changes) / self.residual_space.reading_sigmas, initial=0.0))

    def inject(
        self,
        effect: CandidateEffect,
        parameter_values: Floats,
        effect_specification: str,
        random_generator: np.random.Generator,
    ) -> tuple[Recording, InjectedEffect]:
        """Recording with an injected effect, and the entry of the effect for the truth file.

        `parameter_values` (parameters,) [SI] are the parameters of the effect, `effect_specification` is its text as
        the user wrote it. `random_generator` draws the random numbers for an effect on the noise.
        """
        if isinstance(effect, NoiseEffect):
            change = self.added_noise_sigma(effect, parameter_values) * random_generator.standard_normal(
                self.recording.readings.shape
            )
        else:
            change = self.reading_change(effect, parameter_values)
        injected_recording = self.recording.with_readings(self.recording.readings + change)
        lengths = self.reference_length_change(effect, parameter_values)
        if parameter_values.any() and not (np.nan_to_num(change).any() or lengths.any()):
            raise ModelError(
                f"{effect_specification} changes no reading; give measured stations or targets, and a time before the "
                "last of their readings"
            )
        if lengths.any():
            gauge = self.residual_space.adjustment.problem.gauge_rows
            if injected_recording.setup.gauge is None or len(injected_recording.gauge.distance) != len(lengths):
                raise ModelError(f"{effect.name}: only the lengths of a gauge can be changed, not those of scale bars")
            certified = np.array([line.length_mm for line in injected_recording.gauge.distance]) * 1e-3
            injected_recording = with_certified_reference_lengths(
                injected_recording, certified + lengths * certified / gauge.lengths
            )
        units = (MICROMETRE, MICRORADIAN, MICRORADIAN)
        largest = np.abs(np.nan_to_num(change)).max(axis=0) / units
        largest_by_observable = dict(
            zip(("distance_um", "azimuth_urad", "elevation_urad"), largest.tolist(), strict=True)
        )
        return injected_recording, InjectedEffect(
            effect,
            effect_specification,
            parameter_values,
            self.noncentrality(effect, parameter_values),
            largest_by_observable,
        )

    def with_recording(self, recording: Recording) -> Self:
        """Injector for `recording`, which already contains injected effects, with the adjustment of this injector."""
        return replace(self, recording=recording)
