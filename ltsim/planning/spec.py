"""Content of a plan file (format ltsim-plan/1): hall, rules for stations and reflectors, budget, goal, search."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from ltsim.recordings.air import AirUncertainty
from ltsim.recordings.keys import DistinctValues
from ltsim.recordings.setup import Finite, NonNegative, Positive, TomlSection, Vector
from ltsim.scene.floor import Floor
from ltsim.simulation.sections import MeasurementProcedure, ScenarioInstrument, Smr, Workshop

WALLS_NAME = "walls"
"""Name of the walls of the hall in the list of bodies on which reflectors may be placed."""
StationCount = Annotated[int, Field(ge=2, le=40)]
"""Number of stations, 2 to 40."""


class PlanPoint(TomlSection):
    """Point to be measured, of a plan file; with ``points = "points.csv"`` these keys are columns of the file.

    The file is a list of coordinates in any supported format, such as ``Name;X [m];Y [m];Z [m]``.
    """

    name: str
    """Name of the point, which its reflector gets."""
    x_mm: Finite
    """Coordinate x in the hall frame."""
    y_mm: Finite
    """Coordinate y in the hall frame."""
    z_mm: Finite
    """Coordinate z in the hall frame."""
    group: str = ""
    """Group of the point, to which `goal.tolerances` and `reflectors.movable_points` refer."""
    weight: NonNegative = 1.0
    """Weight of the squared point error in the objective of the search. In a plan with tolerances the weight is divided
    by the square of the point's tolerance; for a point without a tolerance, ten times the widest tolerance is used.
    """
    tolerance_mm: Positive | None = None
    """Largest permitted point error, at the confidence level of the goal."""


class StationSettings(TomlSection):
    """Number of stations, numbers for the trade-off curve, fixed stations, and rules for the positions of stations."""

    count: StationCount | None = None
    """Number of stations; default that of the scenario."""
    max_count: StationCount = 8
    """Largest number of stations of the search for the fewest stations that meet the tolerances, if no count is given.
    """
    tradeoff_counts: DistinctValues[StationCount] = ()
    """Further numbers of stations that are searched, for the curve of cost against quality."""
    fixed_stations: DistinctValues[str] = ()
    """Stations of the scenario that do not move."""
    spacing_mm: Annotated[Finite, Field(ge=1)] = 1000.0
    """Smallest horizontal distance between two stations, at least 1 mm."""
    clearance_mm: NonNegative = 400.0
    """Smallest horizontal distance of a station from bodies between floor and instrument: the room for its stand. The
    default is the radius of the circle through three feet that are 0.7 m apart; stands of trackers need 300 to 500 mm,
    a surveyor's tripod with feet 1 m apart 580 mm. Fixed stations need no clearance, nor does a wall of the hall,
    whose distance is `floor.margin_mm`.
    """
    position_tolerance_mm: NonNegative = 50.0
    """Largest distance of an instrument from its planned position at which every sight must still be free; a sight that
    is not is marginal, and the plan does not count it.
    """
    min_stations_per_target: Literal["all"] | Annotated[int, Field(ge=1, le=40)] = "all"
    """Smallest number of stations that must see each reflector; default all, or the most that any layout permits."""


class CandidateSurface(TomlSection):
    """Flat rectangle with candidate positions (places) of reflectors in rows and columns, by a corner and two sides."""

    name: str
    """Name of the surface; candidate positions on it are called NAME-ROW-COLUMN."""
    origin_mm: Vector
    """Corner of the rectangle in the hall frame."""
    across_mm: Vector
    """Side of the rectangle along the rows, as a vector from the corner."""
    up_mm: Vector
    """Side of the rectangle along the columns, as a vector from the corner."""
    columns: Annotated[int, Field(ge=1, le=200)] = 10
    """Number of candidate positions in each row."""
    rows: Annotated[int, Field(ge=1, le=200)] = 6
    """Number of rows of candidate positions."""


class CandidatePlace(TomlSection):
    """Single candidate position (place) of a reflector."""

    name: str
    """Name that a reflector at this position gets."""
    position_mm: Vector
    """Coordinates of the position in the hall frame."""


class ReflectorSettings(TomlSection):
    """Candidate positions of the reflectors. Without candidates no reflector moves; those of the gauge never move."""

    surfaces: tuple[CandidateSurface, ...] = ()
    """Tables `[[reflectors.surfaces]]`: rectangles with a grid of candidate positions."""
    places: tuple[CandidatePlace, ...] = ()
    """Tables `[[reflectors.places]]`: single candidate positions."""
    candidate_bodies: DistinctValues[str] = ()
    """Names of obstacles, or `walls`, on whose surfaces candidate positions are generated."""
    place_spacing_mm: Positive = 1000.0
    """Smallest distance between candidate positions that are generated on obstacles and walls."""
    standoff_mm: Positive = 40.0
    """Height of a reflector's centre above the surface on which it may be placed."""
    movable_points: DistinctValues[str] = ()
    """Names of points to measure (`points` of the plan), or of their groups, that could be moved. The search does not
    move them, but the plan reports the benefit of moving each.
    """
    fixed_reflectors: DistinctValues[str] = ()
    """Names of reflectors of the scenario that do not move. The points to measure, `points` of the plan, never move."""
    spacing_mm: NonNegative = 300.0
    """Smallest distance between two reflectors."""


