"""Result of a calibration: estimated instrument parameters, their covariance, and the adjusted network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.evaluation.criteria import CriteriaEntry
from ltsim.adjustment.identification.tests import Test
from ltsim.adjustment.prior import FREED
from ltsim.adjustment.verdict import Verdict
from ltsim.calibration.combinations import Combination as Combination, DeterminedEntry
from ltsim.calibration.evidence import by_plausible_sizes, determined, harmonics
from ltsim.calibration.schema import (
    COORDINATES,
    RESIDUALS,
    TARGETS,
    AxesEntry,
    Correction as Correction,
    Fit as Fit,
    FittedEffectEntry,
    HarmonicEntry,
    NoiseRow as NoiseRow,
    OutlierRow as OutlierRow,
    ParameterEntry,
    ReferenceValueEntry,
    ReflectorEntry,
    StationPose as StationPose,
)
from ltsim.calibration.uncertainty import HiddenError, uncertainty_sentences
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.core.probability import format_p, two_sided
from ltsim.core.results import Column, Result, Table, columns_of, numbers, texts
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.physics.effects.signature import Parameter
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.recordings.result_file import SourceEntry

EntryT = TypeVar("EntryT", DeterminedEntry, HarmonicEntry)
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
REFERENCE_VALUES = Table(
    "reference_values.csv", "reference values, each tested by the rest", columns_of(ReferenceValueEntry)
)
OUTLIERS = Table("outliers.csv", "outlying readings", columns_of(OutlierRow))
NOISE = Table(
    "noise.csv",
    "noise estimated from the readings",
    columns_of(NoiseRow, factor={"sigma": "factor_sigma"}, redundancy={"shown": ".1f"}, typical={"shown": ".3g"}),
)
REFLECTORS = Table(
    "reflectors.csv",
    "incidence errors of reflectors in fixed nests, parameters of smr-incidence",
    (
        *texts(reflector="its name; empty where the recording names none", parameter="as `ltsim effects` lists it"),
        *numbers(".2f", value_um="estimate", sigma_um="standard deviation"),
    ),
)
STATIONS = Table("stations.csv", "adjusted stations", (Column("station", "name", "text"), *COORDINATES[1:]))
SHARPER = 0.975
"""A parameter counts as better known than before if its sigma over its prior sigma is below this: the readings then
removed at least 5 % of the prior variance (0.975 squared is 0.95)."""
SAME = 1e-9
"""`applied` is written only if it differs from the estimate by more than this share of the estimate or of its sigma:
the rounding of double precision, with three digits to spare."""
MOSTLY = 0.9
"""The global test is void if the noise of more than this share of the redundancy was estimated: chi-square over
redundancy is then 1 by construction."""


@dataclass(frozen=True, repr=False)
class Calibration(Result):
    """Instrument parameters with their covariance, and the adjusted network.

    Attributes without a docstring are documented in `CalibrationFile`.
    """

    method: str
    """`network`, `distance`, `distance-l1`; `adjustment` for a network without instrument parameters."""
    construction: Construction
    instruments: tuple[str, ...]
    """Names of the instruments; a single unnamed instrument is called ''."""
    values: Floats
    prior_sigma: Floats
    """(I, p) [SI] each."""
    covariance: Floats
    """Zero for parameters that were held, (I p, I p) [SI]."""
    fit: Fit
    undetermined: tuple[Combination, ...]
    frame: str
    stations: tuple[StationPose, ...]
    targets: tuple[str, ...] = ()
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(T, 3) [m]."""
    target_covariance: Floats = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """(T, 3, 3) [m^2]."""
    criteria: CriteriaEntry | None = None
    """Criteria of the paper; None for a single station, which has no comparison."""
    outliers: tuple[OutlierRow, ...] = ()
    verdict: Verdict | None = None
    """Verdict on the test to trust where tests disagree; None for the distance methods and for results from a file."""
    robust: bool = False
    noise: tuple[NoiseRow, ...] = ()
    reference_values: tuple[ReferenceValueEntry, ...] = ()
    undetermined_targets: tuple[str, ...] = ()
    axes: AxesEntry | None = None
    held: Bools = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    """Parameters that were not estimated but held at their value, (I, p)."""
    prior_rejected: Bools = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    """Parameters whose prior the readings contradict, and whose estimate follows them, (I, p)."""
    history_prior: bool = False
    null_space: Floats = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    """Combinations, in prior sigmas, that a distance method did not estimate: they stay at zero, (k, I p)."""
    correction: Correction | None = None
    applied_values: Floats | None = None
    """Parameters to apply to readings; None where these are the estimates, (I, p) [SI]."""
    effects: tuple[FittedEffectEntry, ...] = ()
    reflectors: tuple[ReflectorEntry, ...] = ()
    constants_included: bool = True
    with_constants: Fit | None = None
    uncertainty_factor: float = 1.0
    air: str = ""
    hidden: tuple[HiddenError, ...] = ()
    notes: tuple[str, ...] = ()
    tests: tuple[Test, ...] = ()
    recording: SourceEntry | None = None
    adjustment: Adjustment | None = field(default=None, repr=False, compare=False)
    """The adjusted network; None for a calibration that was read from a file."""

    def __post_init__(self) -> None:
        for name in ("held", "prior_rejected"):
            if getattr(self, name).shape != self.values.shape:
                object.__setattr__(self, name, np.zeros(self.values.shape, dtype=bool))

    @property
    def prior_used(self) -> Floats:
        """Standard deviations (I, p) [SI] of the prior that the estimates had."""
        return np.where(self.prior_rejected, FREED, 1.0) * self.prior_sigma

    @cached_property
    def sigma(self) -> Floats:
        """Standard deviations (I, p) of the parameters [SI]."""
        return np.sqrt(np.diag(self.covariance)).reshape(self.values.shape)

    @cached_property
    def determined(self) -> tuple[DeterminedEntry, ...]:
        """Combinations of parameters that are determined far better than each of them."""
        bayes = self.method == "network" and not self.history_prior
        return self._of_each(determined, by_plausible_sizes if bayes else None)

    @cached_property
    def harmonics(self) -> tuple[HarmonicEntry, ...]:
        """Every pair of a cosine and a sine coefficient as amplitude and phase."""
        return self._of_each(harmonics)

    def _of_each(
        self,
        entries_of: Callable[[Sequence[Parameter], Floats, Floats], list[EntryT]],
        estimates_of: Callable[[Sequence[Parameter], Floats, Floats, Floats], tuple[Floats, Floats]] | None = None,
    ) -> tuple[EntryT, ...]:
        """Entries of each instrument by its values and covariance, as transformed by `estimates_of` if given."""
        several, size = len(self.instruments) > 1, self.construction.size
        rows: list[EntryT] = []
        parameters = self.construction.parameters
        for i, (name, values) in enumerate(zip(self.instruments, self.values, strict=True)):
            covariance = self.covariance[i * size : (i + 1) * size, i * size : (i + 1) * size]
            if estimates_of is not None:
                values, covariance = estimates_of(parameters, values, covariance, self.prior_used[i])
            entries = entries_of(parameters, values, covariance)
            rows += [entry.model_copy(update={"instrument": name}) if several else entry for entry in entries]
        return tuple(rows)

    @property
    def bias_operator(self) -> Floats:
        """Bias operator (I p, I p), in prior sigmas: the expected error of the estimates is -bias_operator @ truth."""
        if self.method == "network":
            unit = self.prior_sigma.ravel()
            return self.covariance / np.outer(unit, unit)
        return self.null_space.T @ self.null_space

    @property
    def applied(self) -> Floats:
        """Parameters (I, p) [SI] to take out of readings."""
        return self.values if self.correction is None or self.applied_values is None else self.applied_values

    @property
    def noise_estimated(self) -> bool:
        """True if the noise was estimated from the same readings, so that the global test is void."""
        whole = sum(n.redundancy for n in self.noise)
        estimated = sum(n.redundancy for n in self.noise if n.factor_sigma is not None)
        return estimated > MOSTLY * whole

    def _lines(self) -> list[str]:
        fit, count = self.fit, len(self.names)
        test = f"chi2/dof {fit.chi2:.1f}/{fit.dof}"
        test += "" if fit.p_value is None else f", two-sided {format_p(two_sided(fit.p_value))}"
        sharper = int(((self.sigma < SHARPER * self.prior_sigma) & ~self.held).sum())
        lines = [
            f"Calibration ({self.method}, {self.construction.name}): {fit.status}, {test}",
            f"{len(self.stations)} stations and {len(self.targets)} targets in {self.frame}",
        ]
        if count:
            undetermined = f"{len(self.undetermined)} combinations are not determined"
            held = f" ({int(self.held.sum())} held)" if self.held.any() else ""
            lines.append(f"{count} parameters{held}, {sharper} better known than before; {undetermined}")
        lines += [effect.sentence for effect in self.effects]
        if self.outliers:
            lines.append(f"{len(self.outliers)} outlying readings")
        if self.criteria is not None:
            lines.append(f"stations disagree in distances by {self.criteria.distance.words}")
        if self.correction is not None and self.correction.uncorrected_um > 0:
            promised = self.uncertainty_factor == 1.0
            lines += [*([self.correction.line] if promised else []), *self.correction.sentences]
        return [*lines, *uncertainty_sentences(self), *self.notes]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        tables: dict[str, Callable[[], Table]] = {
            "parameters": lambda: PARAMETERS.filled(self.parameters),
            "targets": lambda: targets_table(self.targets, self.points, self.target_covariance),
            "stations": self._stations,
            "outliers": lambda: OUTLIERS.filled(self.outliers),
            "noise": lambda: NOISE.filled(self.noise),
            "reference_values": lambda: REFERENCE_VALUES.filled(self.reference_values),
            "reflectors": lambda: REFLECTORS.filled(
                [entry.reflector, p.name, p.value, p.sigma] for entry in self.reflectors for p in entry.parameters
            ),
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
                prior_rejected=bool(self.prior_rejected[i, k]),
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
        return STATIONS.filled(
            [s.name, *s.position_mm, *sigmas] for s, sigmas in zip(self.stations, sigma, strict=True)
        )

    @cached_property
    def applied_reflectors(self) -> dict[str, Floats]:
        """Parameters (14,) [SI] of `smr-incidence` to take out of readings, by the reflector's name.

        They are taken out with the instrument's parameters, or not at all.
        """
        if not np.any(self.applied):
            return {}
        sizes = {entry.reflector: {p.name: p.value for p in entry.parameters} for entry in self.reflectors}
        return {
            name: np.array([float(values.get(p.name, 0.0)) * p.factor for p in SmrIncidence.parameters])
            for name, values in sizes.items()
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Names (I p) of all parameters, with ``@instrument`` where there are several instruments."""
        return self.construction.names_of(self.instruments)

    def part(self, instrument: int, keep: Ints) -> Calibration:
        """Calibration of one instrument with the parameters `keep` (k,), without a correction."""
        row, at = slice(instrument, instrument + 1), instrument * self.construction.size + keep
        return replace(
            self,
            construction=self.construction.only(keep),
            instruments=self.instruments[row],
            values=self.values[row, keep],
            prior_sigma=self.prior_sigma[row, keep],
            covariance=self.covariance[np.ix_(at, at)],
            held=self.held[row, keep],
            prior_rejected=self.prior_rejected[row, keep],
            correction=None,
        )

    def values_for(self, recording: Recording) -> Floats:
        """Parameters to apply (p,) or, where instruments differ, (n, p) of each pointing of a recording.

        A calibration of one instrument is applied to any recording; one of several needs the same names.

        Raises
        ------
        RecordError
            When the calibration holds no parameters of an instrument of the recording.
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
    placed = np.flatnonzero(np.isfinite(sigma[:, :2]).all(axis=1)).tolist()
    return TARGETS.filled([names[i], *cells[i].tolist()] for i in placed)


def residuals_table(adjustment: Adjustment) -> Table:
    """Table of residuals: a row per observation in use, numbered from 1."""
    recording = adjustment.recording

    def row(i: int, k: int) -> list[object]:
        unit, factor = SHOWN_UNITS[k]
        names = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        size = adjustment.residuals[i, k] / factor, unit, adjustment.redundancy[i, k], adjustment.w[i, k]
        return [i + 1, *names, recording.face[i], recording.repeat[i], OBSERVABLES[k], *size]

    return RESIDUALS.filled(row(i, k) for i, k in np.argwhere(adjustment.problem.use).tolist())
