"""A plan file (ltsim-plan/1): which workshop, what is free, what a good layout is, what it may cost."""

from __future__ import annotations

import difflib
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from ltsim.effects import CATALOGUE
from ltsim.effects.air import Air
from ltsim.errors import SetupError, as_setup_error
from ltsim.planning.floor import Floor
from ltsim.planning.hall import TABLES, USUAL_HEIGHT_MM, hall_scenario, with_points
from ltsim.planning.points import Point, read_points
from ltsim.recording.files import shown
from ltsim.recording.settings import checked, read_toml
from ltsim.recording.setup import NonNegative, Positive, Section, Vector
from ltsim.simulation.builtin import builtin_names
from ltsim.simulation.scenario import Scenario, load_scenario
from ltsim.simulation.sections import Instrument, Smr, Work, Workshop

FORMAT = "ltsim-plan/1"
WALLS = "walls"
"""Names the walls of the room among the bodies that can hold nests."""
Few = Annotated[int, Field(ge=2, le=40)]


class Stations(Section):
    """How many stations; `tries` are the numbers of the trade-off curve, `fixed` ones stay where they are.

    Every sight holds when an instrument stands up to `play_mm` off its place: nobody sets up to the millimetre.
    """

    count: Few | None = None
    """How many; the scenario's number where it is not given."""
    most: Few = 8
    """The largest number that is tried for the goal's tolerances, where no count is given."""
    tries: tuple[Few, ...] = ()
    """Numbers of stations of the trade-off curve."""
    fixed: tuple[str, ...] = ()
    """Stations of the scenario that stay."""
    spacing_mm: NonNegative = 1000.0
    """Smallest distance between two stations, seen from above."""
    play_mm: NonNegative = 50.0
    """How far off its place an instrument may stand without losing a sight."""
    seen_from: Literal["all"] | Annotated[int, Field(ge=1, le=40)] = "all"
    """How many stations must see each reflector; without it all of them, or as many as some layout allows."""


class Surface(Section):
    """A flat surface with candidate places in rows and columns: origin, its two sides, how many along each."""

    name: str
    """Places are called NAME-ROW-COLUMN."""
    origin_mm: Vector
    """One corner."""
    across_mm: Vector
    """From the origin along the rows."""
    up_mm: Vector
    """From the origin along the columns."""
    columns: Annotated[int, Field(ge=1, le=200)] = 10
    """Places in a row."""
    rows: Annotated[int, Field(ge=1, le=200)] = 6
    """Number of rows."""


class Place(Section):
    """One candidate place."""

    name: str
    """Of the reflector that goes there."""
    position_mm: Vector
    """The place."""


class Reflectors(Section):
    """Candidate places of the mesh's reflectors; without any they stay. The gauge stays in any case."""

    surfaces: tuple[Surface, ...] = ()
    """Tables `[[reflectors.surfaces]]`."""
    places: tuple[Place, ...] = ()
    """Tables `[[reflectors.places]]`."""
    on: tuple[str, ...] = ()
    """Names of obstacles whose surfaces can hold a nest, and `walls`: places are found on them."""
    apart_mm: Positive = 1000.0
    """Least distance between places on them."""
    reach_mm: Positive = 40.0
    """Height of a reflector's centre over such a surface."""
    movable: tuple[str, ...] = ()
    """Points of the list, or groups of them, that may go elsewhere: the search leaves them where they are, and what a
    move of each would bring is told."""
    keep: tuple[str, ...] = ()
    """Reflectors of the scenario that stay; the points of a list do in any case."""
    spacing_mm: NonNegative = 300.0
    """Smallest distance between two reflectors."""


class Budget(Section):
    """What the work may cost and which settings of it are tried; times default to the scenario's."""

    faces: Annotated[tuple[Literal[1, 2], ...], Field(min_length=1)] | None = None
    """To choose from, with `hours` or with tolerances to keep: one face, both, or both ways tried (the default)."""
    repeats: Annotated[tuple[Annotated[int, Field(ge=1, le=20)], ...], Field(min_length=1)] | None = None
    """To choose from in the same way: numbers of rounds; default 1 and 2."""
    seconds_per_pointing: Positive | None = None
    """Time from one pointing to the next."""
    minutes_per_move: NonNegative | None = None
    """Time to carry the instrument to the next station."""
    hours: Positive | None = None
    """What the whole work may take; without it, and without tolerances to keep, the scenario's way of working stays."""


class Tolerance(Section):
    """A demand on points: all of a group within a distance, at the level of the goal."""

    group: str = ""
    """As the list of points names it; without it all points of the list."""
    within_mm: Positive
    """Largest distance of a point from where it truly is, in the datum of all reflectors."""


