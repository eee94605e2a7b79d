"""Injection of an effect into an existing recording: its predicted change is added to the readings.

Noise, outliers and instrument errors remain. The change is computed at the adjusted pointings; their error has a
relative influence of 1e-4 for 1 mm in 10 m.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import UNCHECKED
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.core.results import Columns, Result, Table, numbers
from ltsim.core.units import MICROMETRE, MICRORADIAN
from ltsim.geometry.polar import wrap
from ltsim.physics.effects.effect import Blunder, Effect, NoiseEffect
from ltsim.physics.effects.signature import CandidateEffect
from ltsim.physics.effects.verbs import display_constants
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording
from ltsim.simulation.simulator import with_certificates

FORMAT = "ltsim-injection/1"
CLOSE = 1e-4
ROUNDS = 60
MAX_CHANGE_SIGMAS = 30.0
"""Largest change of a reading in standard deviations, divided by the square root of the fraction of the effect that
remains after adjustment.
"""


@dataclass(frozen=True, repr=False)
class Injected(Result):
    """Effect with the values (q,) [SI] of its parameters, as injected into a recording."""

    cause: CandidateEffect
    words: str
    """Text of the user's request for the effect."""
    values: Floats
    noncentrality: float
    """Noncentrality of the effect after adjustment; for noise the expected decrease of minus twice
    the log likelihood.
    """
    largest: dict[str, float]
    """Largest change of a distance [um], azimuth and elevation [urad]; for noise the largest standard deviation."""

    def _lines(self) -> list[str]:
        sizes = ", ".join(
            f"{p.name} {value / p.si_per_display_unit:.4g} {p.unit}".rstrip() for p, value in self._parameters()
        )
        place = f" at {self.cause.place_text}" if self.cause.place_text else ""
        return [f"Injected: {self.words}{place}: {sizes}; noncentrality {self.noncentrality:.3g}"]

    def _parameters(self) -> list[tuple[Any, float]]:
        return list(zip(self.cause.parameters, self.values.tolist(), strict=True))

    def _tables(self) -> dict[str, Any]:
        return {"parameters": self._sizes}

    def _sizes(self) -> Columns:
        rows = self._parameters()
        return {
            "parameter": [p.name for p, _ in rows],
            "value": [value / p.si_per_display_unit for p, value in rows],
            "unit": [p.unit for p, _ in rows],
        }

    def to_json(self) -> dict[str, Any]:
        """Entry of the effect in a truth file."""
        cause = self.cause
        shape = display_constants(cause) if isinstance(cause, Effect) else {}
        return {
            "effect": cause.name, "words": self.words, "stations": list(cause.stations), "targets": list(cause.targets),
            "observables": list(cause.observables), "covariates": list(cause.covariates), "shape": shape,
            "parameters": self.table().json(), "noncentrality": self.noncentrality, "largest": self.largest,
        }  # fmt: skip


@dataclass(frozen=True, repr=False)
class InjectionTruth(Result):
    """Effects that were injected into a recording, with their values."""

    seed: int
    causes: tuple[Injected, ...]

    def _lines(self) -> list[str]:
        return [repr(cause) for cause in self.causes]

    def to_json(self) -> dict[str, Any]:
        """Contents of a truth file."""
        return {"format": FORMAT, "seed": self.seed, "injected": [cause.to_json() for cause in self.causes]}


class Injection(NamedTuple):
    """Recording with an injected effect, and the injected effect separately."""

    recording: Recording
    truth: InjectionTruth


CURVE = Table(
    "curve.csv",
    "Injections of one cause at several strengths, each diagnosed with default settings; 95 % intervals (Wilson).",
    (
        *numbers(form=".4g", noncentrality="Noncentrality of the effect after the adjustment."),
        *numbers(form=".4g", largest_um="Largest change of a distance, mean of the injections."),
        *numbers(form=".4g", largest_urad="Largest change of an angle, mean of the injections."),
        *numbers(injections="Number of injections."),
        *numbers(
            detections="Number of injections with a new finding.",
            placed="Those with a new finding at the right place.",
            named="Those with a new finding of the right name.",
            right="Those whose first new finding has the right name and place.",
        ),
        *numbers(form=".3f", detections_low="", detections_high=""),
        *numbers(form=".3f", placed_low="", placed_high="", named_low="", named_high=""),
    ),
)  # fmt: skip


@dataclass(frozen=True, repr=False)
class InjectionCurve(Result):
    """Detection curve: strength of an effect, and probability that it is detected, located and named."""

    words: str
    background: tuple[str, ...]
    """Effects reported for the recording without an injection."""
    rows: tuple[Mapping[str, float], ...]

    def _lines(self) -> list[str]:
        reported = ", ".join(self.background) or "nothing"
        lines = [f"{self.words}, injected into the recording; findings without the injection: {reported}"]
        return lines + [
            f"noncentrality {row['noncentrality']:.0f}: detected {row['detections']}, placed {row['placed']}, "
            f"named {row['named']} of {row['injections']}"
            for row in self.rows
        ]

    def _tables(self) -> dict[str, Any]:
        return {"curve": lambda: CURVE.filled(self.rows)}


