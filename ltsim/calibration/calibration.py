"""A calibration: what was found out about the instrument, how well, and what was not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.evaluation.criteria import Criteria
from ltsim.adjustment.identification.tests import Test
from ltsim.adjustment.prior import FREED
from ltsim.adjustment.verdict import Verdict
from ltsim.calibration.evidence import by_plausible_sizes, determined, harmonics
from ltsim.calibration.schema import (
    COORDINATES,
    RESIDUALS,
    TARGETS,
    AxesEntry,
    Combination as Combination,
    Correction as Correction,
    DeterminedEntry,
    Fit as Fit,
    FittedEffectEntry,
    HarmonicEntry,
    KnownEntry,
    NoiseRow as NoiseRow,
    OutlierRow as OutlierRow,
    ParameterEntry,
    StationPose as StationPose,
)
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.core.probability import format_p, two_sided
from ltsim.core.results import Column, Result, Table, columns_of
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.physics.effects.signature import Parameter
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.recordings.result_file import SourceEntry

OfOne = TypeVar("OfOne", DeterminedEntry, HarmonicEntry)
SHOWN_UNITS = (("mm", MILLIMETRE), ("arcsec", ARCSECOND), ("arcsec", ARCSECOND))
"""Unit of each column of the readings where a person reads it."""

PARAMETERS = Table(
    "parameters.csv",
    "estimates of the instrument's parameters, each in its unit",
    columns_of(
        ParameterEntry,
        "name instrument value sigma unit prior_sigma held applied",
        value={"sigma": "sigma"},
        prior_sigma={"shown": ".3g"},
        name={"name": "parameter"},
    ),
)
KNOWN = Table("known.csv", "known values, each tested by the rest", columns_of(KnownEntry))
OUTLIERS = Table("outliers.csv", "readings that do not belong", columns_of(OutlierRow))
NOISE = Table(
    "noise.csv",
    "noise found from the readings",
    columns_of(NoiseRow, factor={"sigma": "factor_sigma"}, redundancy={"shown": ".1f"}, typical={"shown": ".3g"}),
)
STATIONS = Table("stations.csv", "adjusted stations", (Column("station", "name", "text"), *COORDINATES[1:]))
SHARPER = 0.975
"""Ratio of a parameter's sigma to its prior's below which the recording told something: 5 % of the variance."""
SAME = 1e-9
"""Difference of what is applied from the estimate, to the estimate or its sigma, below which it is the estimate."""
MOSTLY = 0.9
"""Share of the redundancy whose noise was estimated, from which chi-square over redundancy is 1 by construction."""


@dataclass(frozen=True, repr=False)
class Calibration(Result):
    """Instrument parameters with their covariance, and the network they were found in.

    What has no words of its own is as in `CalibrationFile`.
    """

    method: str
    """`network`, `distance`, `distance-l1`; `adjustment` for a network without instrument parameters."""
    construction: Construction
    instruments: tuple[str, ...]
    """Their names; one unnamed instrument is called ''."""
    values: Floats
    prior_sigma: Floats
    """(I, p) [SI] each."""
    covariance: Floats
    """(I p, I p) [SI]: zero for parameters that were held."""
    fit: Fit
    undetermined: tuple[Combination, ...]
    frame: str
    stations: tuple[StationPose, ...]
    targets: tuple[str, ...] = ()
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(T, 3) [m]."""
    target_covariance: Floats = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """(T, 3, 3) [m^2]."""
    criteria: Criteria | None = None
    """None where a single station leaves nothing to compare."""
    outliers: tuple[OutlierRow, ...] = ()
    verdict: Verdict | None = None
    """Verdict on the test to trust where tests disagree; None for the distance methods and for results from a file."""
    robust: bool = False
    noise: tuple[NoiseRow, ...] = ()
    known: tuple[KnownEntry, ...] = ()
    lost_targets: tuple[str, ...] = ()
    axes: AxesEntry | None = None
    held: Bools = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    """(I, p): parameters that were not estimated but held at their value."""
    beyond_prior: Bools = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    """(I, p): parameters whose prior the readings contradict, and whose estimate follows them."""
    informed: bool = False
    silent: Floats = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    """(k, I p): combinations, in prior sigmas, that a distance method left at zero."""
    correction: Correction | None = None
    weighed: Floats | None = None
    """(I, p) [SI]: what is taken out of readings where that is not the estimates themselves."""
    effects: tuple[FittedEffectEntry, ...] = ()
    notes: tuple[str, ...] = ()
    tests: tuple[Test, ...] = ()
    recording: SourceEntry | None = None
    adjustment: Adjustment | None = field(default=None, repr=False, compare=False)
    """The adjusted network; None for a calibration that was read from a file."""

    def __post_init__(self) -> None:
        for name in ("held", "beyond_prior"):
            if getattr(self, name).shape != self.values.shape:
                object.__setattr__(self, name, np.zeros(self.values.shape, dtype=bool))

    @property
    def prior_used(self) -> Floats:
        """Standard deviations (I, p) [SI] of the prior that the estimates had."""
        return np.where(self.beyond_prior, FREED, 1.0) * self.prior_sigma

    @cached_property
    def sigma(self) -> Floats:
        """Standard deviations (I, p) of the parameters [SI]."""
        return np.sqrt(np.diag(self.covariance)).reshape(self.values.shape)

    @cached_property
    def determined(self) -> tuple[DeterminedEntry, ...]:
        """Combinations of parameters that are known far better than each of them."""
        bayes = self.method == "network" and not self.informed
        return self._of_each(determined, by_plausible_sizes if bayes else None)

    @cached_property
    def harmonics(self) -> tuple[HarmonicEntry, ...]:
        """Every pair of a cosine and a sine coefficient as amplitude and phase."""
        return self._of_each(harmonics)

    def _of_each(
        self,
        told: Callable[[Sequence[Parameter], Floats, Floats], list[OfOne]],
        seen: Callable[[Sequence[Parameter], Floats, Floats, Floats], tuple[Floats, Floats]] | None = None,
    ) -> tuple[OfOne, ...]:
        """Entries of each instrument by its values and covariance, as `seen`; with its name where there are several."""
        several, size = len(self.instruments) > 1, self.construction.size
        found: list[OfOne] = []
        parameters = self.construction.parameters
        for i, (name, values) in enumerate(zip(self.instruments, self.values, strict=True)):
            covariance = self.covariance[i * size : (i + 1) * size, i * size : (i + 1) * size]
            if seen is not None:
                values, covariance = seen(parameters, values, covariance, self.prior_used[i])
            entries = told(parameters, values, covariance)
            found += [entry.model_copy(update={"instrument": name}) if several else entry for entry in entries]
        return tuple(found)

    @property
    def missed(self) -> Floats:
        """(I p, I p) What the estimates miss of the truth, noise aside, both in prior sigmas: -missed @ truth."""
        if self.method == "network":
            unit = self.prior_sigma.ravel()
            return self.covariance / np.outer(unit, unit)
        return self.silent.T @ self.silent

    @property
    def applied(self) -> Floats:
        """Parameters (I, p) [SI] to take out of readings."""
        return self.values if self.correction is None or self.weighed is None else self.weighed

    @property
    def noise_estimated(self) -> bool:
        """Whether so much of the noise was estimated from the readings that the fit tests nothing any more."""
        whole = sum(n.redundancy for n in self.noise)
        found = sum(n.redundancy for n in self.noise if n.factor_sigma is not None)
        return found > MOSTLY * whole

    def _lines(self) -> list[str]:
        fit, count = self.fit, len(self.names)
        test = f"chi2/dof {fit.chi2:.1f}/{fit.dof}"
        test += "" if fit.p_value is None else f", two-sided {format_p(two_sided(fit.p_value))}"
        known = int(((self.sigma < SHARPER * self.prior_sigma) & ~self.held).sum())
        lines = [
            f"Calibration ({self.method}, {self.construction.name}): {fit.status}, {test}",
            f"{len(self.stations)} stations and {len(self.targets)} targets in {self.frame}",
        ]
        if count:
            undetermined = f"{len(self.undetermined)} combinations are not determined"
            held = f" ({int(self.held.sum())} held)" if self.held.any() else ""
            lines.append(f"{count} parameters{held}, {known} better known than before; {undetermined}")
        lines += [effect.sentence for effect in self.effects]
        if self.outliers:
            lines.append(f"{len(self.outliers)} readings do not belong")
        if self.criteria is not None:
            lines.append(f"stations disagree in distances by {self.criteria.distance.words}")
        if self.correction is not None and self.correction.uncorrected_um > 0:
            lines += [self.correction.line, *self.correction.sentences]
        return [*lines, *self.notes]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        tables: dict[str, Callable[[], Table]] = {
            "parameters": lambda: PARAMETERS.filled(self.parameters),
            "targets": lambda: targets_table(self.targets, self.points, self.target_covariance),
            "stations": self._stations,
            "outliers": lambda: OUTLIERS.filled(self.outliers),
            "noise": lambda: NOISE.filled(self.noise),
            "known": lambda: KNOWN.filled(self.known),
        }
        adjustment = self.adjustment
        if adjustment is not None:
            tables["residuals"] = lambda: residuals_table(adjustment)
        return tables if self.names else {name: tables[name] for name in tables if name != "parameters"}

    @cached_property
    def parameters(self) -> tuple[ParameterEntry, ...]:
        """The estimates in the units a person reads."""
        several = len(self.instruments) > 1
        named: list[dict[str, Any]] = [{"instrument": name} if several else {} for name in self.instruments]
        return tuple(
            ParameterEntry(
                name=parameter.name,
                value=float(self.values[i, k] / parameter.factor),
                sigma=float(self.sigma[i, k] / parameter.factor),
                unit=parameter.unit,
                prior_sigma=float(self.prior_sigma[i, k] / parameter.factor),
                held=bool(self.held[i, k]),
                beyond_prior=bool(self.beyond_prior[i, k]),
                **self._applied(i, k),
                **named[i],
            )
            for i in range(len(self.instruments))
            for k, parameter in enumerate(self.construction.parameters)
        )

    def _applied(self, instrument: int, parameter: int) -> dict[str, Any]:
        """The applied value in the parameter's unit where it is not the estimate."""
        value, applied = self.values[instrument, parameter], self.applied[instrument, parameter]
        factor = self.construction.parameters[parameter].factor
        near = SAME * max(abs(value), self.sigma[instrument, parameter])
        return {} if abs(applied - value) <= near else {"applied": float(applied / factor)}

    def _stations(self) -> Table:
        sigma = [s.sigma_position_mm or (None,) * 3 for s in self.stations]
        return STATIONS.filled([s.name, *s.position_mm, *own] for s, own in zip(self.stations, sigma, strict=True))

    @property
    def names(self) -> tuple[str, ...]:
        """Names (I p) of all parameters, with ``@instrument`` where there are several instruments."""
        return self.construction.names_of(self.instruments)

    def part(self, instrument: int, keep: Ints) -> Calibration:
        """The calibration of one instrument with some of its parameters, without a correction."""
        one, at = slice(instrument, instrument + 1), instrument * self.construction.size + keep
        return replace(
            self,
            construction=self.construction.only(keep),
            instruments=self.instruments[one],
            values=self.values[one, keep],
            prior_sigma=self.prior_sigma[one, keep],
            covariance=self.covariance[np.ix_(at, at)],
            held=self.held[one, keep],
            beyond_prior=self.beyond_prior[one, keep],
            correction=None,
        )

    def values_for(self, recording: Recording) -> Floats:
        """Parameters to apply (p,) or, where instruments differ, (n, p) of each pointing of a recording.

        A calibration of one instrument is applied to any recording; one of several needs the same names.

        Raises
        ------
        RecordError
            When the recording names an instrument that the calibration does not know.
        """
        if len(self.instruments) == 1:
            return self.applied[0]
        unknown = [name for name in recording.instruments if name not in self.instruments]
        if unknown:
            raise RecordError(
                f"the recording's instrument '{unknown[0]}' is not among those of the calibration: "
                + ", ".join(self.instruments)
            )
        at = np.array([self.instruments.index(name) for name in recording.instruments])
        return self.applied[at[recording.instrument]]


def targets_table(names: Sequence[str], points: Floats, covariance: Floats) -> Table:
    """The table of points (T, 3) [m] with covariance (T, 3, 3) [m^2]; NaN ones have no row, or no height alone."""
    sigma = np.sqrt(np.einsum("tii->ti", covariance)) / MILLIMETRE
    cells = np.concatenate([np.where(np.isfinite(sigma), points / MILLIMETRE, np.nan), sigma], axis=1)
    known = np.flatnonzero(np.isfinite(sigma[:, :2]).all(axis=1)).tolist()
    return TARGETS.filled([names[i], *cells[i].tolist()] for i in known)


def residuals_table(adjustment: Adjustment) -> Table:
    """One row an observation that was used, rows counted from 1."""
    recording = adjustment.recording

    def row(i: int, k: int) -> list[object]:
        unit, factor = SHOWN_UNITS[k]
        names = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        size = adjustment.residuals[i, k] / factor, unit, adjustment.redundancy[i, k], adjustment.w[i, k]
        return [i + 1, *names, recording.face[i], recording.repeat[i], OBSERVABLES[k], *size]

    return RESIDUALS.filled(row(i, k) for i, k in np.argwhere(adjustment.problem.use).tolist())