class BudgetSettings(TomlSection):
    """Duration of the measurement, and candidate measuring procedures."""

    faces: Annotated[DistinctValues[Literal[1, 2]], Field(min_length=1)] | None = None
    """Candidate numbers of faces, used with `max_hours` or tolerances; default one face and both."""
    repeats: Annotated[DistinctValues[Annotated[int, Field(ge=1, le=20)]], Field(min_length=1)] | None = None
    """Candidate numbers of rounds, used with `max_hours` or tolerances; default 1 and 2, and that of the scenario."""
    seconds_per_pointing: Positive | None = None
    """Time from one pointing to the next; default that of the scenario."""
    minutes_per_move: NonNegative | None = None
    """Time to set up the instrument at each station, the first included; default that of the scenario."""
    max_hours: Positive | None = None
    """Longest duration of the whole measurement [h]; without it and without tolerances, the procedure of the scenario
    is used.
    """


class PointTolerance(TomlSection):
    """Tolerance for points: each point of a group must be within a distance of its true position.

    It must be within this distance with the probability `confidence_level_pct` of the goal. Tolerances of lengths
    between points are not goals of a plan; `ltsim uncertainty` evaluates them.
    """

    group: str = ""
    """Group in the list of points to which the tolerance applies; default all points of the list."""
    tolerance_mm: Positive
    """Largest permitted distance of a point from its true position, with the mean of all reflectors as datum."""


class GoalSettings(TomlSection):
    """Goal of a layout: weights of its qualities (0 for a quality that does not count), and tolerances of points.

    With tolerances but without a number of stations, the search determines the smallest sufficient number. In a plan
    with a list of points, the default weights are 1 for `targets_weight` and 0 for the two others.
    """

    instrument_weight: NonNegative = 1.0
    """Weight of the precision of the instrument parameters."""
    targets_weight: NonNegative = 0.0
    """Weight of the reflectors' point errors."""
    diagnosis_weight: NonNegative = 0.0
    """Weight of the minimal detectable sizes of `effects`."""
    criterion: Literal["D", "A", "E"] = "D"
    """Optimality criterion of the instrument parameters, from their standard deviations in prior sigmas. D: geometric
    mean over all combinations; A: root mean square over the parameters; E: worst combination."""
    effects: DistinctValues[str] = (
        "station-weather",
        "range-step",
        "index-drift",
        "station-settling",
        "bearing-wobble",
        "mesh-expansion",
    )
    """Effects that a diagnosis should detect."""
    tolerances: tuple[PointTolerance, ...] = ()
    """Tolerances of groups of points, tables `[[goal.tolerances]]`; the `tolerance_mm` of a point has priority."""
    confidence_level_pct: Annotated[float, Field(ge=50, le=99.9)] = 95.0
    """Confidence level: percentage of cases in which a point must be within its tolerance."""
    loss_to_withstand: Literal["no", "sight", "station"] = "no"
    """Loss after which the tolerances must still be met: of any single `sight` or `station`, or `no` loss."""

    @model_validator(mode="after")
    def _check_positive_weight(self) -> GoalSettings:
        if self.instrument_weight + self.targets_weight + self.diagnosis_weight == 0:
            raise ValueError("at least one of instrument_weight, targets_weight and diagnosis_weight should be above 0")
        return self


