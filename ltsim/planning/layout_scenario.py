"""Scenario of a planned layout, for `ltsim simulate`, with its CAD files in the folder of a plan."""

from pathlib import Path

from ltsim.core.errors import SetupError
from ltsim.planning.plan_change import to_millimetres
from ltsim.planning.plan_entries import StationEntry
from ltsim.planning.planner import PlannedNetwork
from ltsim.planning.survey import PlannedSurvey
from ltsim.recordings.air import AirUncertainty
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.sections import PlannedStation, PlannedTarget

SCENARIO_FILE = "scenario.toml"
"""Name of the scenario file with the plan's stations, in the plan's folder."""
PLAN_FILE = "plan.toml"
"""Name of the plan file that the interactive planner saves in the folder of a plan."""


def scenario_of_plan(plan: PlannedNetwork) -> Scenario:
    """Scenario with the plan's stations, reflectors and measuring procedure, for `ltsim simulate`."""
    return with_layout(plan.scenario, plan.layout.survey, plan.plan_file.title or plan.scenario.title)


def with_layout(scenario: Scenario, survey: PlannedSurvey, title: str = "") -> Scenario:
    """Scenario with the stations, reflectors, measuring procedure and air of a planned survey."""
    levelled = {name for name, station in scenario.stations.items() if station.levelled}
    stations = {
        place.name: PlannedStation(
            position_mm=place.position_mm, yaw_deg=place.yaw_deg, levelled=place.name in levelled
        )
        for place in StationEntry.without_precision(survey)
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
    changes = {"stations": stations, "targets": targets, "work": work, "air": scenario.air or AirUncertainty()}
    return scenario.model_copy(update=changes | {"title": title or scenario.title})


def copy_cad_files(scenario: Scenario) -> tuple[Scenario, dict[str, bytes]]:
    """Scenario that names CAD files in its own folder, and contents of these files by name; raises SetupError."""
    names: dict[str, str] = {}
    contents: dict[str, bytes] = {}
    for path in dict.fromkeys(entry.file for entry in scenario.workshop.obstacles if entry.file is not None):
        file_name = Path(path).name
        names[path] = file_name if file_name not in contents else f"{len(contents) + 1}-{file_name}"
        try:
            contents[names[path]] = Path(path).read_bytes()
        except OSError as problem:
            raise SetupError(f"{path}: cannot be read ({problem.strerror})") from None
    obstacles = tuple(
        entry if entry.file is None else entry.model_copy(update={"file": names[entry.file]})
        for entry in scenario.workshop.obstacles
    )
    room = scenario.workshop.model_copy(update={"obstacles": obstacles})
    return scenario.model_copy(update={"workshop": room}), contents
