"""Figure of each kind of result; the method `plot` of the result returns this figure."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ltsim.core.errors import ModelError
from ltsim.core.units import MICROMETRE
from ltsim.reports import figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ltsim.adjustment import Adjustment
    from ltsim.adjustment.evaluation.bench import BenchFile
    from ltsim.adjustment.evaluation.criteria import Criteria
    from ltsim.calibration.calibration import Calibration
    from ltsim.calibration.history import History
    from ltsim.campaigns.calibration_comparison import HeldOutPointErrors
    from ltsim.campaigns.recovery import Recovery
    from ltsim.campaigns.results import CampaignResults, PairedDifferences
    from ltsim.core.results import Result
    from ltsim.diagnosis.diagnosis import Diagnosis
    from ltsim.measurands.uncertainty import Uncertainty
    from ltsim.planning.proposals import NextMeasurement
    from ltsim.planning.result import Plan
    from ltsim.recordings import Recording
    from ltsim.reports.verbs import View
    from ltsim.simulation.injector import DetectionCurve
    from ltsim.simulation.scenario import Scenario

MAX_DRAWN_PROPOSALS = 12
"""Largest number of proposed measurements in a figure."""
FigureFunction = Callable[[Any], "Figure"]
"""Function that draws the figure of a result."""


def figure_of(result: Result) -> Figure:
    """Figure of a result; raises ModelError for a result without a figure."""
    for kind in type(result).__mro__:
        draw = FIGURE_FUNCTION_BY_CLASS.get(f"{kind.__module__}.{kind.__qualname__}")
        if draw is not None:
            return draw(result)
    raise ModelError(f"a {type(result).__name__} has no figure")


def _scenario_figure(result: Scenario) -> Figure:
    from ltsim.reports.workshop_scene import workshop_from_scenario

    return figures.floor_plan.floor_plan(workshop_from_scenario(result))


def _recording_figure(result: Recording) -> Figure:
    from ltsim.reports.workshop_scene import workshop_from_recording

    return figures.floor_plan.floor_plan(workshop_from_recording(result))


def _view_figure(result: View) -> Figure:
    return figures.floor_plan.floor_plan(result.workshop)


def _adjustment_figure(result: Adjustment) -> Figure:
    from ltsim.reports.residuals import Residuals

    return figures.residuals.residuals_by_station_figure(Residuals.from_adjustment(result))


def _uncertainty_figure(result: Uncertainty) -> Figure:
    from ltsim.reports.sections.simple_sections import uncertainty_budget_figure

    return uncertainty_budget_figure(result)


def _calibration_figure(result: Calibration) -> Figure:
    if result.instrument_parameter_names:
        return figures.parameters.parameter_estimates_figure(result.parameters)
    if result.adjustment is None:
        raise ModelError("a network read from a file has no figure; lt.report writes a page about it")
    return figure_of(result.adjustment)


def _criteria_figure(result: Criteria) -> Figure:
    if result.distance.after is None:
        raise ModelError("criteria without a calibration have no figure; call evaluate with a calibration")
    return figures.parameters.criteria_before_after_figure(result.table())


def _diagnosis_figure(result: Diagnosis) -> Figure:
    """Figure of a diagnosis: curve or residuals of the first finding; without findings, the residuals."""
    from ltsim.reports.residuals import Residuals
    from ltsim.reports.sections.diagnosis import finding_figure

    before, after = (Residuals.from_adjustment(a) for a in (result.baseline_adjustment, result.final_adjustment))
    for finding in result.findings[:1]:
        draw = finding_figure(finding, before, after)
        if draw is not None:
            return draw()
    return figures.residuals.residuals_by_covariate_figure(after)


def _history_figure(result: History) -> Figure:
    if not result.determined_parameters:
        raise ModelError("no parameter of these calibrations is determined; there is no figure")
    return figures.parameters.parameter_history_figure(result.labels, result.determined_parameters)


def _plan_figure(result: Plan) -> Figure:
    """Figure of a plan: the floor with the chosen layout, as in floor.png of a plan's folder."""
    from ltsim.planning.result import scenario_of_plan
    from ltsim.reports.workshop_scene import workshop_from_scenario

    network = result.network
    return figures.floor_plan.floor_plan(
        workshop_from_scenario(scenario_of_plan(network)), lists_coordinates=True, floor=network.plan_file.floor
    )


