"""Plan file (ltsim-plan/1): hall, degrees of freedom, goal, and budget."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from ltsim.recordings.air import AirUncertainty
from ltsim.recordings.setup import Finite, NonNegative, Positive, TomlSection, Vector
from ltsim.scene.floor import Floor
from ltsim.simulation.sections import MeasurementProcedure, ScenarioInstrument, Smr, Workshop

WALLS_NAME = "walls"
"""Name of the walls of the hall in the list of bodies on which reflectors may be placed."""
StationCount = Annotated[int, Field(ge=2, le=40)]
"""Number of stations, 2 to 40."""


class PointEntry(TomlSection):
    """Point to be measured; with ``points = "points.csv"`` these keys are columns of the file.

    The file is a list of coordinates in any supported format, such as ``Name;X [m];Y [m];Z [m]``.
    """

    name: str
    """Name of the point."""
    x_mm: Finite
    """Coordinate x in the hall frame."""
    y_mm: Finite
    """Coordinate y in the hall frame."""
    z_mm: Finite
    """Coordinate z in the hall frame."""
    group: str = ""
    """Group of the point, used by tolerances."""
    weight: NonNegative = 1.0
    """Weight of the squared point error in the objective of the search. In a plan with tolerances the weight is divided
    by the square of the point's tolerance; for a point without a tolerance, ten times the widest tolerance is used.
    """
    tolerance_mm: Positive | None = None
    """Largest permitted point error, at the confidence level of the goal."""


class StationSettings(TomlSection):
    """Number of stations, numbers for the trade-off curve, fixed stations, and rules of their positions.

    Every sight must be free for an instrument up to `position_tolerance_mm` from its planned position.
    """

    count: StationCount | None = None
    """Number of stations; default that of the scenario."""
    max_count: StationCount = 8
    """Largest number of stations of the search for the fewest stations that meet the tolerances, if no count is given.
    """
    tradeoff_counts: tuple[StationCount, ...] = ()
    """Further numbers of stations that are searched, for the curve of cost against quality."""
    fixed: tuple[str, ...] = ()
    """Stations of the scenario that do not move."""
    spacing_mm: Annotated[Finite, Field(ge=1)] = 1000.0
    """Smallest horizontal distance between two stations, at least 1 mm."""
    position_tolerance_mm: NonNegative = 50.0
    """Largest distance of an instrument from its planned position at which every sight must still be free."""
    min_stations_per_target: Literal["all"] | Annotated[int, Field(ge=1, le=40)] = "all"
    """Smallest number of stations that see each reflector; default all, or the largest number that a layout permits."""


class CandidateSurface(TomlSection):
    """Flat rectangle with candidate places of reflectors in rows and columns, given by a corner and two sides."""

    name: str
    """Name of the surface; its places are called NAME-ROW-COLUMN."""
    origin_mm: Vector
    """Corner of the rectangle."""
    across_mm: Vector
    """Side of the rectangle along the rows, as a vector from the corner."""
    up_mm: Vector
    """Side of the rectangle along the columns, as a vector from the corner."""
    columns: Annotated[int, Field(ge=1, le=200)] = 10
    """Number of places in a row."""
    rows: Annotated[int, Field(ge=1, le=200)] = 6
    """Number of rows."""


class CandidatePlace(TomlSection):
    """Candidate place of a reflector."""

    name: str
    """Name that a reflector at this place gets."""
    position_mm: Vector
    """Coordinates of the place."""


class ReflectorSettings(TomlSection):
    """Candidate places of the reflectors. Without candidates no reflector moves; those of the gauge never move."""

    surfaces: tuple[CandidateSurface, ...] = ()
    """Tables `[[reflectors.surfaces]]`: surfaces with a grid of candidate places."""
    places: tuple[CandidatePlace, ...] = ()
    """Tables `[[reflectors.places]]`: single candidate places."""
    on: tuple[str, ...] = ()
    """Names of obstacles, or `walls`, on whose surfaces candidate places are generated."""
    place_spacing_mm: Positive = 1000.0
    """Smallest distance between generated places."""
    standoff_mm: Positive = 40.0
    """Height of a reflector's centre above the surface on which it may be placed."""
    movable: tuple[str, ...] = ()
    """Points of the list, or groups of them, that could be moved. The search does not move them, but the plan reports
    the benefit of moving each.
    """
    keep: tuple[str, ...] = ()
    """Reflectors of the scenario that do not move; the points of a list never move."""
    spacing_mm: NonNegative = 300.0
    """Smallest distance between two reflectors."""


class BudgetSettings(TomlSection):
    """Cost of the measurement, and candidate procedures; default times are those of the scenario."""

    faces: Annotated[tuple[Literal[1, 2], ...], Field(min_length=1)] | None = None
    """Candidate numbers of faces, with `hours` or tolerances; default one face and both."""
    repeats: Annotated[tuple[Annotated[int, Field(ge=1, le=20)], ...], Field(min_length=1)] | None = None
    """Numbers of rounds to choose from, used with `hours` or tolerances; default 1 and 2."""
    seconds_per_pointing: Positive | None = None
    """Time from one pointing to the next."""
    minutes_per_move: NonNegative | None = None
    """Time to move the instrument to the next station."""
    hours: Positive | None = None
    """Longest duration of the whole measurement [h]; without it and without tolerances, the procedure of the scenario
    is used.
    """


