"""Result of a diagnosis: verdict and findings, with adjustments and target coordinates."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import PrivateAttr

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.identification.cause_tests import CauseTest
from ltsim.calibration.arrays import NETWORK_FILE_NAMES, residuals_table
from ltsim.calibration.schema import RESIDUALS_TABLE
from ltsim.core.arrays import Floats
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import ModelError
from ltsim.core.results import Table
from ltsim.core.units import MILLIMETRE
from ltsim.diagnosis.schema import (
    BASELINE_RESIDUALS_TABLE,
    DETECTABLE_TABLE,
    DIAGNOSED_TARGETS_TABLE,
    FINDINGS_TABLE,
    FIT_TABLE,
    UNDETECTABLE_TABLE,
    DetectableEntry,
    Finding,
    GlobalTest,
    InstrumentEntry,
    MisfitBeforeAfter,
    ParameterEstimate,
    UndetectableEntry,
)
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.recordings.native import OBSERVATIONS_FILE, SETUP_FILE
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import ReferenceLengths
from ltsim.recordings.result_file import ResultFile


@dataclass(frozen=True)
class AveragedTargets(ValueEquality):
    """Coordinates of T targets and S stations, averaged over the possible causes of the misfit (explanations)."""

    points: Floats
    """Averaged coordinates (T, 3) [m] of T targets."""
    covariance: Floats
    """Covariance (T, 3, 3) [m^2] of the coordinates of each of T targets, with the variance between the possible
    causes."""
    weighted_deviations_by_explanation: Floats
    """Weighted differences (k, T, 3) [m] of the coordinates of T targets from their mean, for each of k possible
    causes.

    The squares of these differences are part of the covariance.
    """
    station_positions: Floats
    """Averaged positions (S, 3) [m] of S stations."""
    weighted_station_deviations_by_explanation: Floats
    """Weighted differences (k, S, 3) [m] of the positions of S stations from their mean, for each of k possible causes.
    """


@dataclass(frozen=True)
class DiagnosisArrays(ValueEquality):
    """Adjustments, target coordinates and arrays of a diagnosis that are not in `diagnosis.json`."""

    targets: AveragedTargets
    """Coordinates of the targets, averaged over the possible causes of the misfit."""
    averaged_minus_refit_reading_change: Floats
    """Change (n, 3) [m, rad, rad] of the readings of n pointings, averaged over the possible causes of the misfit,
    minus their change by the refitted model."""
    variance_factors: Floats
    """Factors (n, 3) on the declared variances of the readings of n pointings, averaged over the noise hypotheses
    (noise other than declared)."""
    baseline_adjustment: Adjustment
    """Ordinary adjustment, without the findings in its model."""
    final_adjustment: Adjustment
    """Adjustment with the findings in its model."""


RECORDING_FOLDER_NAME = "recording"
"""Name of the folder with the recording, within the folder of a diagnosis."""


class Diagnosis(ResultFile):
    """Result of `diagnose`, with the content of `diagnosis.json`."""

    FILE: ClassVar[str] = "diagnosis.json"
    COMPANION_TABLES: ClassVar[Mapping[str, Table]] = {
        "targets": DIAGNOSED_TARGETS_TABLE,
        "residuals": RESIDUALS_TABLE,
        "residuals_before": BASELINE_RESIDUALS_TABLE,
    }
    FURTHER_FILES: ClassVar[tuple[str, ...]] = (
        *NETWORK_FILE_NAMES,
        *(f"{RECORDING_FOLDER_NAME}/{name}" for name in (OBSERVATIONS_FILE, SETUP_FILE)),
    )
    format: Literal["ltsim-diagnosis/1"] = "ltsim-diagnosis/1"
    """Format and version of the file `diagnosis.json`."""
    verdict: str
    """Verdict on the agreement of the recording with the ordinary model: `consistent` or `mismatch`."""
    summary: str
    """Summary of verdict and findings in a few sentences."""
    global_test: GlobalTest
    """Global test of the agreement of the recording with the ordinary model."""
    findings: tuple[Finding, ...] = ()
    """Unmodelled causes that explain the misfit: probable errors of readings first, then changed noise."""
    tests: tuple[CauseTest, ...] = ()
    """Tests as in the results of `adjust` and `check`: simple causes (such as outliers or moved targets) that the
    readings support, and outliers."""
    fit: MisfitBeforeAfter | None = None
    """Misfit of the adjustments without and with the findings in the model."""
    undetectable: tuple[UndetectableEntry, ...] = ()
    """Effects that are not detectable in this network."""
    detectable: tuple[DetectableEntry, ...] = ()
    """Smallest detectable sizes of the effects that are detectable in this network."""
    instruments: tuple[InstrumentEntry, ...] = ()
    """Instrument constants of each instrument, estimated in the ordinary calibration."""
    _arrays: DiagnosisArrays | None = PrivateAttr(None)

    @classmethod
    def from_arrays(cls, arrays: DiagnosisArrays, **fields: Any) -> Self:
        """Diagnosis with its adjustments and coordinates; `fields` are the fields of `diagnosis.json`."""
        result = cls(**fields)
        result._arrays = arrays
        return result

    @property
    def arrays(self) -> DiagnosisArrays:
        """Adjustments and coordinates of the diagnosis; raises ModelError for a diagnosis that was read from a file."""
        if self._arrays is None:
            raise ModelError("a diagnosis read from a file has no adjustments; call lt.diagnose with the recording")
        return self._arrays

    @property
    def targets(self) -> AveragedTargets:
        """Target coordinates with the findings in the model, averaged over the possible causes of the misfit."""
        return self.arrays.targets

    @property
    def baseline_adjustment(self) -> Adjustment:
        """Ordinary adjustment, without the findings in its model."""
        return self.arrays.baseline_adjustment

    @property
    def final_adjustment(self) -> Adjustment:
        """Adjustment with the findings in its model."""
        return self.arrays.final_adjustment

    def _summary_lines(self) -> list[str]:
        """Lines for a terminal: verdict, summary, and chi-square without and with the findings."""
        lines = [f"Diagnosis: {self.verdict}", self.summary]
        if self.fit is None:
            return lines
        before, after = self.fit.before, self.fit.after
        phrase = f"chi2/dof {before.chi2:.0f}/{before.dof}"
        if self.findings:
            phrase += f", with the findings in the model {after.chi2:.0f}/{after.dof}"
            if None not in (before.held_out_rms, after.held_out_rms) and before.held_out_rms != after.held_out_rms:
                phrase += f"; held-out error {before.held_out_rms:.2f} sigma, then {after.held_out_rms:.2f} sigma"
        return [*lines, phrase]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        """Functions that build the data tables of the diagnosis, by name of the table."""
        return {
            "findings": self._findings_table,
            "targets": self._coordinates_table,
            "fit": self._fit_table,
            "undetectable": lambda: UNDETECTABLE_TABLE.with_rows(self.undetectable),
            "detectable": lambda: DETECTABLE_TABLE.with_rows(self.detectable),
            "residuals": lambda: residuals_table(self.final_adjustment),
            "residuals_before": lambda: residuals_table(self.baseline_adjustment),
        }

    def _coordinates_table(self) -> Table:
        """Data table of the targets, with the difference of each coordinate from the ordinary adjustment."""
        sigma = np.sqrt(np.einsum("tii->ti", self.targets.covariance))
        change = self.targets.points - self.baseline_adjustment.state.target_points
        coordinate_rows = np.concatenate([self.targets.points, sigma, change], axis=1) / MILLIMETRE
        named = zip(self.final_adjustment.recording.targets, coordinate_rows, strict=True)
        return DIAGNOSED_TARGETS_TABLE.with_rows([name, *row] for name, row in named)

    def _fit_table(self) -> Table:
        """Data table of the misfit without and with the findings in the model; without rows if `fit` is None."""
        both = () if self.fit is None else (("without the findings", self.fit.before), ("with them", self.fit.after))
        return FIT_TABLE.with_rows(
            [words, f.chi2, f.dof, f.chi2 / f.dof if f.dof > 0 else None, f.held_out_rms] for words, f in both
        )

    def _findings_table(self) -> Table:
        """Data table of the findings with one row per parameter; a finding without parameters has one row."""
        nothing = ParameterEstimate.model_construct(name="", value=math.nan, sigma=math.nan)
        return FINDINGS_TABLE.with_rows(
            [
                f.effect,
                *(" ".join(names) for names in (f.where.stations, f.where.targets, f.where.observables)),
                *(f.evidence.probability, p.name, p.value, p.sigma, p.unit),
            ]
            for f in self.findings
            for p in f.parameters or (nothing,)
        )

    def modelled_reading_change(self, recording: Recording) -> Floats:
        """Change (n, 3) [m, rad, rad] of the readings of n pointings by modelled effects, corrections and outliers.

        Effects enter with their posterior mean over sizes and possible causes, as in the coordinates. `recording` is
        the recording that was diagnosed. The change is 0 for readings without effect, correction or outlier.
        """
        adjusted, state = self.final_adjustment, self.final_adjustment.state
        model = adjusted.problem.model
        change = (
            model.change_by_effects(model.sightings(state), state.extra_parameters)
            + self.arrays.averaged_minus_refit_reading_change
        )
        change = np.where(adjusted.is_rejected_reading, change + adjusted.residuals, change)
        corrected = recording.readings - adjusted.recording.readings
        corrected[:, 1:] = wrap_angle(corrected[:, 1:])
        return np.nan_to_num(change + corrected)

    def modelled_length_change(self, recording: Recording) -> Floats:
        """Change (g,) [m] of the g reference lengths of `recording` by the modelled effects.

        If the diagnosis rejects a length, the change is the difference of the length from the adjusted distance.
        """
        problem, state = self.final_adjustment.problem, self.final_adjustment.state
        none = replace(state, extra_parameters=np.zeros_like(state.extra_parameters))
        shifts = problem.length_residuals(none) - problem.length_residuals(state)
        gauge = problem.gauge_rows
        used = dict(
            zip(
                zip(gauge.first_targets.tolist(), gauge.second_targets.tolist(), strict=True),
                shifts.tolist(),
                strict=True,
            )
        )
        lengths = ReferenceLengths.from_recording(recording)
        arm = state.target_points[lengths.second_targets] - state.target_points[lengths.first_targets]
        differences = lengths.lengths - np.sqrt((arm**2).sum(axis=1))
        ends = zip(lengths.first_targets.tolist(), lengths.second_targets.tolist(), strict=True)
        return np.array([used.get(pair, gap) for pair, gap in zip(ends, differences.tolist(), strict=True)])

    @property
    def variance_factors(self) -> Floats:
        """Posterior means (n, 3) of factors on the declared variances of the readings of n pointings.

        A factor of 1 means that the noise is as declared.
        """
        return self.arrays.variance_factors

    @property
    def n_effect_coefficients(self) -> int:
        """Number of estimated coefficients of all effects in the model of the diagnosis that shift readings.

        An empirical law (function of covariates) changes w components, such as azimuth and elevation, in a fixed ratio;
        if this ratio is estimated, it counts as w - 1 coefficients. Without effects that shift readings, the number of
        parameters of the findings is counted.
        """
        model = self.final_adjustment.problem.model
        ratios = sum(
            len(e.component_ratio) - 1 for e in model.effects if isinstance(e, EmpiricalLaw) and e.component_ratio
        )
        return model.n_effect_parameters + ratios or sum(len(finding.parameters) for finding in self.findings)
