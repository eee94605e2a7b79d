"""Effect of a machine on the floor on visibility, accuracy and the planned layout."""

from experiments.common import Options, Row, RunRecord, show_table, write_figure, write_table
from ltsim.core.units import MICROMETRE
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.loading import load_plan
from ltsim.planning.objective import d_criterion
from ltsim.planning.plan_search import make_plan
from ltsim.planning.planner import PlannedNetwork
from ltsim.planning.result import Plan, scenario_of_plan
from ltsim.planning.search_inputs import planned_survey
from ltsim.planning.survey import PlannedSurvey
from ltsim.reports.figures.floor_plan import floor_plan
from ltsim.reports.workshop_scene import workshop_from_scenario
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.sections import Obstacle
from ltsim.simulation.workshop import make_visibility

MACHINE = Obstacle(name="machine", box_mm=(800, 500, 1100), position_mm=(1600, 700, 0), yaw_deg=20)


def with_machine(scenario: Scenario) -> Scenario:
    """Scenario with the machine as an obstacle on the floor."""
    return scenario.model_copy(update={"workshop": scenario.workshop.model_copy(update={"obstacles": (MACHINE,)})})


def row(name: str, scenario: Scenario, survey: PlannedSurvey) -> Row:
    """Blocked sights, D criterion and target errors of a layout in a workshop."""
    information = ExpectedPrecision.from_survey(survey)
    return {
        "layout": name,
        "sights_lost": int((~survey.is_visible).sum()),
        "D": round(float(d_criterion(information.covariance_in_prior_sigmas)), 4),
        "target_rms_um": round(information.target_rms / MICROMETRE, 2),
        "largest_target_um": round(float(information.target_point_errors.max()) / MICROMETRE, 2),
    }


def run(options: Options) -> RunRecord:
    """Evaluate the paper's layout and the planned layouts, each in the empty workshop and with the machine."""
    file, empty = load_plan(options.folder / "machine.toml")
    full = with_machine(empty)
    plans: dict[str, PlannedNetwork] = {name: make_plan(file, scenario, jobs=options.jobs)
                              for name, scenario in (("empty", empty), ("machine", full))}  # fmt: skip
    moved = scenario_of_plan(plans["empty"])
    layouts = (
        ("paper's layout, empty workshop", empty, planned_survey(empty)),
        ("paper's layout, with the machine", full, planned_survey(full)),
        ("plan for the empty workshop, empty", empty, planned_survey(moved)),
        ("plan for the empty workshop, with the machine", full, planned_survey(with_machine(moved))),
        ("plan for the machine, with the machine", full, planned_survey(scenario_of_plan(plans["machine"]))),
    )
    rows = [row(name, scenario, survey) for name, scenario, survey in layouts]
    show_table(options.out / "layouts.csv", rows)
    lost = make_visibility(full).invisible_pair_sentences(tuple(full.stations), full.target_names)
    write_table(options.out / "lost.csv", [{"sight": sentence} for sentence in lost])
    for name, scenario in (("paper_machine", full), ("plan_machine", scenario_of_plan(plans["machine"]))):
        write_figure(options.out / f"{name}.svg", floor_plan(workshop_from_scenario(scenario)))
    reasons = {name: Plan.from_network(plan).reasons for name, plan in plans.items()}
    return RunRecord(file.search.seed, file.search.starts, {"machine": MACHINE.model_dump(), "reasons": reasons})
