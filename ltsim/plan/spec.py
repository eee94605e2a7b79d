"""A plan file (ltsim-plan/1): which workshop, what is free, what a good layout is, what it may cost."""

from __future__ import annotations

import difflib
import json
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from ltsim.effects import CATALOGUE
from ltsim.errors import RecordError, SetupError
from ltsim.recording.files import shown
from ltsim.recording.settings import read_toml, sentence
from ltsim.recording.setup import Finite, NonNegative, Positive, Section, Vector
from ltsim.simulate.scenario import Scenario, builtin_names, load_scenario

FORMAT = "ltsim-plan/1"
Corner = tuple[Finite, Finite]
Few = Annotated[int, Field(ge=2, le=40)]


class Floor(Section):
    """Where tripods may stand; by default the whole floor but a margin along the walls."""

    corners_mm: Annotated[tuple[Corner, ...], Field(min_length=3)] | None = None
    margin_mm: NonNegative = 600.0
    height_mm: tuple[Positive, Positive] | None = None

    @model_validator(mode="after")
    def _low_then_high(self) -> Floor:
        if self.height_mm is not None and self.height_mm[0] > self.height_mm[1]:
            raise ValueError("it should give the lower height_mm first")
        return self


class Stations(Section):
    """How many stations; `tries` are the numbers of the trade-off curve, `fixed` ones stay where they are.

    Every sight holds when an instrument stands up to `play_mm` off its place: nobody sets up to the millimetre.
    """

    count: Few | None = None
    tries: tuple[Few, ...] = ()
    fixed: tuple[str, ...] = ()
    spacing_mm: NonNegative = 1000.0
    play_mm: NonNegative = 50.0
    seen_from: Literal["all"] | Annotated[int, Field(ge=1, le=40)] = "all"


class Surface(Section):
    """A flat surface with candidate places in rows and columns: origin, its two sides, how many along each."""

    name: str
    origin_mm: Vector
    across_mm: Vector
    up_mm: Vector
    columns: Annotated[int, Field(ge=1, le=200)] = 10
    rows: Annotated[int, Field(ge=1, le=200)] = 6


class Place(Section):
    """One candidate place."""

    name: str
    position_mm: Vector


class Reflectors(Section):
    """Candidate places of the mesh's reflectors; without any they stay. The gauge stays in any case."""

    surfaces: tuple[Surface, ...] = ()
    places: tuple[Place, ...] = ()
    keep: tuple[str, ...] = ()
    spacing_mm: NonNegative = 300.0


class Budget(Section):
    """What the work may cost and which settings of it are tried; times default to the scenario's."""

    faces: Annotated[tuple[Literal[1, 2], ...], Field(min_length=1)] = (1, 2)
    repeats: Annotated[tuple[Annotated[int, Field(ge=1, le=20)], ...], Field(min_length=1)] = (1, 2)
    seconds_per_pointing: Positive | None = None
    minutes_per_move: NonNegative | None = None
    hours: Positive | None = None


class Goal(Section):
    """What a layout is for: weights of its qualities (0: of no interest)."""

    instrument: NonNegative = 1.0
    targets: NonNegative = 0.0
    diagnosis: NonNegative = 0.0
    criterion: Literal["D", "A", "E"] = "D"
    effects: tuple[str, ...] = (
        "station-weather",
        "range-step",
        "index-drift",
        "station-settling",
        "bearing-wobble",
        "mesh-expansion",
    )

    @model_validator(mode="after")
    def _something(self) -> Goal:
        if self.instrument + self.targets + self.diagnosis == 0:
            raise ValueError("it should weigh at least one of instrument, targets and diagnosis")
        return self


class Search(Section):
    """How hard to look."""

    starts: Annotated[int, Field(ge=1, le=1000)] = 4
    starts_of_the_curve: Annotated[int, Field(ge=1, le=1000)] = 1
    grid_mm: Positive = 500.0
    yaws: Annotated[int, Field(ge=1, le=72)] = 6
    heights: Annotated[int, Field(ge=1, le=10)] = 2
    seed: Annotated[int, Field(ge=0)] = 0


class PlanFile(Section):
    """The whole file."""

    format: Literal["ltsim-plan/1"] = "ltsim-plan/1"
    title: str = ""
    scenario: str = "paper-workshop"
    floor: Floor = Floor()
    stations: Stations = Stations()
    reflectors: Reflectors = Reflectors()
    budget: Budget = Budget()
    goal: Goal = Goal()
    search: Search = Search()


