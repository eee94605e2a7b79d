"""A plan file (ltsim-plan/1): which workshop, what is free, what a good layout is, what it may cost."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from ltsim.recordings.air import Air
from ltsim.recordings.setup import Finite, NonNegative, Positive, TomlSection, Vector
from ltsim.scene.floor import Floor
from ltsim.simulation.sections import ScenarioInstrument, Smr, Work, Workshop

WALLS = "walls"
"""Name of the walls of the room among the bodies that can hold nests."""
Few = Annotated[int, Field(ge=2, le=40)]


class Point(TomlSection):
    """A point to measure; with ``points = "points.csv"`` the file has these keys as its columns.

    The file is a list of coordinates in any dialect that is read: ``Name;X [m];Y [m];Z [m]`` does as well.
    """

    name: str
    """Name of the point."""
    x_mm: Finite
    """x coordinate in the hall's axes."""
    y_mm: Finite
    """y coordinate in the hall's axes."""
    z_mm: Finite
    """z coordinate in the hall's axes."""
    group: str = ""
    """Group of the point, by which a tolerance names it."""
    weight: NonNegative = 1.0
    """Weight of the squared point error in the quality of the targets."""
    tolerance_mm: Positive | None = None
    """Largest allowed point error, at the confidence level of the goal."""


class Stations(TomlSection):
    """Number of stations, numbers of the trade-off curve, stations that stay where they are, and rules.

    Every sight must be free while the instrument stands up to `position_tolerance_mm` off its place.
    """

    count: Few | None = None
    """Number of stations; the scenario's number where it is not given."""
    max_count: Few = 8
    """The largest number that is tried for the goal's tolerances, where no count is given."""
    tradeoff_counts: tuple[Few, ...] = ()
    """Numbers of stations of the trade-off curve."""
    fixed: tuple[str, ...] = ()
    """Stations of the scenario that stay."""
    spacing_mm: Annotated[Finite, Field(ge=1)] = 1000.0
    """Smallest distance between two stations, seen from above; at least 1 mm, since no two tripods share a place."""
    position_tolerance_mm: NonNegative = 50.0
    """Largest distance of an instrument from its place at which every sight must still be free."""
    min_stations_per_target: Literal["all"] | Annotated[int, Field(ge=1, le=40)] = "all"
    """Least number of stations that see each reflector; without it all of them, or as many as some layout allows."""


class Surface(TomlSection):
    """A flat surface with candidate places in rows and columns: origin, its two sides, numbers along each."""

    name: str
    """Places are called NAME-ROW-COLUMN."""
    origin_mm: Vector
    """Corner of the grid."""
    across_mm: Vector
    """Vector from the origin along the rows."""
    up_mm: Vector
    """Vector from the origin along the columns."""
    columns: Annotated[int, Field(ge=1, le=200)] = 10
    """Places in a row."""
    rows: Annotated[int, Field(ge=1, le=200)] = 6
    """Number of rows."""


class CandidatePlace(TomlSection):
    """Candidate place."""

    name: str
    """Name of the reflector that goes there."""
    position_mm: Vector
    """Coordinates of the place."""


class Reflectors(TomlSection):
    """Candidate places of the mesh's reflectors; without any they stay. The gauge stays in any case."""

    surfaces: tuple[Surface, ...] = ()
    """Tables `[[reflectors.surfaces]]`."""
    places: tuple[CandidatePlace, ...] = ()
    """Tables `[[reflectors.places]]`."""
    on: tuple[str, ...] = ()
    """Names of obstacles whose surfaces can hold a nest, and `walls`: places are found on them."""
    place_spacing_mm: Positive = 1000.0
    """Least distance between places on them."""
    standoff_mm: Positive = 40.0
    """Height of a reflector's centre over such a surface."""
    movable: tuple[str, ...] = ()
    """Points of the list, or groups of them, that may go elsewhere: the search leaves them where they are, and what a
    move of each would bring is reported."""
    keep: tuple[str, ...] = ()
    """Reflectors of the scenario that stay; the points of a list do in any case."""
    spacing_mm: NonNegative = 300.0
    """Smallest distance between two reflectors."""


