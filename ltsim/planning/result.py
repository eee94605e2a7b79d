"""Result of planning as Python object, plan.json and tables, and the scenario with its layout for `ltsim simulate`."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import PrivateAttr

from ltsim.adjustment.remedies.detectability import catalogue_detectability
from ltsim.core.arguments import path_of_file_or_built_in
from ltsim.core.errors import InputError, ModelError
from ltsim.core.results import Table
from ltsim.core.storage import read_whole_file
from ltsim.physics.effects import CATALOGUE
from ltsim.planning import tables
from ltsim.planning.loading import load_plan
from ltsim.planning.plan_entries import (
    ConfusablePair,
    DetectableSize,
    LossCheckEntry,
    PlannedLayoutEntry,
    PlannedStationEntry,
    TradeoffEntry,
)
from ltsim.planning.planner import PlannedNetwork
from ltsim.planning.reasons import fewest_stations_not_worse_than_scenario, reason_sentences
from ltsim.planning.reflector_changes import ReflectorChangeEntry, to_millimetres
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import PlannedSurvey
from ltsim.planning.tolerances import tolerance_ratio_text
from ltsim.recordings.air import AirUncertainty
from ltsim.recordings.result_file import OptionalFloat, ResultFile, read_result, write_result
from ltsim.simulation.scenario import Scenario, load_scenario, scenario_to_toml
from ltsim.simulation.sections import PlannedStation, PlannedTarget
from ltsim.simulation.workshop import placed_obstacles

COORDINATE_FRAME_TEXT = (
    "the frame of the hall: the origin is a corner, z is up; yaw is the direction of azimuth zero, "
    "counter-clockwise from x"
)
"""Description of the coordinate system of all coordinates in a plan, for users."""
SCENARIO_FILE_NAME = "scenario.toml"
"""Name of the scenario file with the plan's stations, in the plan's folder."""
PLAN_FILE_NAME = "plan.toml"
"""Name of the plan file that the interactive planner saves in the folder of a plan."""
FLOOR_PLAN_FILE = "floor.png"
"""Name of the picture file with the floor plan."""
TRADE_OFF_FILE = "tradeoff.png"
"""Name of the picture file with the trade-off curve: objective of the layout against duration of the measurement."""
WORK_ORDER_FILE = "work-order.html"
"""Name of the HTML file with the work order for the shop floor."""


class Plan(ResultFile, PlannedLayoutEntry):
    """Result of planning (`ltsim plan`), the content of `plan.json`: planned layout, reasons, comparisons, settings."""

    FILE: ClassVar[str] = "plan.json"
    COMPANION_TABLES: ClassVar[Mapping[str, Table]] = {table.name: table for table in tables.PLAN_TABLES}
    FURTHER_FILES: ClassVar[tuple[str, ...]] = (SCENARIO_FILE_NAME, FLOOR_PLAN_FILE, TRADE_OFF_FILE, WORK_ORDER_FILE)
    format: Literal["ltsim-plan-result/1"] = "ltsim-plan-result/1"
    """Format and version of this file."""
    title: str = ""
    """Title of the plan file or of the scenario."""
    summary: str
    """Sentences with the verdict on the goal, or with the extent of the measurement if there are no tolerances."""
    reasons: tuple[str, ...] = ()
    """Sentences with the reasons for the layout, its limits and its alternatives."""
    frame: str = ""
    """Description of the coordinate system of all coordinates."""
    reference_layout: PlannedLayoutEntry | None = None
    """Layout that the scenario contains, with its expected precision, for comparison with the plan."""
    fewest_stations: TradeoffEntry | None = None
    """Point of the trade-off curve with the fewest stations whose layout is as good as that of the scenario; null if
    there is no such point."""
    tradeoff_points: tuple[TradeoffEntry, ...] = ()
    """Points of the trade-off curve between cost and quality, in ascending order of duration."""
    start_objectives: tuple[OptionalFloat, ...] = ()
    """Value of the objective function at the end of each independent search, in ascending order; smaller is better."""
    reflector_changes: tuple[ReflectorChangeEntry, ...] = ()
    """Useful moves of a single reflector and useful additional reflectors, the best first, then removals."""
    reflector_changes_sentence: str = ""
    """Sentence with the numbers of evaluated and of useful changes of single reflectors."""
    obstacle_sentences: tuple[str, ...] = ()
    """Sentence on each obstacle in the hall with the type of its CAD file, size and position."""
    goal_reached: bool | None = None
    """True if the layout breaks no rule and meets all tolerances, also after any single loss if required; null without
    tolerances."""
    tolerances_met: bool | None = None
    """True if all points meet their tolerances while no station and no sight is lost; null without tolerances."""
    loss_checks: tuple[LossCheckEntry, ...] = ()
    """Check of the tolerances after the loss of each station, and of each sight of a point with a tolerance."""
    settings: PlanFile = PlanFile()
    """Content of the plan file."""
    seed: int | None = None
    """Seed of the random draws of the search."""
    detectable_sizes: tuple[DetectableSize, ...] = ()
    """Minimal detectable size, in this layout, of each effect that `ltsim effects` lists."""
    confusable_effects: tuple[ConfusablePair, ...] = ()
    """Pairs of effects that measurements in this layout hardly distinguish."""
    undetectable_effects: tuple[str, ...] = ()
    """Names of effects that a diagnosis cannot detect: they change no residual, or depend on data that the plan does
    not contain. Blunders such as exchanged names, which separate tests identify, are not among them."""

    _network: PlannedNetwork | None = PrivateAttr(None)

    @classmethod
    def from_network(cls, network: PlannedNetwork) -> Self:
        """Result with the content of the planned network `network`; the network remains available as `Plan.network`."""
        sentences, few, judged = (
            reason_sentences(network),
            fewest_stations_not_worse_than_scenario(network),
            network.verdict,
        )
        report = catalogue_detectability(network.layout.expected_precision.adjustment, CATALOGUE)
        result = cls.from_evaluation(
            network.layout,
            network.tolerance_check,
            title=network.plan_file.title or network.scenario.title,
            summary=sentences[0],
            reasons=tuple(sentences[1:]),
            frame=COORDINATE_FRAME_TEXT,
            reference_layout=None
            if network.scenario_layout_evaluation is None
            else PlannedLayoutEntry.from_evaluation(network.scenario_layout_evaluation),
            fewest_stations=None if few is None else TradeoffEntry.from_tradeoff_point(few),
            tradeoff_points=tuple(TradeoffEntry.from_tradeoff_point(option) for option in network.tradeoff_points),
            reflector_changes=network.reflector_changes.reported_changes,
            reflector_changes_sentence=network.reflector_changes.summary_sentence,
            start_objectives=network.start_objectives,
            obstacle_sentences=tuple(body.description for body in placed_obstacles(network.scenario)),
            goal_reached=None if judged is None else judged.is_goal_reached,
            tolerances_met=None if network.tolerance_check is None else network.tolerance_check.meets_all_tolerances,
            loss_checks=tuple(LossCheckEntry.from_check(loss) for loss in network.loss_checks),
            settings=_all_settings(network.plan_file),
            seed=network.plan_file.search.seed,
            detectable_sizes=tuple(DetectableSize.from_minimal_size(row) for row in report.table()),
            confusable_effects=tuple(ConfusablePair.from_pair(pair) for pair in report.confusable_pairs()),
            undetectable_effects=report.undetectable_effects,
        )
        result._network = network
        return result

    @property
    def network(self) -> PlannedNetwork:
        """Planned network with its evaluations as arrays; raises ModelError for a plan that was read from a file."""
        if self._network is None:
            raise ModelError("a plan read from a file has no arrays; call lt.plan with its folder and move={}")
        return self._network

    def _summary_lines(self) -> list[str]:
        return [self.summary, *self.reasons[:1]]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {
            "stations": self._stations_table,
            "reflectors": self._reflectors_table,
            "tolerances": self._tolerances_table,
            "losses": self._losses_table,
            "tradeoff": lambda: tables.TRADEOFF_TABLE.with_rows(self.tradeoff_points),
            "parameters": self._parameters_table,
            "expected": self._expected_table,
            "changes": self._changes_table,
            "effects": lambda: tables.DETECTABLE_SIZES_TABLE.with_rows(self.detectable_sizes),
            "confusable": lambda: tables.CONFUSABLE_EFFECTS_TABLE.with_rows(self.confusable_effects),
            "nominals": lambda: tables.NOMINAL_POINTS_TABLE.with_rows(
                [r.name, *r.position_mm] for r in self.reflectors
            ),
        }

    def _stations_table(self) -> Table:
        return tables.PLANNED_STATIONS_TABLE.with_rows(
            [s.name, *s.position_mm, s.yaw_deg, *(s.sigma_position_um or 3 * (None,)), s.visible_reflectors]
            for s in self.stations
        )

    def _reflectors_table(self) -> Table:
        return tables.PLANNED_REFLECTORS_TABLE.with_rows(
            [r.name, *r.position_mm, r.sigma_um, *(r.expanded_uncertainty_um or 3 * (None,)), r.point_error_mm,
             r.tolerance_mm, " ".join(r.visible_from)]
            for r in self.reflectors
        )  # fmt: skip

    def _tolerances_table(self) -> Table:
        return tables.TOLERANCES_TABLE.with_rows(
            [r.name, r.point_error_mm, r.tolerance_mm, tolerance_ratio_text(r.tolerance_ratio), r.tolerance_met]
            for r in self.reflectors
            if r.tolerance_ratio is not None
        )

    def _losses_table(self) -> Table:
        return tables.LOSS_CHECKS_TABLE.with_rows(
            [
                loss.lost_station_or_sight,
                loss.tolerances_met,
                loss.worst_point,
                loss.max_tolerance_ratio_text,
                " ".join(loss.unseen_points),
            ]
            for loss in sorted(self.loss_checks, key=lambda loss: loss.tolerances_met)
        )

    def _parameters_table(self) -> Table:
        reference = {p.name: p.sigma for p in self.reference_layout.parameters} if self.reference_layout else {}
        return tables.PLANNED_PARAMETERS_TABLE.with_rows(
            [p.name, p.unit, p.sigma, reference.get(p.name), p.prior_sigma, p.removed_variance_fraction]
            for p in self.parameters
        )

    def _expected_table(self) -> Table:
        layouts: list[tuple[str, PlannedLayoutEntry | None]] = [
            ("this plan", self),
            ("reference layout", self.reference_layout),
        ]
        return tables.EXPECTED_DISAGREEMENT_TABLE.with_rows(
            [layout, name, e.before_um, e.after_um, e.improvement_percent]
            for layout, entry in layouts
            if entry is not None and entry.expected_improvement
            for name, e in entry.expected_improvement.items()
        )

    def _changes_table(self) -> Table:
        return tables.REFLECTOR_CHANGES_TABLE.with_rows(
            [
                i,
                c.action_text,
                c.target_rms_decrease_um,
                100 * (1 - c.objective_ratio),
                c.most_affected_parameter,
                100 * (c.most_affected_ratio - 1),
            ]
            for i, c in enumerate(self.reflector_changes, 1)
        )


def write_plan(plan: Plan, folder: Path | None, pictures: Mapping[str, bytes] | None = None) -> Plan:
    """Copy of a plan that contains the digests of its companion files; plan and files are written to `folder`.

    Without a folder nothing is written, and the result is the plan itself. `pictures` holds the contents of additional
    files, by file name.
    """
    if folder is None:
        return plan
    network = plan.network
    network_tables = tables.make_visibility_table(network.layout), tables.make_work_order_table(network)
    scenario, cad = with_cad_file_copies(scenario_of_plan(network))
    texts = {table.file: table.csv_text() for table in network_tables} | {
        SCENARIO_FILE_NAME: scenario_to_toml(scenario)
    }
    return write_result(folder, plan, {**texts, **cad, **(pictures or {})})


def load_plan_and_scenario(source: str | Path) -> tuple[PlanFile, Scenario]:
    """Plan file and scenario from `source`: a plan file, a scenario, a built-in name, or the folder of a plan.

    In a folder, the file that the interactive planner saved has priority over plan.json. Raises InputError.
    """
    folder = path_of_file_or_built_in(source)
    if (folder / PLAN_FILE_NAME).is_file():
        return load_plan(folder / PLAN_FILE_NAME)
    if not folder.is_dir():
        return load_plan(source)
    return read_result(folder, Plan).settings, load_scenario(folder / SCENARIO_FILE_NAME)


def _all_settings(plan_file: PlanFile) -> PlanFile:
    """Plan file of which all keys are written to plan.json, apart from an unset number of stations per reflector."""
    values = plan_file.model_dump(mode="json")
    if not plan_file.gives_min_stations_per_target:
        values["stations"].pop("min_stations_per_target")
    return PlanFile.model_validate(values)


def scenario_of_plan(plan: PlannedNetwork) -> Scenario:
    """Scenario with the plan's stations, reflectors and measuring procedure, for `ltsim simulate`."""
    return scenario_with_layout(plan.scenario, plan.layout.survey, plan.plan_file.title or plan.scenario.title)