class SearchSettings(TomlSection):
    """Extent of the search: number of starts, grid of candidate set-ups, seed."""

    starts: Annotated[int, Field(ge=1, le=1000)] = 4
    """Number of independent searches, from different initial layouts, for the plan."""
    tradeoff_starts: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of independent searches for each other point of the trade-off curve."""
    grid_step_mm: Positive | None = None
    """Step of the grid of candidate positions of stations on the floor; default about 250 positions, at least 500 mm
    apart. The stations are moved off the grid at the end of the search.
    """
    yaw_count: Annotated[int, Field(ge=1, le=72)] = 6
    """Number of candidate yaws at each grid position."""
    height_count: Annotated[int, Field(ge=1, le=10)] = 2
    """Number of candidate heights at each grid position."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the random draws of the search."""


class PlanFile(TomlSection):
    """Contents of a plan file."""

    format: Literal["ltsim-plan/1"] = "ltsim-plan/1"
    """Format and version of this file."""
    title: str = ""
    """Title of the plan, free text."""
    scenario: str = "paper-workshop"
    """Built-in scenario, or a file in the same folder; not permitted with a `[workshop]` in the plan."""
    points: str | tuple[PlanPoint, ...] = ()
    """Points to measure: the name of a file with a list of coordinates in the same folder, or tables `[[points]]`."""
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
    """Number of stations, and rules for their positions."""
    reflectors: ReflectorSettings = ReflectorSettings()
    """Candidate positions of reflectors."""
    budget: BudgetSettings = BudgetSettings()
    """Duration of the measurement, and candidate measuring procedures."""
    goal: GoalSettings = GoalSettings()
    """Goal of the layout: weights of qualities, tolerances of points."""
    search: SearchSettings = SearchSettings()
    """Extent of the search: number of starts, grid of candidate set-ups, seed."""

    def with_min_stations(self, min_stations: int) -> PlanFile:
        """Copy of the plan file that requires at least `min_stations` stations to see each reflector."""
        return self.model_copy(
            update={"stations": self.stations.model_copy(update={"min_stations_per_target": min_stations})}
        )

    @property
    def gives_min_stations(self) -> bool:
        """True if the file itself gives the number of stations that must see each reflector."""
        return "min_stations_per_target" in self.stations.model_fields_set

    @property
    def chooses_procedure(self) -> bool:
        """True if the search chooses faces and rounds: within `budget.max_hours`, or the fastest within tolerances."""
        return self.budget.max_hours is not None or self.has_tolerances

    @property
    def has_tolerances(self) -> bool:
        """True if the goal or a listed point gives a tolerance."""
        return bool(self.goal.tolerances) or any(point.tolerance_mm is not None for point in self.listed_points)

    @property
    def searches_station_count(self) -> bool:
        """True if the search determines the smallest number of stations with which the tolerances are met."""
        return self.has_tolerances and self.stations.count is None

    @property
    def listed_points(self) -> tuple[PlanPoint, ...]:
        """Points of the list; empty before its file has been read."""
        return () if isinstance(self.points, str) else self.points
