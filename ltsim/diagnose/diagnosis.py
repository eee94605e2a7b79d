"""What a diagnosis says: findings, evidence, fit before and after."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from ltsim.adjust.adjustment import Adjustment
from ltsim.arrays import Floats
from ltsim.notebook import Columns, Shown, by_entry
from ltsim.remedies.detectability import MinimalSize
from ltsim.units import FACTOR


@dataclass(frozen=True)
class Estimate:
    """One parameter of a finding, in the unit a person reads it in."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Where:
    """What a finding is confined to; an empty tuple means everything."""

    observables: tuple[str, ...] = ()
    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    covariates: tuple[str, ...] = ()
    instruments: tuple[str, ...] = ()


@dataclass(frozen=True)
class Evidence:
    """How strong: drop of chi2, parameters spent, corrected p-value, posterior probability of the name."""

    chi2_drop: float
    parameters: int
    p_value: float
    probability: float


@dataclass(frozen=True)
class Curve:
    """What a carrier does over the first covariate of a law: value and deviation, in the carrier's unit.

    `at` is in the covariate's SI unit, or that of the recording's own column.
    """

    covariate: str
    unit: str
    at: tuple[float, ...]
    value: tuple[float, ...]
    sigma: tuple[float, ...]


@dataclass(frozen=True)
class Combination:
    """A combination of constants, with their weights, that a recording determines better than each of them."""

    combination: dict[str, float]
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class InstrumentEntry:
    """One instrument: constants, and what the recording determines of them together."""

    name: str
    parameters: tuple[Estimate, ...]
    determined: tuple[Combination, ...]


NOT_EXCLUDED = 0.01
"""Probability above which another effect is stated as an equivalent."""


class Equivalent(NamedTuple):
    """An effect that a recording cannot exclude."""

    effect: str
    probability: float


@dataclass(frozen=True)
class Targets:
    """Coordinates (T, 3) [m] and their covariance (T, 3, 3) [m^2]."""

    points: Floats
    covariance: Floats


@dataclass(frozen=True)
class Finding:
    """One thing left out of the model.

    Attributes
    ----------
    effect : str
        Id of the catalogue, or `unknown`.
    formula : str
        The proposed term of an unknown effect.
    equivalents : tuple of Equivalent
    carrier, driver : str
        What of the model varies and what it follows, where no card names the finding.
    curve : Curve, optional
    """

    effect: str
    known: bool
    where: Where
    parameters: tuple[Estimate, ...]
    evidence: Evidence
    sentence: str
    equivalents: tuple[Equivalent, ...] = ()
    separate_by: str = ""
    formula: str = ""
    carrier: str = ""
    driver: str = ""
    curve: Curve | None = None


@dataclass(frozen=True)
class Fit:
    """Chi2 and normalised error on observations that the fit did not see."""

    chi2: float
    dof: int
    held_out_rms: float


@dataclass(frozen=True)
class Undetectable:
    """An effect that leaves no residual here, how large an error it would hide, and the cure."""

    effect: str
    reason: str
    hides_um: float
    cure: str


@dataclass(frozen=True, repr=False)
class Diagnosis(Shown):
    """The verdict on a recording."""

    verdict: str
    summary: str
    statistic: float
    dof: int
    p_value: float
    search_p_value: float
    findings: tuple[Finding, ...]
    before: Fit
    after: Fit
    undetectable: tuple[Undetectable, ...]
    detectable: tuple[MinimalSize, ...]
    instruments: tuple[InstrumentEntry, ...]
    targets: Targets
    baseline: Adjustment
    adjusted: Adjustment

    def _lines(self) -> list[str]:
        before, after = self.before, self.after
        fits = f"chi2/dof {before.chi2:.0f}/{before.dof}"
        if self.findings:
            fits += f", with the findings modelled {after.chi2:.0f}/{after.dof}"
            fits += f"; held-out error {before.held_out_rms:.2f}, then {after.held_out_rms:.2f}"
        return [f"Diagnosis: {self.verdict}", self.summary, fits]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        return {
            "findings": self._findings,
            "undetectable": lambda: by_entry(Undetectable, self.undetectable),
            "detectable": lambda: by_entry(MinimalSize, self.detectable),
        }

    def _findings(self) -> Columns:
        """One row a parameter of a finding; an unknown effect without parameters has one row."""
        nothing = Estimate("", math.nan, math.nan, "")
        rows = [(finding, p) for finding in self.findings for p in finding.parameters or (nothing,)]
        return {
            "effect": [f.effect for f, _ in rows],
            "stations": [" ".join(f.where.stations) for f, _ in rows],
            "targets": [" ".join(f.where.targets) for f, _ in rows],
            "observables": [" ".join(f.where.observables) for f, _ in rows],
            "probability": [f.evidence.probability for f, _ in rows],
            "parameter": [p.name for _, p in rows],
            "value": [p.value for _, p in rows],
            "sigma": [p.sigma for _, p in rows],
            "unit": [p.unit for _, p in rows],
        }

    def to_json(self) -> dict[str, Any]:
        """The contents of diagnosis.json (format ltsim-diagnosis/1)."""
        from ltsim.diagnose.schema import DiagnosisFile

        told = vars(self) | {
            "global_test": {
                "statistic": self.statistic,
                "dof": self.dof,
                "p_value": self.p_value,
                "search_p_value": self.search_p_value,
            },
            "findings": [{k: v for k, v in vars(f).items() if v not in ("", None)} for f in self.findings],
            "fit": {"before": self.before, "after": self.after},
            "detectable": [
                {"effect": d.effect, "parameter": d.parameter, "size": d.typical / FACTOR[d.unit], "unit": d.unit}
                for d in self.detectable
            ],
        }
        return DiagnosisFile.model_validate(told, from_attributes=True).content()