def scenario_with_layout(scenario: Scenario, survey: PlannedSurvey, title: str = "") -> Scenario:
    """Scenario with the stations, reflectors and measuring procedure of a planned survey, and with a table `[air]`.

    The new scenario has the title `title`; if `title` is empty, it keeps the title of `scenario`.
    """
    levelled = {name for name, station in scenario.stations.items() if station.levelled}
    stations = {
        place.name: PlannedStation(
            position_mm=place.position_mm, yaw_deg=place.yaw_deg, levelled=place.name in levelled
        )
        for place in PlannedStationEntry.from_survey(survey)
    }
    fixed = set(scenario.gauge.targets) if scenario.gauge else set()
    targets = {
        name: scenario.targets.get(name) or PlannedTarget(position_mm=to_millimetres(place, 3))
        for name, place in zip(survey.target_names, survey.target_points, strict=True)
        if name not in fixed
    }
    way = {
        "faces": len(survey.faces),
        "repeats": survey.repeats,
        "seconds_per_pointing": survey.seconds_per_pointing,
        "minutes_per_move": survey.seconds_per_move / 60.0,
    }
    work = scenario.work.model_copy(update=way | {"stations": None})
    new_fields = {"stations": stations, "targets": targets, "work": work, "air": scenario.air or AirUncertainty()}
    return scenario.model_copy(update=new_fields | {"title": title or scenario.title})


def with_cad_file_copies(scenario: Scenario) -> tuple[Scenario, dict[str, bytes]]:
    """Scenario whose obstacles refer to CAD files in its own folder, and contents of these files by file name.

    Raises InputError if a file cannot be read.
    """
    names: dict[str, str] = {}
    contents: dict[str, bytes] = {}
    for path in dict.fromkeys(entry.file for entry in scenario.workshop.obstacles if entry.file is not None):
        file_name = Path(path).name
        names[path] = file_name if file_name not in contents else f"{len(contents) + 1}-{file_name}"
        try:
            contents[names[path]] = read_whole_file(Path(path))
        except OSError as problem:
            raise InputError(f"{path}: the file cannot be read ({problem.strerror})") from None
    obstacles = tuple(
        entry if entry.file is None else entry.model_copy(update={"file": names[entry.file]})
        for entry in scenario.workshop.obstacles
    )
    workshop = scenario.workshop.model_copy(update={"obstacles": obstacles})
    return scenario.model_copy(update={"workshop": workshop}), contents
