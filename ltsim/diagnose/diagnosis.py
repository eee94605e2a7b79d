"""What a diagnosis says: findings, evidence, fit before and after."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ltsim.adjust.adjustment import Adjustment
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


@dataclass(frozen=True)
class Evidence:
    """How strong: drop of chi2, parameters spent, corrected p-value, posterior probability of the name."""

    chi2_drop: float
    parameters: int
    p_value: float
    probability: float


@dataclass(frozen=True)
class Finding:
    """One thing left out of the model.

    Attributes
    ----------
    effect : str
        Id of the catalogue, or `unknown`.
    formula : str
        The proposed term of an unknown effect.
    equivalents : tuple of (str, float)
        Other effects that this recording cannot exclude, with their probability.
    """

    effect: str
    known: bool
    where: Where
    parameters: tuple[Estimate, ...]
    evidence: Evidence
    sentence: str
    equivalents: tuple[tuple[str, float], ...] = ()
    separate_by: str = ""
    formula: str = ""


@dataclass(frozen=True)
class Fit:
    """Chi2 and normalised error on observations that the fit did not see."""

    chi2: float
    dof: int
    held_out_rms: float
    held_out: dict[str, float] = field(default_factory=dict)


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
        return {
            "format": "ltsim-diagnosis/1",
            "verdict": self.verdict,
            "summary": self.summary,
            "global_test": {
                "statistic": self.statistic,
                "dof": self.dof,
                "p_value": self.p_value,
                "search_p_value": self.search_p_value,
            },
            "findings": [_finding_json(f) for f in self.findings],
            "fit": {"before": _fit_json(self.before), "after": _fit_json(self.after)},
            "undetectable": [
                {"effect": u.effect, "reason": u.reason, "hides_um": u.hides_um, "cure": u.cure}
                for u in self.undetectable
            ],
            "detectable": [
                {"effect": d.effect, "parameter": d.parameter, "size": d.typical / FACTOR[d.unit], "unit": d.unit}
                for d in self.detectable
            ],
        }


def _fit_json(fit: Fit) -> dict[str, Any]:
    return {
        "chi2": fit.chi2,
        "dof": fit.dof,
        "held_out_rms": fit.held_out_rms,
        "held_out": fit.held_out,
    }


def _finding_json(finding: Finding) -> dict[str, Any]:
    where, evidence = finding.where, finding.evidence
    data: dict[str, Any] = {
        "effect": finding.effect,
        "known": finding.known,
        "sentence": finding.sentence,
        "where": {
            "observables": list(where.observables),
            "stations": list(where.stations),
            "targets": list(where.targets),
            "covariates": list(where.covariates),
        },
        "parameters": [
            {"name": p.name, "value": p.value, "sigma": p.sigma, "unit": p.unit} for p in finding.parameters
        ],
        "evidence": {
            "chi2_drop": evidence.chi2_drop,
            "parameters": evidence.parameters,
            "p_value": evidence.p_value,
            "probability": evidence.probability,
        },
        "equivalents": [{"effect": e, "probability": p} for e, p in finding.equivalents],
        "separate_by": finding.separate_by,
    }
    if finding.formula:
        data["formula"] = finding.formula
    return data
