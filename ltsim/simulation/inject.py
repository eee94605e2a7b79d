"""Injection of an effect into an existing recording: its predicted change is added to the readings.

Noise, outliers and instrument errors remain. The change is computed at the adjusted pointings; their error has a
relative influence of 1e-4 for 1 mm in 10 m.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import MIN_NUMERICAL_REDUNDANCY
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.core.results import ColumnValues, Result, Table, numbers
from ltsim.core.units import MICROMETRE, MICRORADIAN
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.effects.effect import Blunder, Effect, NoiseEffect
from ltsim.physics.effects.signature import CandidateEffect
from ltsim.physics.effects.verbs import display_constants
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording
from ltsim.simulation.simulator import with_certificates

INJECTION_FORMAT = "ltsim-injection/1"
"""Format and version of a truth file of injections."""
NONCENTRALITY_TOLERANCE = 1e-4
"""Relative difference to the requested noncentrality at which the scaling ends."""
MAX_SCALING_STEPS = 60
"""Largest number of steps in the scaling to a noncentrality."""
MAX_CHANGE_SIGMAS = 30.0
"""Largest change of a reading in standard deviations, divided by the square root of the fraction of the effect that
remains after adjustment.
"""


@dataclass(frozen=True, repr=False)
class InjectedEffect(Result):
    """Effect with the values (q,) [SI] of its parameters, as injected into a recording."""

    effect: CandidateEffect
    request_text: str
    """Text of the user's request for the effect."""
    parameter_values: Floats
    noncentrality: float
    """Noncentrality of the effect after adjustment; for noise the expected decrease of minus twice
    the log likelihood.
    """
    largest_changes: dict[str, float]
    """Largest change of a distance [um], azimuth and elevation [urad]; for noise the largest standard deviation."""

    def _lines(self) -> list[str]:
        sizes = ", ".join(
            f"{p.name} {value / p.si_per_display_unit:.4g} {p.unit}".rstrip() for p, value in self._parameter_entries()
        )
        place = f" at {self.effect.place_text}" if self.effect.place_text else ""
        return [f"Injected: {self.request_text}{place}: {sizes}; noncentrality {self.noncentrality:.3g}"]

    def _parameter_entries(self) -> list[tuple[Any, float]]:
        return list(zip(self.effect.parameters, self.parameter_values.tolist(), strict=True))

    def _tables(self) -> dict[str, Any]:
        return {"parameters": self._size_table}

    def _size_table(self) -> ColumnValues:
        rows = self._parameter_entries()
        return {
            "parameter": [p.name for p, _ in rows],
            "value": [value / p.si_per_display_unit for p, value in rows],
            "unit": [p.unit for p, _ in rows],
        }

    def to_json(self) -> dict[str, Any]:
        """Entry of the effect in a truth file."""
        cause = self.effect
        shape = display_constants(cause) if isinstance(cause, Effect) else {}
        return {
            "effect": cause.name, "words": self.request_text,
            "stations": list(cause.stations), "targets": list(cause.targets),
            "observables": list(cause.observables), "covariates": list(cause.covariates), "shape": shape,
            "parameters": self.table().json(), "noncentrality": self.noncentrality, "largest": self.largest_changes,
        }  # fmt: skip


@dataclass(frozen=True, repr=False)
class InjectionTruth(Result):
    """Effects that were injected into a recording, with their values."""

    seed: int
    injected_effects: tuple[InjectedEffect, ...]

    def _lines(self) -> list[str]:
        return [repr(cause) for cause in self.injected_effects]

    def to_json(self) -> dict[str, Any]:
        """Contents of a truth file."""
        return {
            "format": INJECTION_FORMAT,
            "seed": self.seed,
            "injected": [cause.to_json() for cause in self.injected_effects],
        }


class RecordingWithInjection(NamedTuple):
    """Recording with an injected effect, and the injected effect separately."""

    recording: Recording
    truth: InjectionTruth


