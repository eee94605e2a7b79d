"""Layouts of five and fewer stations from a search, compared with the paper's layout and checked by simulation."""

from itertools import product
from pathlib import Path

import numpy as np

import ltsim as lt
from experiments.common import Options, Row, RunRecord, show_table, write_figure
from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.core.units import MICROMETRE
from ltsim.planning.expected_precision import DisagreementPredictor, ExpectedPrecision
from ltsim.planning.loading import load_plan
from ltsim.planning.objective import a_criterion, d_criterion, e_criterion
from ltsim.planning.plan_search import make_plan
from ltsim.planning.planner import PlannedNetwork
from ltsim.planning.reasons import fewest_stations_not_worse_than_scenario
from ltsim.planning.result import Plan, scenario_with_layout
from ltsim.planning.search import LayoutSearcher
from ltsim.planning.search_inputs import layout_objective, make_search_space, planned_survey
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import PlannedSurvey
from ltsim.reports.figures.floor_plan import floor_plan
from ltsim.reports.workshop_scene import workshop_from_scenario
from ltsim.simulation.scenario import Scenario, scenario_to_toml

MICRO = 1.0 / MICROMETRE
EXPECTED_COLUMNS = (
    ("before", "disagreement_before", "um", MICRO),
    ("after", "disagreement_after", "um", MICRO),
    ("improvement", "improvement", "percent", 1.0),
)


def random_layouts(file: PlanFile, scenario: Scenario, count: int, seed: int) -> tuple[Floats, PlannedSurvey]:
    """Objective values of `count` feasible layouts drawn at random, and the best of these layouts.

    The draws are uniform over floor, heights and orientations.
    """
    site = make_search_space(file, scenario, n_stations=file.stations.count, n_faces=scenario.work.faces)
    search = LayoutSearcher(site, layout_objective(file, site.survey))
    corners = np.vstack(
        [
            search.normal_blocks_of_grid(0).setup_positions.min(axis=0),
            search.normal_blocks_of_grid(0).setup_positions.max(axis=0),
        ]
    )
    rng, values, best = random_stream(seed, "unsearched"), np.zeros(0), (np.inf, site.survey)
    while len(values) < count:
        position = rng.uniform(*corners, (256, search.n_stations, 3))
        yaw = rng.uniform(0, 2 * np.pi, position.shape[:2])
        flat = position.reshape(-1, 3)
        visible = site.is_visible(flat).reshape(*yaw.shape, -1)
        good = np.flatnonzero(
            site.is_feasible(position, visible) & site.is_allowed(flat).reshape(yaw.shape).all(axis=1)
        )
        if not len(good):
            continue
        position, yaw, visible = position[good], yaw[good], visible[good]
        blocks = search.scorer.normal_blocks(
            position.reshape(-1, 3), yaw.ravel(), is_visible=visible.reshape(yaw.size, -1)
        )
        reduced = search.scorer.evaluate_layouts(blocks, np.arange(yaw.size).reshape(yaw.shape))
        criteria = search.objective.objective_values(reduced, search.construction.n_parameters)
        values = np.concatenate([values, criteria])[:count]
        at = int(np.argmin(criteria[: count - len(values) + len(criteria)]))
        if criteria[at] < best[0]:
            best = (
                float(criteria[at]),
                site.survey.replace(station_positions=position[at], station_yaws=yaw[at], is_visible=visible[at]),
            )
    return values, best[1]


def candidates_of(plan: PlannedNetwork, drawn: int, best: PlannedSurvey) -> dict[str, tuple[str, Scenario]]:
    """Layouts to compare, by kind.

    The layouts are the paper's, the best random one, the result of the search, and the one with the fewest stations
    that is as good as the paper's.
    """
    few, chosen = fewest_stations_not_worse_than_scenario(plan), plan.layout.survey
    surveys = {"drawn": (f"best of {drawn} drawn", best)}
    surveys["searched"] = f"searched, {len(chosen.station_positions)} stations", chosen
    if few is not None:
        surveys["fewest"] = f"fewest, {len(few.survey.station_positions)} stations", few.survey
    layouts = {kind: (name, scenario_with_layout(plan.scenario, survey)) for kind, (name, survey) in surveys.items()}
    return {"paper": ("paper, stations 2 to 5 ours", plan.scenario)} | layouts


def g_criterion(covariance: Floats, regressors: Floats) -> Floats:
    """Largest standard deviation (...) of the predictions (G criterion).

    Parameters
    ----------
    covariance : (..., p, p) float
    regressors : (m, p) float
        Each row predicts one quantity from the parameters: for an instrument, the correction of a reading
        somewhere in the working volume, as a displacement [m].
    """
    spread = np.einsum("mi,...ij,mj->...m", regressors, covariance, regressors, optimize=True)
    return np.sqrt(spread.max(axis=-1))


def corrections(information: ExpectedPrecision) -> Floats:
    """(m, p) [m] Displacement by one prior sigma of each parameter, over the whole working volume, front face.

    The points have ranges of 1 to 8 m, all azimuths, and elevations from -50 to 65 deg; each point has three rows.
    """
    axes = np.arange(1.0, 8.5, 1.0), np.arange(12) * np.pi / 6, np.radians(np.linspace(-50, 65, 8))
    raw = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
    size = information.construction.n_parameters
    _, _, by_value = information.construction.linearise(raw, np.zeros(size))
    return by_value.reshape(-1, size) * information.prior_sigma


