"""How much better than the paper's layout can five stations stand, and how few would do? Checked by simulation."""

from dataclasses import dataclass
from itertools import product

import numpy as np

import ltsim as lt
from experiments.common import Made, Options, Row, tell, write_figure, write_table
from ltsim.arrays import Floats
from ltsim.pages.figures.floor_plan import floor_plan
from ltsim.pages.workshop import from_scenario
from ltsim.planning.files import plan_file, with_layout
from ltsim.planning.improvement import Predictor
from ltsim.planning.information import LayoutInformation
from ltsim.planning.loading import load_plan
from ltsim.planning.making import make_plan
from ltsim.planning.objective import a_criterion, d_criterion, e_criterion
from ltsim.planning.planner import Plan
from ltsim.planning.reasons import fewest
from ltsim.planning.search import Searcher
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.planning.workshop import objective_of, site_of, survey_of
from ltsim.randomness import stream
from ltsim.simulation.scenario import Scenario, scenario_to_toml
from ltsim.units import MICROMETRE

MICRO = 1.0 / MICROMETRE
PROMISED = ("before", "um", MICRO), ("after", "um", MICRO), ("improvement", "percent", 1.0)


@dataclass(frozen=True)
class Candidate:
    """A layout under test."""

    name: str
    cone_deg: float
    scenario: Scenario

    @property
    def words(self) -> Row:
        """What its rows begin with."""
        return {"cone_deg": self.cone_deg, "layout": self.name}


@dataclass(frozen=True)
class Drawn:
    """Layouts drawn under the rules of a plan and not searched: their values, and the survey of the best."""

    values: Floats
    best: Survey


def unsearched(file: PlanFile, scenario: Scenario, count: int, seed: int) -> Drawn:
    """Layouts of the plan's stations drawn evenly over the floor, heights and turns, until `count` keep all rules."""
    site = site_of(file, scenario, stations=file.stations.count, faces=scenario.work.faces)
    search = Searcher(site, objective_of(file, site.survey))
    corners = np.vstack([search.table(0).position.min(axis=0), search.table(0).position.max(axis=0)])
    rng, values, best = stream(seed, "unsearched"), np.zeros(0), (np.inf, site.survey)
    while len(values) < count:
        position = rng.uniform(*corners, (256, search.stations, 3))
        yaw = rng.uniform(0, 2 * np.pi, position.shape[:2])
        flat = position.reshape(-1, 3)
        seen = site.seen(flat).reshape(*yaw.shape, -1)
        good = np.flatnonzero(site.joined(position, seen) & site.allowed(flat).reshape(yaw.shape).all(axis=1))
        if not len(good):
            continue
        position, yaw, seen = position[good], yaw[good], seen[good]
        blocks = search.reducer.blocks(position.reshape(-1, 3), yaw.ravel(), seen=seen.reshape(yaw.size, -1))
        reduced = search.reducer.reduce(blocks, np.arange(yaw.size).reshape(yaw.shape))
        found = search.objective.values(reduced, search.construction.size)
        values = np.concatenate([values, found])[:count]
        at = int(np.argmin(found[: count - len(values) + len(found)]))
        if found[at] < best[0]:
            best = float(found[at]), site.survey.replace(position=position[at], yaw=yaw[at], seen=seen[at])
    return Drawn(values, best[1])


def candidates_of(plan: Plan, cone: float, drawn: Drawn) -> list[Candidate]:
    """The paper's own layout, the best of those drawn, the searched one, and the fewest that match the paper's."""
    few = fewest(plan)
    found = [
        Candidate("paper, stations 2 to 5 ours", cone, plan.scenario),
        Candidate(f"best of {len(drawn.values)} drawn", cone, with_layout(plan.scenario, drawn.best)),
        Candidate(f"searched, {len(plan.chosen.survey.position)} stations", cone,
                  with_layout(plan.scenario, plan.chosen.survey)),
    ]  # fmt: skip
    if few is not None:
        name = f"fewest, {len(few.survey.position)} stations"
        found.append(Candidate(name, cone, with_layout(plan.scenario, few.survey)))
    return found


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
    size = information.construction.size
    _, _, by_value = information.construction.linearised(raw, np.zeros(size))
    return by_value.reshape(-1, size) * information.prior_sigma