DETECTION_CURVE_TABLE = Table(
    "curve.csv",
    "Injections of one cause at several strengths, each diagnosed with default settings; 95 % intervals (Wilson).",
    (
        *numbers(format_text=".4g", noncentrality="Noncentrality of the effect after the adjustment."),
        *numbers(format_text=".4g", largest_um="Largest change of a distance, mean of the injections."),
        *numbers(format_text=".4g", largest_urad="Largest change of an angle, mean of the injections."),
        *numbers(injections="Number of injections."),
        *numbers(
            detections="Number of injections with a new finding.",
            placed="Those with a new finding at the right place.",
            named="Those with a new finding of the right name.",
            right="Those whose first new finding has the right name and place.",
        ),
        *numbers(format_text=".3f", detections_low="", detections_high=""),
        *numbers(format_text=".3f", placed_low="", placed_high="", named_low="", named_high=""),
    ),
)  # fmt: skip


@dataclass(frozen=True, repr=False)
class DetectionCurve(Result):
    """Detection curve: strength of an effect, and probability that it is detected, located and named."""

    effect_text: str
    background_effects: tuple[str, ...]
    """Effects reported for the recording without an injection."""
    rows: tuple[Mapping[str, float], ...]

    def _lines(self) -> list[str]:
        reported = ", ".join(self.background_effects) or "nothing"
        lines = [f"{self.effect_text}, injected into the recording; findings without the injection: {reported}"]
        return lines + [
            f"noncentrality {row['noncentrality']:.0f}: detected {row['detections']}, placed {row['placed']}, "
            f"named {row['named']} of {row['injections']}"
            for row in self.rows
        ]

    def _tables(self) -> dict[str, Any]:
        return {"curve": lambda: DETECTION_CURVE_TABLE.with_rows(self.rows)}