def quality(scenario: Scenario) -> Row:
    """All criteria of a layout, and the expected effect of calibration on the criteria of the paper."""
    information = ExpectedPrecision.from_survey(planned_survey(scenario))
    covariance, rows = information.covariance_in_prior_sigmas, corrections(information)
    expected, promised = DisagreementPredictor.from_expected_precision(information).expected_disagreement(), {}
    for kind, (what, attribute, unit, factor) in product(("distance", "coordinate"), EXPECTED_COLUMNS):
        promised[f"{kind}_{what}_{unit}"] = factor * getattr(expected, f"{kind}_{attribute}")[0]
    return {
        "stations": len(scenario.stations),
        "hours": information.survey.duration / 3600,
        "D": d_criterion(covariance),
        "A": a_criterion(covariance),
        "E": e_criterion(covariance),
        "G_um": g_criterion(covariance, rows) * MICRO,
        "target_rms_um": information.target_rms * MICRO,
        **promised,
    }


def check(scenario: Scenario, folder: Path, trials: int, options: Options) -> tuple[list[Row], Row]:
    """Ratios of simulated to predicted standard deviations: a row for each parameter, and a summary with the targets.

    The simulated campaign places stations and reflectors in each trial with new random deviations.
    """
    file = folder.with_suffix(".toml")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(scenario_to_toml(scenario), encoding="utf-8")
    campaign = {"scenario": str(file), "seed": options.config["seed"], "trials": trials, "geometry": "per-trial"}
    results = lt.campaign(campaign, out=folder, jobs=options.jobs, force=True)
    information = ExpectedPrecision.from_survey(planned_survey(scenario))
    predicted, z_scores = information.instrument_sigmas, results.z_score_summaries()
    rows: list[Row] = [
        {"parameter": p.name, "unit": p.unit, "predicted": sigma / p.si_per_display_unit,
         "ratio": np.hypot(z.mean, z.standard_deviation), "z_mean": z.mean}
        for p, sigma, z in zip(information.construction.parameters, predicted, z_scores, strict=True)
    ]  # fmt: skip
    ratio = np.array([row["ratio"] for row in rows])
    ((squared,),) = results.query("SELECT avg(target_error_um ^ 2) FROM rows")
    summary: Row = {
        "trials": z_scores[0].trials,
        "failed": results.solver_comparisons()[0].failed_trials,
        "ratio_rms": np.sqrt(np.mean(ratio**2)),
        "ratio_least": ratio.min(),
        "ratio_largest": ratio.max(),
        "target_rms_predicted_um": information.target_rms * MICRO,
        "target_rms_achieved_um": np.sqrt(squared),
        "target_ratio": np.sqrt(squared) / (information.target_rms * MICRO),
    }
    return rows, summary


def lot_row(values: Floats, plan: PlannedNetwork) -> Row:
    """Quantiles of the D criterion of random layouts, and its values for the paper's layout and the search result."""
    paper = d_criterion(ExpectedPrecision.from_survey(planned_survey(plan.scenario)).covariance_in_prior_sigmas)
    quantiles = dict(zip(("best", "p5", "median", "p95"), np.percentile(values, [0, 5, 50, 95]), strict=True))
    of_ten = values[: len(values) // 10 * 10].reshape(-1, 10).min(axis=1).mean()
    row = (
        {"drawn": len(values)}
        | quantiles
        | {"best_of_ten_mean": of_ten, "paper": paper, "searched": plan.layout.objective_value}
    )
    return row | {"drawn_better_than_paper_percent": 100 * np.mean(values < paper)}


def curve_rows(plan: PlannedNetwork) -> list[Row]:
    """Row for each point of the trade-off between cost (stations, pointings, hours) and D criterion."""
    return [
        {"stations": len(o.survey.station_positions), "faces": len(o.survey.faces), "pointings": o.survey.n_pointings,
         "hours": o.hours, "D": o.objective_value, "efficient": o.is_efficient} for o in plan.tradeoff_points
    ]  # fmt: skip


def run(options: Options) -> RunRecord:
    """Search layouts under both interpretations of the shadow cone, then check the layouts by simulation."""
    config, reasons = options.config, {}
    trials = options.trials or config["trials"]
    file, base = load_plan(options.folder / "plan.toml")
    tables: dict[str, list[Row]] = {n: [] for n in ("layouts", "unsearched", "tradeoff", "parameters", "check")}
    for cone in config["cones_deg"]:
        workshop = base.workshop.model_copy(update={"shadow_cone_deg": float(cone)})
        plan = make_plan(file, base.model_copy(update={"workshop": workshop}), jobs=options.jobs)
        content, about = Plan.from_network(plan), {"cone_deg": cone}
        reasons[str(cone)] = [content.summary, *content.reasons]
        values, best = random_layouts(file, plan.scenario, config["unsearched"], config["seed"])
        tables["tradeoff"] += [about | row for row in curve_rows(plan)]
        tables["unsearched"].append(about | lot_row(values, plan))
        for kind, (layout, scenario) in candidates_of(plan, len(values), best).items():
            labels = about | {"layout": layout}
            tables["layouts"].append(labels | quality(scenario))
            if kind == "searched" or cone == config["cones_deg"][0]:
                rows, summary = check(scenario, options.out / "check" / f"{kind}-{cone}", trials, options)
                tables["parameters"] += [labels | row for row in rows]
                tables["check"].append(labels | summary)
            if kind == "searched":
                write_figure(options.out / f"floor_{cone}_searched.svg", floor_plan(workshop_from_scenario(scenario)))
    for name, table in tables.items():
        show_table(options.out / f"{name}.csv", table)
    return RunRecord(config["seed"], trials, {"reasons": reasons})