class PointTolerance(TomlSection):
    """Tolerance for points: each point of a group must be within a distance of its true position.

    The probability is the confidence level of the goal. Tolerances of lengths between points are not goals of a plan;
    `ltsim uncertainty` evaluates them.
    """

    group: str = ""
    """Group in the list of points; default all points of the list."""
    within_mm: Positive
    """Largest distance of a point from its true position, with the mean of all reflectors as datum."""


class GoalSettings(TomlSection):
    """Goal of a layout: weights of its qualities (0 for a quality that does not count), and tolerances of points.

    With tolerances and without a number of stations, the smallest sufficient number is searched. With a list of points
    the default is a weight for the targets alone.
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
    """Tables `[[goal.tolerances]]`; a tolerance of a single point in the list of points has priority."""
    level_pct: Annotated[float, Field(ge=50, le=99.9)] = 95.0
    """Confidence level: percentage of cases in which a point must be within its tolerance."""
    robust: Literal["no", "sight", "station"] = "no"
    """Loss after which the tolerances must still be met: any single sight, any single station, or none."""

    @model_validator(mode="after")
    def _check_any_weight(self) -> GoalSettings:
        if self.instrument + self.targets + self.diagnosis == 0:
            raise ValueError("it should give a weight above 0 to at least one of instrument, targets and diagnosis")
        return self


class SearchSettings(TomlSection):
    """Extent of the search."""

    starts: Annotated[int, Field(ge=1, le=1000)] = 4
    """Number of independent searches for the plan."""
    tradeoff_starts: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of independent searches for each other point of the trade-off curve."""
    grid_mm: Positive | None = None
    """Step of the grid of candidate places on the floor; default about 250 places, at least 500 mm apart. The stations
    are moved off the grid at the end of the search.
    """
    yaws: Annotated[int, Field(ge=1, le=72)] = 6
    """Number of candidate yaws at each place."""
    heights: Annotated[int, Field(ge=1, le=10)] = 2
    """Number of candidate heights at each place."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Root of the random draws of the search."""


class PlanFile(TomlSection):
    """Contents of a plan file."""

    format: Literal["ltsim-plan/1"] = "ltsim-plan/1"
    """Format and version of this file."""
    title: str = ""
    """Free text."""
    scenario: str = "paper-workshop"
    """Built-in scenario, or a file in the same folder; not permitted with a `[workshop]` in the plan."""
    points: str | tuple[PointEntry, ...] = ()
    """Points to measure: the name of a CSV file in the same folder, or tables `[[points]]`."""
    workshop: Workshop | None = None
    """Hall in place of a scenario, with the keys of a scenario file; the default height of heads is 1400 to 1800 mm."""
    instrument: ScenarioInstrument | None = None
    """Tracker for this hall, with the keys of a scenario file."""
    smr: Smr | None = None
    """Reflectors, with the keys of a scenario file."""
    work: MeasurementProcedure | None = None
    """Order and timing of the measurement, with the keys of a scenario file; the default order is as listed."""
    air: AirUncertainty | None = None
    """Uncertainty of the air for long ranges, included in all results; default that of the scenario."""
    floor: Floor = Floor()
    """Areas where tripods may or may not stand."""
    stations: StationSettings = StationSettings()
    """Number of stations, and their rules."""
    reflectors: ReflectorSettings = ReflectorSettings()
    """Candidate places of reflectors."""
    budget: BudgetSettings = BudgetSettings()
    """Limits on the cost of the measurement."""
    goal: GoalSettings = GoalSettings()
    """Goal of the layout: weights of qualities, tolerances of points."""
    search: SearchSettings = SearchSettings()
    """Extent of the search."""

    def with_min_stations(self, min_stations: int) -> PlanFile:
        """Plan file that requires `min_stations` stations for each reflector."""
        return self.model_copy(
            update={"stations": self.stations.model_copy(update={"min_stations_per_target": min_stations})}
        )

    @property
    def requires_sights(self) -> bool:
        """True if the file requires a number of stations that see each reflector."""
        return "min_stations_per_target" in self.stations.model_fields_set

    @property
    def chooses_procedure(self) -> bool:
        """True if the search chooses the procedure: by a budget of hours, or the fastest that meets the tolerances."""
        return self.budget.hours is not None or self.searches_station_count

    @property
    def searches_station_count(self) -> bool:
        """True if the smallest number of stations that meets the tolerances is searched."""
        has_tolerances = bool(self.goal.tolerances) or any(
            point.tolerance_mm is not None for point in self.listed_points
        )
        return has_tolerances and self.stations.count is None

    @property
    def listed_points(self) -> tuple[PointEntry, ...]:
        """Points of the list, after its file has been read."""
        return () if isinstance(self.points, str) else self.points