class Goal(Section):
    """What a layout is for: weights of its qualities (0: of no interest), and tolerances that points must keep.

    With tolerances and no number of stations, the fewest stations that keep them are looked for. With a list of points
    the targets are weighed alone unless the file says otherwise.
    """

    instrument: NonNegative = 1.0
    """Weight of how well the instrument's parameters become known."""
    targets: NonNegative = 0.0
    """Weight of the reflectors' point errors."""
    diagnosis: NonNegative = 0.0
    """Weight of how small an effect of `effects` can be seen."""
    criterion: Literal["D", "A", "E"] = "D"
    """Of the instrument's parameters. D: geometric mean; A: root mean square; E: the worst combination."""
    effects: tuple[str, ...] = (
        "station-weather",
        "range-step",
        "index-drift",
        "station-settling",
        "bearing-wobble",
        "mesh-expansion",
    )
    """What a diagnosis should see."""
    tolerances: tuple[Tolerance, ...] = ()
    """Tables `[[goal.tolerances]]`; one of a point's own, in the list of points, goes before them."""
    level_pct: Annotated[float, Field(ge=50, le=99.9)] = 95.0
    """Share of cases in which a point must be within its tolerance."""
    robust: Literal["no", "sight", "station"] = "no"
    """Tolerances must hold too when any one sight, or any one station, is lost."""

    @model_validator(mode="after")
    def _something(self) -> Goal:
        if self.instrument + self.targets + self.diagnosis == 0:
            raise ValueError("it should weigh at least one of instrument, targets and diagnosis")
        return self


class Search(Section):
    """How hard to look."""

    starts: Annotated[int, Field(ge=1, le=1000)] = 4
    """Independent searches for the plan itself."""
    starts_of_the_curve: Annotated[int, Field(ge=1, le=1000)] = 1
    """Independent searches for each other point of the curve."""
    grid_mm: Positive | None = None
    """Step of the candidate places on the floor; default about 250 places, at least 500 mm apart. Stations are moved
    off the grid afterwards."""
    yaws: Annotated[int, Field(ge=1, le=72)] = 6
    """Turns of the base tried at each place."""
    heights: Annotated[int, Field(ge=1, le=10)] = 2
    """Heights tried at each place."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Root of the search."""


class PlanFile(Section):
    """The whole file."""

    format: Literal["ltsim-plan/1"] = "ltsim-plan/1"
    """Which format and version this file is in."""
    title: str = ""
    """Free text."""
    scenario: str = "paper-workshop"
    """A built-in scenario, or a file beside this one; not with a `[workshop]` of the plan's own."""
    points: str | tuple[Point, ...] = ()
    """Points to measure: the name of a CSV file beside this one, or tables `[[points]]`."""
    workshop: Workshop | None = None
    """The hall, in place of a scenario, as in a scenario file; heads stand at 1400 to 1800 mm unless
    the floor says so."""
    instrument: Instrument | None = None
    """The tracker of that hall, as in a scenario file."""
    smr: Smr | None = None
    """Its reflectors, as in a scenario file."""
    work: Work | None = None
    """Order and clock of the work there, as in a scenario file; points as listed unless it says so."""
    air: Air = Air()
    """What is not known of the air, where ranges are long: in every figure of the plan."""
    floor: Floor = Floor()
    """Where tripods may stand."""
    stations: Stations = Stations()
    """How many, and what they must keep."""
    reflectors: Reflectors = Reflectors()
    """Candidate places of reflectors."""
    budget: Budget = Budget()
    """What it may cost."""
    goal: Goal = Goal()
    """What a layout is for."""
    search: Search = Search()
    """How hard to look."""

    @property
    def chooses(self) -> bool:
        """The way of working is a matter of choice: by a budget of hours, or as the quickest that keeps tolerances."""
        return self.budget.hours is not None or self.searches_count

    @property
    def searches_count(self) -> bool:
        """The fewest stations that keep the tolerances are looked for."""
        wanted = bool(self.goal.tolerances) or any(point.tolerance_mm is not None for point in self.listed)
        return wanted and self.stations.count is None

    @property
    def listed(self) -> tuple[Point, ...]:
        """The points, once their file is read."""
        return () if isinstance(self.points, str) else self.points


def plan_names() -> tuple[str, ...]:
    """Built-in plan files, then scenarios, which are plans with all settings at their defaults."""
    folder = files("ltsim.planning") / "builtin"
    own = sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml"))
    return (*own, *(name for name in builtin_names() if name not in own))


def plan_text(name: str) -> str:
    """The commented file of a built-in plan, to print and edit."""
    path = files("ltsim.planning") / "builtin" / f"{name}.toml"
    if not path.is_file():
        raise SetupError(f"{shown(name)}: there is no built-in plan of this name; did you mean {_near(name)}?")
    return path.read_text(encoding="utf-8")


