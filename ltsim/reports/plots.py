"""Figure of each kind of result; the method `plot` of the result returns this figure."""

from functools import singledispatch
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure

from ltsim.acceptance.files import AcceptanceFile
from ltsim.adjustment import Adjustment
from ltsim.adjustment.evaluation.bench import BenchFile
from ltsim.adjustment.evaluation.criteria import Criteria
from ltsim.adjustment.fieldcheck.result import Check
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.history import History
from ltsim.campaigns.calibration_comparison import HeldOutPointErrors
from ltsim.campaigns.recovery import Recovery
from ltsim.campaigns.results import PairedDifferences
from ltsim.core.errors import ModelError
from ltsim.core.results import Result
from ltsim.core.units import MICROMETRE
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.measurands.comparison import Comparison
from ltsim.measurands.uncertainty import Uncertainty
from ltsim.planning.proposals import NextMeasurement
from ltsim.planning.result import Plan, scenario_of_plan
from ltsim.recordings import Recording
from ltsim.reports.figures.floor_plan import floor_plan
from ltsim.reports.figures.parameters import (
    criteria_before_after_figure,
    lines_with_intervals_figure,
    parameter_estimates_figure,
    parameter_history_figure,
    values_with_intervals_figure,
)
from ltsim.reports.figures.points import displacement_figure, error_to_limit_figure, field_check_figure
from ltsim.reports.figures.residuals import residuals_by_covariate_figure, residuals_by_station_figure
from ltsim.reports.residuals import Residuals
from ltsim.reports.sections.diagnosis import finding_figure
from ltsim.reports.sections.simple_sections import uncertainty_budget_figure
from ltsim.reports.verbs import View
from ltsim.reports.workshop_scene import workshop_from_recording, workshop_from_scenario
from ltsim.simulation.injector import DetectionCurve
from ltsim.simulation.scenario import Scenario

MAX_DRAWN_PROPOSALS = 12
"""Largest number of proposed measurements in a figure."""


@singledispatch
def figure_of(result: Result) -> Figure:
    """Figure of a result; raises ModelError for a result without a figure."""
    if type(result).__module__ == "ltsim.campaigns.results":  # not registered: its packages may be missing
        from ltsim.reports.sections.campaign import campaign_figure

        return campaign_figure(cast(Any, result))
    raise ModelError(f"a {type(result).__name__} has no figure")


figure_of.register(Check, field_check_figure)
figure_of.register(Comparison, displacement_figure)
figure_of.register(AcceptanceFile, error_to_limit_figure)
figure_of.register(Scenario, lambda result: floor_plan(workshop_from_scenario(result)))
figure_of.register(Recording, lambda result: floor_plan(workshop_from_recording(result)))
figure_of.register(View, lambda result: floor_plan(result.workshop))
figure_of.register(Adjustment, lambda result: residuals_by_station_figure(Residuals.from_adjustment(result)))
figure_of.register(Uncertainty, uncertainty_budget_figure)


@figure_of.register
def _(result: Calibration) -> Figure:
    if result.instrument_parameter_names:
        return parameter_estimates_figure(result.parameters)
    if result.adjustment is None:
        raise ModelError("a network read from a file has no figure; lt.report writes a page about it")
    return figure_of(result.adjustment)


@figure_of.register
def _(result: Criteria) -> Figure:
    if result.distance.after is None:
        raise ModelError("criteria without a calibration have no figure; call evaluate with a calibration")
    return criteria_before_after_figure(result.table())


@figure_of.register
def _(result: Diagnosis) -> Figure:
    """Figure of a diagnosis: curve or residuals of the first finding; without findings, the residuals."""
    before, after = (Residuals.from_adjustment(a) for a in (result.baseline_adjustment, result.final_adjustment))
    for finding in result.findings[:1]:
        draw = finding_figure(finding, before, after)
        if draw is not None:
            return draw()
    return residuals_by_covariate_figure(after)


