"""How much better than the paper's layout can five stations stand, and how few would do? Checked by simulation."""

from dataclasses import dataclass

import numpy as np

from experiments.common import Made, Options, Row, batches, spread_out, tell, write_figure, write_table
from experiments.criteria import corrections, g_criterion, i_criterion
from ltsim.adjustment import adjust
from ltsim.arrays import Floats
from ltsim.evaluation.clouds import on_points
from ltsim.model.construction import misalignment
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
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import simulate
from ltsim.units import DEGREE, MICROMETRE, MILLIMETRE

BLOCK = 50
MICRO = 1.0 / MICROMETRE


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


def quality(candidate: Candidate) -> Row:
    """Every criterion of a layout, and what calibration is expected to do for the paper's."""
    information = LayoutInformation.of(survey_of(candidate.scenario))
    covariance, rows = information.scaled_covariance, corrections(information)
    expected = Predictor.of(information).expected()
    promised = {}
    for kind in ("distance", "coordinate"):
        before, after, gain = (getattr(expected, f"{kind}_{what}")[0] for what in ("before", "after", "improvement"))
        promised |= {f"{kind}_before_um": before * MICRO, f"{kind}_after_um": after * MICRO}
        promised[f"{kind}_improvement_percent"] = gain
    return {
        **candidate.words,
        "stations": len(candidate.scenario.stations),
        "hours": information.survey.seconds / 3600,
        "D": d_criterion(covariance),
        "A": a_criterion(covariance),
        "E": e_criterion(covariance),
        "G_um": g_criterion(covariance, rows) * MICRO,
        "I_um": i_criterion(covariance, rows) * MICRO,
        "target_rms_um": information.target_rms * MICRO,
        **promised,
    }


def trials_of(scenario: Scenario, seed: int, first: int, count: int) -> tuple[Floats, Floats, int]:
    """Errors (count, p) [SI] of the parameters and (count, T) squared errors of the targets [m^2]; lost trials."""
    parameters, targets, lost = [], [], 0
    for trial in range(first, first + count):
        recording, truth = simulate(scenario, seed + trial)
        solved = adjust(recording, misalignment())
        if not solved.solution.converged or len(recording) < full(scenario) or solved.gross.any():
            lost += 1
            continue
        true = np.array([truth.instrument[name] for name in solved.construction.names])
        parameters.append(solved.state.instrument[0] - true)
        targets.append(((on_points(solved.state.points, truth.points) - truth.points) ** 2).sum(axis=1))
    return np.array(parameters), np.array(targets), lost


def full(scenario: Scenario) -> int:
    """Pointings of a scenario whose reflectors are all seen."""
    return len(scenario.stations) * len(scenario.target_names) * scenario.work.faces * scenario.work.repeats


def check(candidate: Candidate, trials: int, seed: int, jobs: int) -> tuple[list[Row], Row]:
    """Predicted against achieved standard deviation of every parameter; and of all together and the targets."""
    tasks = [(candidate.scenario, seed, number * BLOCK, width) for number, width in batches(trials, BLOCK)]
    parts = spread_out(trials_of, tasks, jobs)
    errors = np.concatenate([p for p, _, _ in parts if len(p)])
    squares = np.concatenate([t for _, t, _ in parts if len(t)])
    information = LayoutInformation.of(survey_of(candidate.scenario))
    predicted, achieved = information.instrument_sigma, np.sqrt(np.mean(errors**2, axis=0))
    ratio, bias = achieved / predicted, errors.mean(axis=0) / predicted
    rows: list[Row] = [
        {**candidate.words, "parameter": p.name, "unit": p.unit, "predicted": predicted[k] / p.factor,
         "achieved": achieved[k] / p.factor, "ratio": ratio[k], "z_mean": bias[k]}
        for k, p in enumerate(information.construction.parameters)
    ]  # fmt: skip
    whitened = np.einsum("ti,ij,tj->t", errors, np.linalg.inv(information.instrument_covariance), errors)
    rms = np.sqrt(squares.mean())
    summary: Row = {
        **candidate.words,
        "trials": len(errors),
        "left_out": sum(n for _, _, n in parts),
        "ratio_rms": np.sqrt(np.mean(ratio**2)),
        "ratio_least": ratio.min(),
        "ratio_largest": ratio.max(),
        "nees_per_parameter": whitened.mean() / len(ratio),
        "target_rms_predicted_um": information.target_rms * MICRO,
        "target_rms_achieved_um": rms * MICRO,
        "target_ratio": rms / information.target_rms,
    }
    return rows, summary


def station_rows(candidate: Candidate) -> list[Row]:
    """Where the tripod goes."""
    survey = survey_of(candidate.scenario)
    places = np.column_stack([survey.position / MILLIMETRE, survey.yaw / DEGREE % 360])
    return [
        {**candidate.words, "station": name, **dict(zip(("x_mm", "y_mm", "z_mm", "yaw_deg"), place, strict=True))}
        for name, place in zip(survey.station_names, places, strict=True)
    ]


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
    layouts, lots, curve, stations, checks, summaries, reasons = [], [], [], [], [], [], {}
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
            stations += station_rows(candidate)
            if cone == config["cones_deg"][0] or candidate.name.startswith("searched"):
                rows, summary = check(candidate, trials, config["seed"], given.jobs)
                checks += rows
                summaries.append(summary)
                tell(str(summary))
            if candidate.name.startswith("searched"):
                write_figure(given.out / f"floor_{cone}_searched.svg", floor_plan(from_scenario(candidate.scenario)))
    for name, table in (
        ("layouts", layouts), ("unsearched", lots), ("tradeoff", curve), ("stations", stations),
        ("parameters", checks), ("check", summaries),
    ):  # fmt: skip
        write_table(given.out / f"{name}.csv", table)
    return Made(config["seed"], trials, {"reasons": reasons})
