"""How much better than the paper's layout can five stations stand, and how few would do? Checked by simulation."""

from itertools import product
from pathlib import Path

import numpy as np

import ltsim as lt
from experiments.common import Made, Options, Row, show_table, write_figure
from ltsim.core.arrays import Floats
from ltsim.core.randomness import stream
from ltsim.core.units import MICROMETRE
from ltsim.planning.information import LayoutInformation, Predictor
from ltsim.planning.layout_scenario import with_layout
from ltsim.planning.loading import load_plan
from ltsim.planning.making import make_plan
from ltsim.planning.objective import a_criterion, d_criterion, e_criterion
from ltsim.planning.planner import PlannedNetwork
from ltsim.planning.reasons import fewest
from ltsim.planning.result import Plan
from ltsim.planning.search import LayoutSearcher
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.planning.workshop import objective_of, site_of, survey_of
from ltsim.reports.figures.floor_plan import floor_plan
from ltsim.reports.workshop import from_scenario
from ltsim.simulation.scenario import Scenario, scenario_to_toml

MICRO = 1.0 / MICROMETRE
PROMISED = ("before", "um", MICRO), ("after", "um", MICRO), ("improvement", "percent", 1.0)


def unsearched(file: PlanFile, scenario: Scenario, count: int, seed: int) -> tuple[Floats, Survey]:
    """Values of layouts that are drawn evenly over floor, heights and turns, `count` that keep all rules; the best."""
    site = site_of(file, scenario, stations=file.stations.count, faces=scenario.work.faces)
    search = LayoutSearcher(site, objective_of(file, site.survey))
    corners = np.vstack([search.table(0).position.min(axis=0), search.table(0).position.max(axis=0)])
    rng, values, best = stream(seed, "unsearched"), np.zeros(0), (np.inf, site.survey)
    while len(values) < count:
        position = rng.uniform(*corners, (256, search.stations, 3))
        yaw = rng.uniform(0, 2 * np.pi, position.shape[:2])
        flat = position.reshape(-1, 3)
        visible = site.visible(flat).reshape(*yaw.shape, -1)
        good = np.flatnonzero(site.feasible(position, visible) & site.allowed(flat).reshape(yaw.shape).all(axis=1))
        if not len(good):
            continue
        position, yaw, visible = position[good], yaw[good], visible[good]
        blocks = search.reducer.blocks(position.reshape(-1, 3), yaw.ravel(), visible=visible.reshape(yaw.size, -1))
        reduced = search.reducer.reduce(blocks, np.arange(yaw.size).reshape(yaw.shape))
        found = search.objective.values(reduced, search.construction.n_parameters)
        values = np.concatenate([values, found])[:count]
        at = int(np.argmin(found[: count - len(values) + len(found)]))
        if found[at] < best[0]:
            best = float(found[at]), site.survey.replace(position=position[at], yaw=yaw[at], visible=visible[at])
    return values, best[1]


def candidates_of(plan: PlannedNetwork, drawn: int, best: Survey) -> dict[str, tuple[str, Scenario]]:
    """The paper's own layout, the best of those drawn, the searched one, and the fewest that match the paper's."""
    few, chosen = fewest(plan), plan.chosen.survey
    surveys = {"drawn": (f"best of {drawn} drawn", best)}
    surveys["searched"] = f"searched, {len(chosen.position)} stations", chosen
    if few is not None:
        surveys["fewest"] = f"fewest, {len(few.survey.position)} stations", few.survey
    found = {kind: (name, with_layout(plan.scenario, survey)) for kind, (name, survey) in surveys.items()}
    return {"paper": ("paper, stations 2 to 5 ours", plan.scenario)} | found


def g_criterion(covariance: Floats, regressors: Floats) -> Floats:
    """Largest standard deviation (...) of a prediction.

    Parameters
    ----------
    covariance : (..., p, p) float
    regressors : (m, p) float
        Each row predicts one quantity from the parameters: for an instrument, the correction of a reading
        somewhere in the working volume, as a displacement [m].
    """
    spread = np.einsum("mi,...ij,mj->...m", regressors, covariance, regressors, optimize=True)
    return np.sqrt(spread.max(axis=-1))


def corrections(information: LayoutInformation) -> Floats:
    """(m, p): displacement [m] that a prior sigma of each parameter makes all over the working volume, front face.

    Ranges of 1 to 8 m, all azimuths, elevations from -50 to 65 deg; three rows a place.
    """
    axes = np.arange(1.0, 8.5, 1.0), np.arange(12) * np.pi / 6, np.radians(np.linspace(-50, 65, 8))
    raw = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
    size = information.construction.n_parameters
    _, _, by_value = information.construction.linearised(raw, np.zeros(size))
    return by_value.reshape(-1, size) * information.prior_sigma