@figure_of.register
def _(result: History) -> Figure:
    if not result.determined_parameters:
        raise ModelError("no parameter of these calibrations is determined; there is no figure")
    return parameter_history_figure(result.labels, result.determined_parameters)


@figure_of.register
def _(result: Plan) -> Figure:
    """Figure of a plan: the floor with the chosen layout, as in floor.png of a plan's folder."""
    network = result.network
    return floor_plan(
        workshop_from_scenario(scenario_of_plan(network)), lists_coordinates=True, floor=network.plan_file.floor
    )


@figure_of.register
def _(result: BenchFile) -> Figure:
    """Figure of a bench test: the reflector's range error with two sigmas, and the measured lengths."""
    lines = {
        "as read": [(row.uncorrected_length_um,) * 3 for row in result.range_errors],
        "range error, ± 2 sigma": [
            (row.error_um, row.error_um - 2 * row.sigma_um, row.error_um + 2 * row.sigma_um)
            for row in result.range_errors
        ],
    }
    return lines_with_intervals_figure(
        [row.angle_deg for row in result.range_errors], lines, "incidence [deg]", "range error [um]"
    )


@figure_of.register
def _(result: DetectionCurve) -> Figure:
    """Figure of a detection curve: fractions of detected, located and named injections, with 95 % intervals."""
    lines = {
        name: [(row[name] / row["injections"], row[f"{name}_low"], row[f"{name}_high"]) for row in result.rows]
        for name in ("detections", "placed", "named")
    }
    strengths = [row["noncentrality"] for row in result.rows]
    return lines_with_intervals_figure(strengths, lines, "noncentrality", "share, 95 % interval")


@figure_of.register
def _(result: Recovery) -> Figure:
    """Figure of a recovery: errors of each parameter divided by the declared sigmas, or by their rms without sigmas."""
    trials = result.arrays
    if not trials.available_trial_scores:
        raise ModelError("no trial of this recovery converged; there is no figure")
    error = np.array([trial.estimates - trial.true_values for trial in trials.available_trial_scores])
    has_sigmas = np.isfinite(trials.z_scores).all()
    shown = trials.z_scores if has_sigmas else error / np.sqrt(np.mean(error**2, axis=0))
    ends = np.percentile(shown, [50, 2.5, 97.5], axis=0).T.tolist()
    rows = {name: (middle, low, high) for name, (middle, low, high) in zip(trials.parameter_names, ends, strict=True)}
    label = f"error / {'declared sigma' if has_sigmas else 'its rms'}: median, middle 95 % of the trials"
    return values_with_intervals_figure(
        rows, label, reference_values={"95 % if the sigmas are right": (-1.96, 1.96)} if has_sigmas else {}
    )


@figure_of.register
def _(result: NextMeasurement) -> Figure:
    shares = {p.action: (100 * (1 - p.remaining_sigma_fraction),) * 3 for p in result.proposals[:MAX_DRAWN_PROPOSALS]}
    return values_with_intervals_figure(shares, "sigmas of the instrument's parameters fall by [%]")


@figure_of.register
def _(result: HeldOutPointErrors) -> Figure:
    example = next(iter(result.errors_by_calibration.values()))
    rows = {name: (error.calibrated_rms / MICROMETRE,) * 3 for name, error in result.errors_by_calibration.items()}
    ends = {
        "as read": [example.raw_rms / MICROMETRE],
        "by the true parameters": [example.true_parameters_rms / MICROMETRE],
    }
    return values_with_intervals_figure(rows, "error of a new point [um]", reference_values=ends)


@figure_of.register
def _(result: PairedDifferences) -> Figure:
    rows = {
        ", ".join([e.statistic, *(f"{name} {value}" for name, value in e.shared_levels.items())]): (
            e.difference,
            e.low,
            e.high,
        )
        for e in result.entries
    }
    first = result.entries[0]
    unit = f" [{first.unit}]" if first.unit else ""
    return values_with_intervals_figure(
        rows,
        f"{first.first_name} minus {first.second_name}{unit}, 95 % interval",
        reference_values={"no difference": [0.0]},
    )