def plan_names() -> tuple[str, ...]:
    """Built-in plan files, then scenarios, which are plans with all settings at their defaults."""
    folder = files("ltsim.plan") / "builtin"
    own = sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml"))
    return (*own, *(name for name in builtin_names() if name not in own))


def plan_text(name: str) -> str:
    """The commented file of a built-in plan, to print and edit."""
    path = files("ltsim.plan") / "builtin" / f"{name}.toml"
    if not path.is_file():
        raise SetupError(f"{shown(name)}: there is no built-in plan of this name; did you mean {_near(name)}?")
    return path.read_text(encoding="utf-8")


def load_plan(name_or_path: str | Path) -> tuple[PlanFile, Scenario]:
    """A plan file, a built-in plan, or a scenario taken as a plan; with its scenario.

    Raises
    ------
    SetupError
        One sentence: file, key, what was found, what would be right.
    """
    name = str(name_or_path)
    built = files("ltsim.plan") / "builtin" / f"{name}.toml"
    path = Path(str(built)) if built.is_file() else Path(name)
    if not path.is_file():
        if name in builtin_names():
            return PlanFile(scenario=name), load_scenario(name)
        raise SetupError(f"{shown(name)}: there is no such file, and no built-in plan; did you mean {_near(name)}?")
    data = _read(path)
    if data.get("format") == "ltsim-scenario/1":
        return PlanFile(scenario=name), load_scenario(path)
    made = plan_from(data, path)
    beside = path.parent / made.scenario
    scenario = load_scenario(beside if beside.is_file() else made.scenario)
    _check(made, scenario, path)
    return made, scenario


def _near(name: str) -> str:
    known = plan_names()
    return ", ".join(difflib.get_close_matches(name, known, n=3, cutoff=0.4) or known)


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path, "plan")
    except RecordError as problem:
        raise SetupError(str(problem)) from None


def plan_from(data: dict[str, Any], file: object) -> PlanFile:
    """Check the tables of a plan; `file` is named in errors."""
    if "format" not in data:
        raise SetupError(f'{file}: the key format is missing, expected format = "{FORMAT}"')
    try:
        return PlanFile.model_validate_json(json.dumps(data, default=str), strict=True)
    except ValidationError as problem:
        raise SetupError(f"{file}: {sentence(problem.errors()[0], PlanFile)}") from None
    except (ValueError, RecursionError):
        raise SetupError(f"{file}: holds a value that no plan can hold") from None


def _check(made: PlanFile, scenario: Scenario, file: object) -> None:
    """Names that exist, counts that fit together."""

    def known(key: str, wanted: tuple[str, ...], names: tuple[str, ...]) -> None:
        for name in wanted:
            if name not in names:
                near = ", ".join(difflib.get_close_matches(name, names, n=3, cutoff=0.4) or names[:8])
                raise SetupError(f"{file}: {key} names '{shown(name)}', which does not exist; did you mean {near}?")

    known("stations.fixed", made.stations.fixed, tuple(scenario.stations))
    known("reflectors.keep", made.reflectors.keep, scenario.target_names)
    known("goal.effects", made.goal.effects, tuple(effect.name for effect in CATALOGUE))
    if made.goal.diagnosis and not made.goal.effects:
        raise SetupError(f"{file}: goal.diagnosis is weighed, but goal.effects names no effect to look for")
    count = made.stations.count or len(scenario.stations)
    if isinstance(made.stations.seen_from, int) and made.stations.seen_from > count:
        raise SetupError(f"{file}: stations.seen_from is {made.stations.seen_from}, but there are {count} stations")
    chosen = made.reflectors.surfaces or made.reflectors.places
    if chosen and made.goal.instrument + made.goal.diagnosis == 0:
        message = "reflectors can be chosen for the instrument or for diagnosis, but goal weighs targets only"
        raise SetupError(f"{file}: {message}")
    own = [p.name for p in made.reflectors.places] + [s.name for s in made.reflectors.surfaces]
    for name in own:
        if own.count(name) > 1 or name in scenario.target_names:
            raise SetupError(f"{file}: reflectors has the name '{shown(name)}' twice, or a target has it")