@dataclass(frozen=True, eq=False)
class Injector:
    """Recording with its adjustment, for the injection of effects."""

    recording: Recording
    residual_space: ResidualSpace

    @property
    def state(self) -> NetworkState:
        """Adjusted state: poses of the stations, positions of the targets."""
        return self.residual_space.adjustment.state

    def reading_change(self, effect: CandidateEffect, effect_sizes: Floats) -> Floats:
        """Change (n, 3) [m, rad, rad] of the readings by an effect, NaN for missing readings; 0 for noise."""
        sightings, readings = self.residual_space.sightings, self.recording.readings
        if not isinstance(effect, Blunder):
            return effect.reading_change(sightings, effect_sizes)
        done, instrument = effect.measured_sightings(sightings), self.state.instrument_parameters
        errors = instrument[0] if len(instrument) == 1 else instrument[sightings.instrument]
        construction = self.residual_space.adjustment.problem.model.construction
        moved, plain = (construction.readings(s.local_points, s.face, errors) for s in (done, sightings))
        change: Floats = effect.recorded_readings(sightings, readings + moved - plain) - readings
        return np.stack([change[:, 0], *wrap_angle(change[:, 1:]).T], axis=1)

    def length_change(self, effect: CandidateEffect, effect_sizes: Floats) -> Floats:
        """Change (g,) [m] of the reference lengths by an effect."""
        gauge = self.residual_space.adjustment.problem.gauge_rows
        return effect.gauge_design(gauge.first_targets, gauge.second_targets, self.state.target_points) @ effect_sizes

    def added_noise_sigma(self, effect: NoiseEffect, effect_sizes: Floats) -> Floats:
        """Standard deviation (n, 3) of the added noise."""
        sigma = self.recording.sigma()
        added = effect.variance(self.residual_space.sightings, sigma, effect_sizes) - sigma**2
        if np.nanmin(added) < -1e-9 * np.nanmax(sigma) ** 2:
            raise ModelError(f"{effect.name} would reduce the noise of the recording; give larger values")
        return np.sqrt(np.maximum(np.nan_to_num(added), 0.0))

    def noncentrality(self, effect: CandidateEffect, effect_sizes: Floats) -> float:
        """Noncentrality of an effect after the adjustment; 0 if the network absorbs it."""
        space = self.residual_space
        if isinstance(effect, NoiseEffect):
            used = np.flatnonzero(space.used_readings)
            factor = 1.0 + (self.added_noise_sigma(effect, effect_sizes) / space.sigma).reshape(-1)[used] ** 2
            return float((space.redundancy[: len(used)] * (factor - 1.0 - np.log(factor))).sum())
        change = np.nan_to_num(self.reading_change(effect, effect_sizes))
        whole = space.whiten(change[:, :, None], self.length_change(effect, effect_sizes)[:, None])[:, 0]
        projected_signature = space.project(whole)
        square = float(projected_signature @ projected_signature)
        return square if square > MIN_NUMERICAL_REDUNDANCY * float(whole @ whole) else 0.0

    def scale_to_noncentrality(
        self, effect: CandidateEffect, effect_sizes: Floats, noncentrality_goal: float
    ) -> Floats:
        """Values scaled to the requested noncentrality; raises ModelError if the network absorbs the effect."""
        if isinstance(effect, Blunder):
            raise ModelError(f"{effect.name} has no size; leave out the noncentrality")
        factor, bound = 1.0, MAX_CHANGE_SIGMAS * np.sqrt(noncentrality_goal)
        for _ in range(MAX_SCALING_STEPS):
            noncentrality = self.noncentrality(effect, factor * effect_sizes)
            if not noncentrality > 0.0 or (
                noncentrality < (1.0 + NONCENTRALITY_TOLERANCE) * noncentrality_goal
                and self._largest_relative_change(effect, factor * effect_sizes) > bound
            ):
                break
            if abs(noncentrality / noncentrality_goal - 1.0) < NONCENTRALITY_TOLERANCE:
                return factor * effect_sizes
            factor *= float(np.clip(np.sqrt(noncentrality_goal / noncentrality), 1e-3, 1e3))
        raise ModelError(
            f"the network absorbs {effect.name} {effect.place_text}: "
            f"no plausible size gives a noncentrality of {noncentrality_goal:g}"
        )

    def _largest_relative_change(self, effect: CandidateEffect, effect_sizes: Floats) -> float:
        """Largest change of a reading, or standard deviation of added noise, divided by the sigma of the reading."""
        moved = (
            self.added_noise_sigma(effect, effect_sizes)
            if isinstance(effect, NoiseEffect)
            else self.reading_change(effect, effect_sizes)
        )
        return float(np.nanmax(np.abs(moved) / self.residual_space.sigma, initial=0.0))

    def inject(
        self, effect: CandidateEffect, effect_sizes: Floats, request_text: str, random_generator: np.random.Generator
    ) -> tuple[Recording, InjectedEffect]:
        """Recording with an injected effect, and the entry of the effect."""
        if isinstance(effect, NoiseEffect):
            change = self.added_noise_sigma(effect, effect_sizes) * random_generator.standard_normal(
                self.recording.readings.shape
            )
        else:
            change = self.reading_change(effect, effect_sizes)
        made = self.recording.with_readings(self.recording.readings + change)
        lengths = self.length_change(effect, effect_sizes)
        if effect_sizes.any() and not (np.nan_to_num(change).any() or lengths.any()):
            raise ModelError(
                f"{request_text}: changes no reading; give a place that was measured, after the time if there is one"
            )
        if lengths.any():
            gauge = self.residual_space.adjustment.problem.gauge_rows
            if made.setup.gauge is None or len(made.gauge.distance) != len(lengths):
                raise ModelError(f"{effect.name}: only the lengths of a gauge can be changed, not those of scale bars")
            certified = np.array([line.length_mm for line in made.gauge.distance]) * 1e-3
            made = with_certificates(made, certified + lengths * certified / gauge.lengths)
        units = (MICROMETRE, MICRORADIAN, MICRORADIAN)
        largest = np.abs(np.nan_to_num(change)).max(axis=0) / units
        largest_by_observable = dict(
            zip(("distance_um", "azimuth_urad", "elevation_urad"), largest.tolist(), strict=True)
        )
        return made, InjectedEffect(
            effect, request_text, effect_sizes, self.noncentrality(effect, effect_sizes), largest_by_observable
        )

    def with_recording(self, recording: Recording) -> Self:
        """Injector for a recording that already contains an injected effect."""
        return replace(self, recording=recording)