def quality(candidate: Candidate) -> Row:
    """Every criterion of a layout, and what calibration is expected to do for the paper's."""
    information = LayoutInformation.of(survey_of(candidate.scenario))
    covariance, rows = information.scaled_covariance, corrections(information)
    expected, promised = Predictor.of(information).expected(), {}
    for kind, (what, unit, factor) in product(("distance", "coordinate"), PROMISED):
        promised[f"{kind}_{what}_{unit}"] = factor * getattr(expected, f"{kind}_{what}")[0]
    return {
        **candidate.words,
        "stations": len(candidate.scenario.stations),
        "hours": information.survey.seconds / 3600,
        "D": d_criterion(covariance),
        "A": a_criterion(covariance),
        "E": e_criterion(covariance),
        "G_um": g_criterion(covariance, rows) * MICRO,
        "target_rms_um": information.target_rms * MICRO,
        **promised,
    }


def check(candidate: Candidate, trials: int, given: Options) -> tuple[list[Row], Row]:
    """Achieved over predicted standard deviation of every parameter; and of all together and the targets.

    By a campaign whose stations and reflectors stand off their places, each trial elsewhere.
    """
    folder = given.out / "check" / f"{candidate.name}-{candidate.cone_deg:g}"
    file = folder.with_suffix(".toml")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(scenario_to_toml(candidate.scenario), encoding="utf-8")
    own = {"scenario": str(file), "seed": given.config["seed"], "trials": trials, "geometry": "per-trial"}
    results = lt.campaign(own, out=folder, jobs=given.jobs, force=True)
    information = LayoutInformation.of(survey_of(candidate.scenario))
    predicted, found = information.instrument_sigma, results.z_scores()
    rows: list[Row] = [
        {**candidate.words, "parameter": p.name, "unit": p.unit, "predicted": sigma / p.factor,
         "ratio": np.hypot(z.mean, z.deviation), "z_mean": z.mean}
        for p, sigma, z in zip(information.construction.parameters, predicted, found, strict=True)
    ]  # fmt: skip
    ratio = np.array([row["ratio"] for row in rows])
    ((squared,),) = results.query("SELECT avg(target_error_um ^ 2) FROM rows")
    summary: Row = {
        **candidate.words,
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


def lot_row(cone: float, drawn: Drawn, plan: Plan) -> Row:
    """The values D of layouts that were only drawn, beside the paper's and the searched one's."""
    paper = d_criterion(LayoutInformation.of(survey_of(plan.scenario)).scaled_covariance)
    named = dict(zip(("best", "p5", "median", "p95"), np.percentile(drawn.values, [0, 5, 50, 95]), strict=True))
    of_ten = drawn.values[: len(drawn.values) // 10 * 10].reshape(-1, 10).min(axis=1).mean()
    row = named | {"best_of_ten_mean": of_ten, "paper": paper, "searched": plan.chosen.value}
    better = {"drawn_better_than_paper_percent": 100 * np.mean(drawn.values < paper)}
    return {"cone_deg": cone, "drawn": len(drawn.values)} | row | better


def curve_rows(plan: Plan, cone: float) -> list[Row]:
    """Cost against quality."""
    return [
        {"cone_deg": cone, "stations": len(o.survey.position), "faces": len(o.survey.faces),
         "pointings": o.survey.pointings, "hours": o.hours, "D": o.value, "efficient": o.efficient}
        for o in plan.options
    ]  # fmt: skip


def run(given: Options) -> Made:
    """Search under both readings of the shadow cone, then simulate."""
    config = given.config
    trials = given.trials or config["trials"]
    file, base = load_plan(given.here / "plan.toml")
    layouts, lots, curve, checks, summaries, reasons = [], [], [], [], [], {}
    for cone in config["cones_deg"]:
        workshop = base.workshop.model_copy(update={"shadow_cone_deg": float(cone)})
        plan = make_plan(file, base.model_copy(update={"workshop": workshop}), jobs=given.jobs)
        content = plan_file(plan)
        reasons[str(cone)] = [content.summary, *content.reasons]
        curve += curve_rows(plan, cone)
        drawn = unsearched(file, plan.scenario, config["unsearched"], config["seed"])
        lots.append(lot_row(cone, drawn, plan))
        tell(str(lots[-1]))
        for candidate in candidates_of(plan, cone, drawn):
            layouts.append(quality(candidate))
            if cone == config["cones_deg"][0] or candidate.name.startswith("searched"):
                rows, summary = check(candidate, trials, given)
                checks += rows
                summaries.append(summary)
                tell(str(summary))
            if candidate.name.startswith("searched"):
                write_figure(given.out / f"floor_{cone}_searched.svg", floor_plan(from_scenario(candidate.scenario)))
    for name, table in (
        ("layouts", layouts), ("unsearched", lots), ("tradeoff", curve), ("parameters", checks),
        ("check", summaries),
    ):  # fmt: skip
        write_table(given.out / f"{name}.csv", table)
    return Made(config["seed"], trials, {"reasons": reasons})
