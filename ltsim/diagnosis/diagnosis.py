"""Result of a diagnosis: verdict, findings, and the networks and coordinates behind them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.identification.tests import Test
from ltsim.adjustment.remedies.detectability import MinimalSize
from ltsim.calibration.arrays import residuals_table
from ltsim.core.arrays import Floats
from ltsim.core.results import Columns, Result, Table, by_entry, by_row
from ltsim.core.units import FACTOR
from ltsim.core.values import ValueEquality
from ltsim.diagnosis.schema import (
    BeforeAfter,
    DetectableEntry,
    DiagnosisFile,
    Estimate,
    Finding,
    GlobalTest,
    InstrumentEntry,
    Misfit,
    Undetectable,
)
from ltsim.geometry.polar import wrap
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import ReferenceLengths
from ltsim.recordings.result_file import SourceEntry


@dataclass(frozen=True)
class Targets(ValueEquality):
    """Coordinates (T, 3) [m] and their covariance (T, 3, 3) [m^2]."""

    points: Floats
    covariance: Floats
    spread: Floats
    """Weighted deviations between explanations; part of the covariance, (k, T, 3) [m]."""


@dataclass(frozen=True, repr=False)
class Diagnosis(Result):
    """The verdict on a recording."""

    verdict: str
    summary: str
    statistic: float
    dof: int
    p_value: float
    search_p_value: float
    findings: tuple[Finding, ...]
    before: Misfit
    after: Misfit
    undetectable: tuple[Undetectable, ...]
    detectable: tuple[MinimalSize, ...]
    instruments: tuple[InstrumentEntry, ...]
    targets: Targets
    baseline: Adjustment
    adjusted: Adjustment
    tests: tuple[Test, ...] = ()

    def _lines(self) -> list[str]:
        before, after = self.before, self.after
        fits = f"chi2/dof {before.chi2:.0f}/{before.dof}"
        if self.findings:
            fits += f", with the findings modelled {after.chi2:.0f}/{after.dof}"
            if None not in (before.held_out_rms, after.held_out_rms) and before.held_out_rms != after.held_out_rms:
                fits += f"; held-out error {before.held_out_rms:.2f}, then {after.held_out_rms:.2f}"
        return [f"Diagnosis: {self.verdict}", self.summary, fits]

    def _tables(self) -> Mapping[str, Callable[[], Table | Columns]]:
        return {
            "findings": self._findings,
            "undetectable": lambda: by_row([dict(entry) for entry in self.undetectable]),
            "detectable": lambda: by_entry(MinimalSize, self.detectable),
            "residuals": lambda: residuals_table(self.adjusted),
            "residuals_before": lambda: residuals_table(self.baseline),
        }

    def _findings(self) -> Columns:
        """Rows of findings, one per parameter; an unknown effect without parameters has one row."""
        nothing = Estimate.model_construct(name="", value=math.nan, sigma=math.nan)
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

    def modelled_change(self, recording: Recording) -> Floats:
        """Change (n, 3) [m, rad, rad] of the raw readings that the diagnosis models: effects, corrections and outliers.

        `recording` is the recording that was diagnosed; readings without a modelled change have 0.
        """
        adjusted, state = self.adjusted, self.adjusted.state
        model = adjusted.problem.model
        change = model.effects_shift(model.sightings(state), state.extra)
        change = np.where(adjusted.rejected, change + adjusted.residuals, change)
        corrected = recording.readings - adjusted.recording.readings
        corrected[:, 1:] = wrap(corrected[:, 1:])
        return np.nan_to_num(change + corrected)

    def modelled_length_change(self, recording: Recording) -> Floats:
        """Change (g,) [m] of the reference lengths of the recording that the diagnosis models.

        A length that the diagnosis rejects changes by its difference from the adjusted distance.
        """
        problem, state = self.adjusted.problem, self.adjusted.state
        none = replace(state, extra=np.zeros_like(state.extra))
        shifts = problem.length_residuals(none) - problem.length_residuals(state)
        gauge = problem.gauge
        used = dict(zip(zip(gauge.first.tolist(), gauge.second.tolist(), strict=True), shifts.tolist(), strict=True))
        lengths = ReferenceLengths.of(recording)
        arm = state.points[lengths.second] - state.points[lengths.first]
        differences = lengths.length - np.sqrt((arm**2).sum(axis=1))
        ends = zip(lengths.first.tolist(), lengths.second.tolist(), strict=True)
        return np.array([used.get(pair, gap) for pair, gap in zip(ends, differences.tolist(), strict=True)])

    def variance_factors(self, recording: Recording) -> Floats:
        """Factors (n, 3) on the declared variance of the readings in the model of the diagnosis; 1 if unchanged."""
        return np.nan_to_num((self.adjusted.problem.sigma / recording.sigma()) ** 2, nan=1.0)

    @property
    def coefficients(self) -> int:
        """Number of estimated coefficients: of the effects that shift readings, otherwise of the findings."""
        return self.adjusted.problem.model.effects_size or sum(len(finding.parameters) for finding in self.findings)

    def file(self, recording: Recording | None = None) -> DiagnosisFile:
        """The content of `diagnosis.json`, which names the recording where that is given."""
        return DiagnosisFile(
            verdict=self.verdict,
            summary=self.summary,
            global_test=GlobalTest(
                statistic=self.statistic, dof=self.dof, p_value=self.p_value, search_p_value=self.search_p_value
            ),
            findings=self.findings,
            tests=self.tests,
            fit=BeforeAfter(before=self.before, after=self.after),
            undetectable=self.undetectable,
            detectable=tuple(
                DetectableEntry(effect=d.effect, parameter=d.parameter, size=d.typical / FACTOR[d.unit], unit=d.unit)
                for d in self.detectable
            ),
            instruments=self.instruments,
            recording=None if recording is None else SourceEntry.of(recording),
        )

    def to_json(self) -> dict[str, Any]:
        """The contents of diagnosis.json (format ltsim-diagnosis/1)."""
        return self.file().content()