def _bench_test_figure(result: BenchFile) -> Figure:
    """Figure of a bench test: the reflector's range error with two sigmas, and the measured lengths."""
    lines = {
        "as read": [(row.uncorrected_length_um,) * 3 for row in result.range_errors],
        "range error, ± 2 sigma": [
            (row.error_um, row.error_um - 2 * row.sigma_um, row.error_um + 2 * row.sigma_um)
            for row in result.range_errors
        ],
    }
    return figures.parameters.lines_with_intervals_figure(
        [row.angle_deg for row in result.range_errors], lines, "incidence [deg]", "range error [um]"
    )


def _detection_curve_figure(result: DetectionCurve) -> Figure:
    """Figure of a detection curve: fractions of detected, located and named injections, with 95 % intervals."""
    lines = {
        name: [(row[name] / row["injections"], row[f"{name}_low"], row[f"{name}_high"]) for row in result.rows]
        for name in ("detections", "placed", "named")
    }
    strengths = [row["noncentrality"] for row in result.rows]
    return figures.parameters.lines_with_intervals_figure(strengths, lines, "noncentrality", "share, 95 % interval")


def _recovery_figure(result: Recovery) -> Figure:
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
    return figures.parameters.values_with_intervals_figure(
        rows, label, reference_values={"95 % if the sigmas are right": (-1.96, 1.96)} if has_sigmas else {}
    )


def _next_measurement_figure(result: NextMeasurement) -> Figure:
    shares = {p.action: (100 * (1 - p.remaining_sigma_fraction),) * 3 for p in result.proposals[:MAX_DRAWN_PROPOSALS]}
    return figures.parameters.values_with_intervals_figure(shares, "sigmas of the instrument's parameters fall by [%]")


def _held_out_point_errors_figure(result: HeldOutPointErrors) -> Figure:
    example = next(iter(result.errors_by_calibration.values()))
    rows = {name: (error.calibrated_rms / MICROMETRE,) * 3 for name, error in result.errors_by_calibration.items()}
    ends = {
        "as read": [example.raw_rms / MICROMETRE],
        "by the true parameters": [example.true_parameters_rms / MICROMETRE],
    }
    return figures.parameters.values_with_intervals_figure(rows, "error of a new point [um]", reference_values=ends)


def _paired_differences_figure(result: PairedDifferences) -> Figure:
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
    return figures.parameters.values_with_intervals_figure(
        rows,
        f"{first.first_name} minus {first.second_name}{unit}, 95 % interval",
        reference_values={"no difference": [0.0]},
    )


def _campaign_figure(result: CampaignResults) -> Figure:
    from ltsim.reports.sections.campaign import campaign_figure

    return campaign_figure(result)


FIGURE_FUNCTION_BY_CLASS: dict[str, FigureFunction] = {
    "ltsim.adjustment.fieldcheck.result.Check": figures.points.field_check_figure,
    "ltsim.measurands.comparison.Comparison": figures.points.displacement_figure,
    "ltsim.acceptance.files.AcceptanceFile": figures.points.error_to_limit_figure,
    "ltsim.simulation.scenario.Scenario": _scenario_figure,
    "ltsim.recordings.recording.Recording": _recording_figure,
    "ltsim.reports.verbs.View": _view_figure,
    "ltsim.adjustment.adjustment.Adjustment": _adjustment_figure,
    "ltsim.measurands.uncertainty.Uncertainty": _uncertainty_figure,
    "ltsim.calibration.calibration.Calibration": _calibration_figure,
    "ltsim.adjustment.evaluation.criteria.Criteria": _criteria_figure,
    "ltsim.diagnosis.diagnosis.Diagnosis": _diagnosis_figure,
    "ltsim.calibration.history.History": _history_figure,
    "ltsim.planning.result.Plan": _plan_figure,
    "ltsim.adjustment.evaluation.bench.BenchFile": _bench_test_figure,
    "ltsim.simulation.injector.DetectionCurve": _detection_curve_figure,
    "ltsim.campaigns.recovery.Recovery": _recovery_figure,
    "ltsim.planning.proposals.NextMeasurement": _next_measurement_figure,
    "ltsim.campaigns.calibration_comparison.HeldOutPointErrors": _held_out_point_errors_figure,
    "ltsim.campaigns.results.PairedDifferences": _paired_differences_figure,
    "ltsim.campaigns.results.CampaignResults": _campaign_figure,
}
"""Function that draws the figure of a result, by the module and name of the class of the result.

The classes are named and not imported: one result needs neither the packages nor the import time of the others.
"""