def load_plan(name_or_path: str | Path) -> tuple[PlanFile, Scenario]:
    """A plan file, a built-in plan, or a scenario taken as a plan; with its scenario (raises SetupError)."""
    name = str(name_or_path)
    built = files("ltsim.planning") / "builtin" / f"{name}.toml"
    path = Path(str(built)) if built.is_file() else Path(name)
    if not path.is_file():
        if name in builtin_names():
            return PlanFile(scenario=name), load_scenario(name)
        raise SetupError(f"{shown(name)}: there is no such file, and no built-in plan; did you mean {_near(name)}?")
    data = _read(path)
    if data.get("format") == "ltsim-scenario/1":
        return PlanFile(scenario=name), load_scenario(path)
    made = plan_from(data, path)
    made = made.model_copy(update=_given(made, path))
    scenario = _scenario(made, data, path)
    _check(made, scenario, path)
    return made, scenario


def _given(made: PlanFile, path: Path) -> dict[str, Any]:
    """What the file leaves to others: the points of its list, and defaults that follow from other keys."""
    points = read_points(path.parent / made.points) if isinstance(made.points, str) else made.points
    changes: dict[str, Any] = {"points": points}
    if made.workshop is not None and made.floor.height_mm is None:
        changes["floor"] = made.floor.model_copy(update={"height_mm": USUAL_HEIGHT_MM})
    if points and not {"instrument", "targets", "diagnosis"} & made.goal.model_fields_set:
        changes["goal"] = made.goal.model_copy(update={"instrument": 0.0, "targets": 1.0})
    return changes


def _scenario(made: PlanFile, data: dict[str, Any], path: Path) -> Scenario:
    """The scenario that a plan file names, or that of its own tables."""
    points = made.listed
    own = [name for name in TABLES if name in data]
    if made.workshop is None and own:
        raise SetupError(f"{path}: [{own[0]}] goes with a [workshop] of the plan's own; the scenario states its own")
    if made.workshop is not None:
        if "scenario" in data:
            raise SetupError(f"{path}: it should have either scenario or [workshop], not both")
        return hall_scenario(made, data, points, path)
    beside = path.parent / made.scenario
    return with_points(load_scenario(beside if beside.is_file() else made.scenario), points, path)


def _near(name: str) -> str:
    known = plan_names()
    return ", ".join(difflib.get_close_matches(name, known, n=3, cutoff=0.4) or known)


def _read(path: Path) -> dict[str, Any]:
    with as_setup_error():
        return read_toml(path, "plan")


def plan_from(data: dict[str, Any], file: object) -> PlanFile:
    """Check the tables of a plan; `file` is named in errors."""
    with as_setup_error():
        return checked(data, PlanFile, "plan", file)


def _check(made: PlanFile, scenario: Scenario, file: object) -> None:
    """Names that exist, counts that fit together."""

    def known(key: str, wanted: tuple[str, ...], names: tuple[str, ...]) -> None:
        for name in wanted:
            if name not in names:
                near = (
                    ", ".join(difflib.get_close_matches(name, names, n=3, cutoff=0.4) or names[:8]) or "none is named"
                )
                raise SetupError(f"{file}: {key} names '{shown(name)}', which does not exist; did you mean {near}?")

    known("stations.fixed", made.stations.fixed, tuple(scenario.stations))
    known("reflectors.on", made.reflectors.on, (WALLS, *(o.name for o in scenario.workshop.obstacles if o.name)))
    known("reflectors.keep", made.reflectors.keep, scenario.target_names)
    known("goal.effects", made.goal.effects, tuple(effect.name for effect in CATALOGUE))
    groups = {point.group for point in made.listed if point.group}
    known("reflectors.movable", made.reflectors.movable, (*sorted(groups), *(point.name for point in made.listed)))
    known("goal.tolerances", tuple(t.group for t in made.goal.tolerances if t.group), tuple(sorted(groups)))
    if made.goal.tolerances and not made.listed:
        raise SetupError(f"{file}: goal.tolerances stands without points; give points as a list or a file")
    given = [f"budget.{key}" for key in ("faces", "repeats") if getattr(made.budget, key) is not None]
    if given and not made.chooses:
        raise SetupError(
            f"{file}: {' and '.join(given)} without budget.hours chooses nothing; give the hours that the work may "
            "take, or say how it is done as [work] faces and repeats of the scenario"
        )
    if made.goal.diagnosis and not made.goal.effects:
        raise SetupError(f"{file}: goal.diagnosis is weighed, but goal.effects names no effect to look for")
    count = made.stations.count or len(scenario.stations)
    if isinstance(made.stations.seen_from, int) and made.stations.seen_from > count:
        raise SetupError(f"{file}: stations.seen_from is {made.stations.seen_from}, but there are {count} stations")
    own = [p.name for p in made.reflectors.places] + [s.name for s in made.reflectors.surfaces]
    for name in own:
        if own.count(name) > 1 or name in scenario.target_names:
            raise SetupError(f"{file}: reflectors has the name '{shown(name)}' twice, or a target has it")