@dataclass(frozen=True, eq=False)
class Injector:
    """Recording with its adjustment, for the injection of effects."""

    recording: Recording
    space: ResidualSpace

    @property
    def state(self) -> NetworkState:
        """Adjusted state: poses of the stations, positions of the targets."""
        return self.space.adjustment.state

    def change(self, cause: CandidateEffect, values: Floats) -> Floats:
        """Change (n, 3) [m, rad, rad] of the readings by an effect, NaN for missing readings; 0 for noise."""
        sightings, readings = self.space.sightings, self.recording.readings
        if not isinstance(cause, Blunder):
            return cause.reading_change(sightings, values)
        done, instrument = cause.measured_sightings(sightings), self.state.instrument_parameters
        errors = instrument[0] if len(instrument) == 1 else instrument[sightings.instrument]
        construction = self.space.adjustment.problem.model.construction
        moved, plain = (construction.readings(s.local, s.face, errors) for s in (done, sightings))
        change: Floats = cause.recorded_readings(sightings, readings + moved - plain) - readings
        return np.stack([change[:, 0], *wrap(change[:, 1:]).T], axis=1)

    def lengths(self, cause: CandidateEffect, values: Floats) -> Floats:
        """Change (g,) [m] of the reference lengths by an effect."""
        gauge = self.space.adjustment.problem.gauge
        return cause.gauge_design(gauge.first, gauge.second, self.state.target_points) @ values

    def deviation(self, cause: NoiseEffect, values: Floats) -> Floats:
        """Standard deviation (n, 3) of the added noise."""
        sigma = self.recording.sigma()
        added = cause.variance(self.space.sightings, sigma, values) - sigma**2
        if np.nanmin(added) < -1e-9 * np.nanmax(sigma) ** 2:
            raise ModelError(f"{cause.name} would reduce the noise of the recording; give larger values")
        return np.sqrt(np.maximum(np.nan_to_num(added), 0.0))

    def noncentrality(self, cause: CandidateEffect, values: Floats) -> float:
        """Noncentrality of an effect after the adjustment; 0 if the network absorbs it."""
        space = self.space
        if isinstance(cause, NoiseEffect):
            used = np.flatnonzero(space.use)
            factor = 1.0 + (self.deviation(cause, values) / space.sigma).reshape(-1)[used] ** 2
            return float((space.redundancy[: len(used)] * (factor - 1.0 - np.log(factor))).sum())
        change = np.nan_to_num(self.change(cause, values))
        whole = space.whiten(change[:, :, None], self.lengths(cause, values)[:, None])[:, 0]
        projected = space.project(whole)
        square = float(projected @ projected)
        return square if square > UNCHECKED * float(whole @ whole) else 0.0

    def sized(self, cause: CandidateEffect, values: Floats, wanted: float) -> Floats:
        """Values scaled to the requested noncentrality; raises ModelError if the network absorbs the effect."""
        if isinstance(cause, Blunder):
            raise ModelError(f"{cause.name} has no size; leave out the noncentrality")
        factor, bound = 1.0, MAX_CHANGE_SIGMAS * np.sqrt(wanted)
        for _ in range(ROUNDS):
            noncentrality = self.noncentrality(cause, factor * values)
            if not noncentrality > 0.0 or (
                noncentrality < (1.0 + CLOSE) * wanted and self._peak(cause, factor * values) > bound
            ):
                break
            if abs(noncentrality / wanted - 1.0) < CLOSE:
                return factor * values
            factor *= float(np.clip(np.sqrt(wanted / noncentrality), 1e-3, 1e3))
        raise ModelError(
            f"the network absorbs {cause.name} {cause.place_text}: "
            f"no plausible size gives a noncentrality of {wanted:g}"
        )

    def _peak(self, cause: CandidateEffect, values: Floats) -> float:
        """Largest change of a reading, or standard deviation of added noise, divided by the sigma of the reading."""
        moved = self.deviation(cause, values) if isinstance(cause, NoiseEffect) else self.change(cause, values)
        return float(np.nanmax(np.abs(moved) / self.space.sigma, initial=0.0))

    def put(
        self, cause: CandidateEffect, values: Floats, words: str, rng: np.random.Generator
    ) -> tuple[Recording, Injected]:
        """Recording with an injected effect, and the entry of the effect."""
        if isinstance(cause, NoiseEffect):
            change = self.deviation(cause, values) * rng.standard_normal(self.recording.readings.shape)
        else:
            change = self.change(cause, values)
        made = self.recording.with_readings(self.recording.readings + change)
        lengths = self.lengths(cause, values)
        if values.any() and not (np.nan_to_num(change).any() or lengths.any()):
            raise ModelError(
                f"{words}: changes no reading; give a place that was measured, after the time if there is one"
            )
        if lengths.any():
            gauge = self.space.adjustment.problem.gauge
            if made.setup.gauge is None or len(made.gauge.distance) != len(lengths):
                raise ModelError(f"{cause.name}: only the lengths of a gauge can be changed, not those of scale bars")
            certified = np.array([line.length_mm for line in made.gauge.distance]) * 1e-3
            made = with_certificates(made, certified + lengths * certified / gauge.length)
        units = (MICROMETRE, MICRORADIAN, MICRORADIAN)
        largest = np.abs(np.nan_to_num(change)).max(axis=0) / units
        largest_by_observable = dict(
            zip(("distance_um", "azimuth_urad", "elevation_urad"), largest.tolist(), strict=True)
        )
        return made, Injected(cause, words, values, self.noncentrality(cause, values), largest_by_observable)

    def after(self, recording: Recording) -> Self:
        """Injector for a recording that already contains an injected effect."""
        return replace(self, recording=recording)
