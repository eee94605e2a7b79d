"""A calibration: what was found out about the instrument, how well, and what was not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.verdict import Verdict
from ltsim.arrays import Bools, Floats
from ltsim.calibration.determined import determined
from ltsim.calibration.schema import DeterminedEntry, FittedEffectEntry, KnownEntry
from ltsim.chances import p_is, two_sided
from ltsim.errors import RecordError
from ltsim.evaluation.criteria import Criteria
from ltsim.model.construction import Construction
from ltsim.notebook import Columns, Shown, by_entry, by_row
from ltsim.recording.recording import Recording
from ltsim.recording.result_file import SourceEntry
from ltsim.units import MICROMETRE, MILLIMETRE

SHARPER = 0.975
"""Ratio of a parameter's sigma to its prior's below which the recording told something: 5 % of the variance."""
ROUND = 20 * MICROMETRE
"""Error of a point above which it is told in whole micrometres."""
MOSTLY = 0.9
"""Share of the redundancy whose noise was estimated, from which chi-square over redundancy is 1 by construction."""


@dataclass(frozen=True)
class Fit:
    """How the readings agree with the model; `p_value` and `sigma0` are None without redundancy.

    `chi2_sigma` is the standard deviation of chi-square to expect where that is not the root of 2 dof.
    """

    chi2: float
    dof: int
    sigma0: float | None
    p_value: float | None
    iterations: int
    status: str
    sentence: str = ""
    chi2_sigma: float | None = None


@dataclass(frozen=True)
class Combination:
    """A combination of parameters that the recording tells little about."""

    coefficients: Mapping[str, float]
    """Of the parameters in units of their prior sigma, normalised; those above 0.1 only."""
    gain: float
    """Share of the prior's uncertainty that the recording removed in the variance: 0 for nothing, 1 for all."""
    cure: str
    """Which further measurement would determine it."""


@dataclass(frozen=True)
class StationPose:
    """Where a station stood, network frame: SI, rotation from instrument to network."""

    name: str
    position: Floats
    quaternion: Floats
    sigma_position: Floats
    sigma_rotation: Floats


@dataclass(frozen=True)
class OutlierRow:
    """A reading that does not belong; `row` counts from 1 as in the table, `size` and `unit` as shown.

    A `gross` one is the largest of a whole pointing that was left out; what was `left_out` had no say in the result.
    """

    row: int
    station: str
    target: str
    observable: str
    size: float
    unit: str
    w: float
    gross: bool = False
    left_out: bool = False


@dataclass(frozen=True)
class NoiseRow:
    """Noise found from the readings of one observable of one instrument, or of the levels.

    `factor` multiplies the stated standard deviation, `factor_sigma` is its own (infinite where the `redundancy` is
    too small to estimate it); `typical` is the median standard deviation that results, in `unit`.
    """

    observable: str
    instrument: str
    factor: float
    factor_sigma: float
    redundancy: float
    typical: float
    unit: str


@dataclass(frozen=True)
class Correction:
    """What is applied of a calibration, and what is expected of it."""

    values: Floats
    """(I, p) [SI]: parameters to take out of readings."""
    prior_scale: float
    """Most likely scale of the prior, in stated sigmas; `plausible_scale` from and to with 95 % on each side."""
    plausible_scale: tuple[float, float]
    uncorrected: float
    corrected: float
    """[m]: expected error (rms) of a new point as those measured, in one set-up's frame."""
    left_out: tuple[str, ...] = ()
    """Parameters that are not applied because targets that were held out are better without."""
    sentences: tuple[str, ...] = ()
    """What a person should know of it."""

    @property
    def line(self) -> str:
        """The expected error of a new point without and with the correction."""
        before, after = (
            f"{x / MICROMETRE:.0f}" if x > ROUND else f"{x / MICROMETRE:.1f}"
            for x in (self.uncorrected, self.corrected)
        )
        return f"expected error of a new point: {before} um as read, {after} um corrected"