def quality(scenario: Scenario) -> Row:
    """Every criterion of a layout, and what calibration is expected to do for the paper's."""
    information = LayoutInformation.of(survey_of(scenario))
    covariance, rows = information.scaled_covariance, corrections(information)
    expected, promised = Predictor.of(information).expected(), {}
    for kind, (what, unit, factor) in product(("distance", "coordinate"), PROMISED):
        promised[f"{kind}_{what}_{unit}"] = factor * getattr(expected, f"{kind}_{what}")[0]
    return {
        "stations": len(scenario.stations),
        "hours": information.survey.seconds / 3600,
        "D": d_criterion(covariance),
        "A": a_criterion(covariance),
        "E": e_criterion(covariance),
        "G_um": g_criterion(covariance, rows) * MICRO,
        "target_rms_um": information.target_rms * MICRO,
        **promised,
    }


def check(scenario: Scenario, folder: Path, trials: int, given: Options) -> tuple[list[Row], Row]:
    """Achieved over predicted standard deviation of every parameter; and of all together and the targets.

    By a campaign whose stations and reflectors stand off their places, each trial elsewhere.
    """
    file = folder.with_suffix(".toml")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(scenario_to_toml(scenario), encoding="utf-8")
    own = {"scenario": str(file), "seed": given.config["seed"], "trials": trials, "geometry": "per-trial"}
    results = lt.campaign(own, out=folder, jobs=given.jobs, force=True)
    information = LayoutInformation.of(survey_of(scenario))
    predicted, found = information.instrument_sigma, results.z_scores()
    rows: list[Row] = [
        {"parameter": p.name, "unit": p.unit, "predicted": sigma / p.si_per_display_unit,
         "ratio": np.hypot(z.mean, z.deviation), "z_mean": z.mean}
        for p, sigma, z in zip(information.construction.parameters, predicted, found, strict=True)
    ]  # fmt: skip
    ratio = np.array([row["ratio"] for row in rows])
    ((squared,),) = results.query("SELECT avg(target_error_um ^ 2) FROM rows")
    summary: Row = {
        "trials": found[0].trials,
        "failed": results.checked()[0].failed,
        "ratio_rms": np.sqrt(np.mean(ratio**2)),
        "ratio_least": ratio.min(),
        "ratio_largest": ratio.max(),
        "target_rms_predicted_um": information.target_rms * MICRO,
        "target_rms_achieved_um": np.sqrt(squared),
        "target_ratio": np.sqrt(squared) / (information.target_rms * MICRO),
    }
    return rows, summary


def lot_row(values: Floats, plan: PlannedNetwork) -> Row:
    """The values D of layouts that were only drawn, beside the paper's and the searched one's."""
    paper = d_criterion(LayoutInformation.of(survey_of(plan.scenario)).scaled_covariance)
    named = dict(zip(("best", "p5", "median", "p95"), np.percentile(values, [0, 5, 50, 95]), strict=True))
    of_ten = values[: len(values) // 10 * 10].reshape(-1, 10).min(axis=1).mean()
    row = {"drawn": len(values)} | named | {"best_of_ten_mean": of_ten, "paper": paper, "searched": plan.chosen.value}
    return row | {"drawn_better_than_paper_percent": 100 * np.mean(values < paper)}


def curve_rows(plan: PlannedNetwork) -> list[Row]:
    """Cost against quality."""
    return [
        {"stations": len(o.survey.position), "faces": len(o.survey.faces), "pointings": o.survey.pointings,
         "hours": o.hours, "D": o.value, "efficient": o.efficient} for o in plan.options
    ]  # fmt: skip


def run(given: Options) -> Made:
    """Search under both readings of the shadow cone, then simulate."""
    config, reasons = given.config, {}
    trials = given.trials or config["trials"]
    file, base = load_plan(given.here / "plan.toml")
    tables: dict[str, list[Row]] = {n: [] for n in ("layouts", "unsearched", "tradeoff", "parameters", "check")}
    for cone in config["cones_deg"]:
        workshop = base.workshop.model_copy(update={"shadow_cone_deg": float(cone)})
        plan = make_plan(file, base.model_copy(update={"workshop": workshop}), jobs=given.jobs)
        content, about = Plan.of(plan), {"cone_deg": cone}
        reasons[str(cone)] = [content.summary, *content.reasons]
        values, best = unsearched(file, plan.scenario, config["unsearched"], config["seed"])
        tables["tradeoff"] += [about | row for row in curve_rows(plan)]
        tables["unsearched"].append(about | lot_row(values, plan))
        for kind, (layout, scenario) in candidates_of(plan, len(values), best).items():
            words = about | {"layout": layout}
            tables["layouts"].append(words | quality(scenario))
            if kind == "searched" or cone == config["cones_deg"][0]:
                rows, summary = check(scenario, given.out / "check" / f"{kind}-{cone}", trials, given)
                tables["parameters"] += [words | row for row in rows]
                tables["check"].append(words | summary)
            if kind == "searched":
                write_figure(given.out / f"floor_{cone}_searched.svg", floor_plan(from_scenario(scenario)))
    for name, table in tables.items():
        show_table(given.out / f"{name}.csv", table)
    return Made(config["seed"], trials, {"reasons": reasons})