class Budget(TomlSection):
    """Cost of the work, and the settings of it that are tried; times default to the scenario's."""

    faces: Annotated[tuple[Literal[1, 2], ...], Field(min_length=1)] | None = None
    """Choices with `hours` or tolerances: one face, both, or both ways tried (the default)."""
    repeats: Annotated[tuple[Annotated[int, Field(ge=1, le=20)], ...], Field(min_length=1)] | None = None
    """Choices of the number of rounds, with `hours` or tolerances; default 1 and 2."""
    seconds_per_pointing: Positive | None = None
    """Time from one pointing to the next."""
    minutes_per_move: NonNegative | None = None
    """Time to carry the instrument to the next station."""
    hours: Positive | None = None
    """Longest duration of the whole work [h]; without it and tolerances, the scenario's way of working stays."""


class PointTolerance(TomlSection):
    """A demand on points: all of a group within a distance, at the level of the goal."""

    group: str = ""
    """Group in the list of points; without it all points of the list."""
    within_mm: Positive
    """Largest distance of a point from its true place, in the datum of all reflectors."""


class Goal(TomlSection):
    """Goal of a layout: weights of its qualities (0: of no interest), and tolerances that points must keep.

    With tolerances and no number of stations, the fewest stations that keep them are looked for. With a list of points
    the targets are weighed alone unless the file says otherwise.
    """

    instrument: NonNegative = 1.0
    """Weight of the precision of the instrument's parameters."""
    targets: NonNegative = 0.0
    """Weight of the reflectors' point errors."""
    diagnosis: NonNegative = 0.0
    """Weight of the minimal detectable sizes of `effects`."""
    criterion: Literal["D", "A", "E"] = "D"
    """Criterion of the instrument's parameters. D: geometric mean; A: root mean square; E: the worst combination."""
    effects: tuple[str, ...] = (
        "station-weather",
        "range-step",
        "index-drift",
        "station-settling",
        "bearing-wobble",
        "mesh-expansion",
    )
    """Effects that a diagnosis should detect."""
    tolerances: tuple[PointTolerance, ...] = ()
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


class Search(TomlSection):
    """Extent of the search."""

    starts: Annotated[int, Field(ge=1, le=1000)] = 4
    """Independent searches for the plan itself."""
    tradeoff_starts: Annotated[int, Field(ge=1, le=1000)] = 1
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


class PlanFile(TomlSection):
    """The whole file."""

    format: Literal["ltsim-plan/1"] = "ltsim-plan/1"
    """Format and version of this file."""
    title: str = ""
    """Free text."""
    scenario: str = "paper-workshop"
    """A built-in scenario, or a file in the same folder; not with a `[workshop]` of the plan itself."""
    points: str | tuple[Point, ...] = ()
    """Points to measure: the name of a CSV file in the same folder, or tables `[[points]]`."""
    workshop: Workshop | None = None
    """The hall, in place of a scenario, as in a scenario file; heads stand at 1400 to 1800 mm unless
    the floor says so."""
    instrument: ScenarioInstrument | None = None
    """The tracker of that hall, as in a scenario file."""
    smr: Smr | None = None
    """Reflectors, as in a scenario file."""
    work: Work | None = None
    """Order and clock of the work there, as in a scenario file; points as listed unless it says so."""
    air: Air | None = None
    """Uncertainty of the air, where ranges are long: in every figure of the plan; default that of the scenario."""
    floor: Floor = Floor()
    """Allowed and forbidden areas of tripods."""
    stations: Stations = Stations()
    """Number of stations, and the rules that they must keep."""
    reflectors: Reflectors = Reflectors()
    """Candidate places of reflectors."""
    budget: Budget = Budget()
    """Limits on the cost of the work."""
    goal: Goal = Goal()
    """Goal of the layout: weights of qualities, tolerances of points."""
    search: Search = Search()
    """Extent of the search."""

    def with_min_stations(self, least: int) -> PlanFile:
        """The file that asks for `least` stations in sight of each reflector."""
        return self.model_copy(update={"stations": self.stations.model_copy(update={"min_stations_per_target": least})})

    @property
    def asks_for_sights(self) -> bool:
        """True if the file demands a number of stations that see each reflector."""
        return "min_stations_per_target" in self.stations.model_fields_set

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