@dataclass(frozen=True, repr=False)
class Calibration(Shown):
    """Instrument parameters with their covariance, and the network they were found in."""

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
    """A sentence: the frame of stations and targets."""
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
    """Which test to trust where they disagree; None for the distance methods and for what was read from a file."""
    robust: bool = False
    """Whether readings that do not belong were left out."""
    noise: tuple[NoiseRow, ...] = ()
    """The noise found, where it was estimated from the readings."""
    known: tuple[KnownEntry, ...] = ()
    """Known coordinates, lengths and levels, each tested by the rest."""
    lost_targets: tuple[str, ...] = ()
    """Measured targets that the readings in use do not determine; they have no coordinates."""
    held: Bools = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    """(I, p): parameters that were not estimated but held at their value."""
    informed: bool = False
    """Whether the prior came from earlier calibrations."""
    silent: Floats = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    """(k, I p): combinations, in prior sigmas, that a distance method left at zero."""
    correction: Correction | None = None
    """What is taken out of readings and what that is expected to be worth; without one, the estimates themselves."""
    effects: tuple[FittedEffectEntry, ...] = ()
    """Effects of the catalogue that were estimated beside, on request."""
    notes: tuple[str, ...] = ()
    """What a reader should know of how this came about."""
    recording: SourceEntry | None = None
    """Which recording it was found from; None where a file does not say."""
    adjustment: Adjustment | None = field(default=None, repr=False, compare=False)
    """The adjusted network; None for a calibration that was read from a file."""

    def __post_init__(self) -> None:
        if self.held.shape != self.values.shape:
            object.__setattr__(self, "held", np.zeros(self.values.shape, dtype=bool))

    @cached_property
    def sigma(self) -> Floats:
        """Standard deviations (I, p) of the parameters [SI]."""
        return np.sqrt(np.diag(self.covariance)).reshape(self.values.shape)

    @cached_property
    def determined(self) -> tuple[DeterminedEntry, ...]:
        """Combinations of parameters that are known far better than each of them."""
        several, size = len(self.instruments) > 1, len(self.construction.names)
        found: list[DeterminedEntry] = []
        for i, (name, values) in enumerate(zip(self.instruments, self.values, strict=True)):
            own = slice(i * size, (i + 1) * size)
            entries = determined(self.construction.parameters, values, self.covariance[own, own])
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
        return self.values if self.correction is None else self.correction.values

    @property
    def noise_estimated(self) -> bool:
        """Whether so much of the noise was estimated from the readings that the fit tests nothing any more."""
        whole = sum(n.redundancy for n in self.noise)
        found = sum(n.redundancy for n in self.noise if np.isfinite(n.factor_sigma))
        return found > MOSTLY * whole

    def _lines(self) -> list[str]:
        fit, count = self.fit, len(self.names)
        test = f"chi2/dof {fit.chi2:.1f}/{fit.dof}"
        test += "" if fit.p_value is None else f", two-sided {p_is(two_sided(fit.p_value))}"
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
        if self.correction is not None and self.correction.uncorrected > 0:
            lines += [self.correction.line, *self.correction.sentences]
        return [*lines, *self.notes]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        tables = {
            "parameters": self._parameters,
            "targets": self._targets,
            "stations": self._stations,
            "outliers": lambda: by_entry(OutlierRow, self.outliers),
            "noise": lambda: by_entry(NoiseRow, self.noise),
            "known": lambda: by_row([entry.model_dump() for entry in self.known]),
        }
        return tables if self.names else {name: tables[name] for name in tables if name != "parameters"}

    def _parameters(self) -> Columns:
        parameters = self.construction.parameters * len(self.instruments)
        factor = np.array([p.factor for p in parameters])
        return {
            "parameter": list(self.names),
            "value": (self.values.ravel() / factor).tolist(),
            "sigma": (self.sigma.ravel() / factor).tolist(),
            "unit": [p.unit for p in parameters],
            "prior_sigma": (self.prior_sigma.ravel() / factor).tolist(),
            **({"held": self.held.ravel().tolist()} if self.held.any() else {}),
        }

    def _targets(self) -> Columns:
        sigma = np.sqrt(np.einsum("tii->ti", self.target_covariance))
        return {"target": list(self.targets), **_axes("", self.points), **_axes("sigma_", sigma)}

    def _stations(self) -> Columns:
        position = np.array([s.position for s in self.stations]).reshape(-1, 3)
        sigma = np.array([s.sigma_position for s in self.stations]).reshape(-1, 3)
        return {"station": [s.name for s in self.stations], **_axes("", position), **_axes("sigma_", sigma)}

    @property
    def names(self) -> tuple[str, ...]:
        """Names (I p) of all parameters, with ``@instrument`` where there are several instruments."""
        return self.construction.names_of(self.instruments)

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


def _axes(prefix: str, places: Floats) -> dict[str, list[float]]:
    """Columns [mm] of places (k, 3) [m]."""
    return {f"{prefix}{axis}_mm": column.tolist() for axis, column in zip("xyz", (places / MILLIMETRE).T, strict=True)}
