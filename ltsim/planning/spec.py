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
"""Name of the walls of the hall in `reflectors.candidate_bodies`, the bodies on which reflectors may be placed."""
MIN_STATIONS, MAX_STATIONS = 2, 40
"""Smallest and largest number of stations of a layout."""
StationCount = Annotated[int, Field(ge=MIN_STATIONS, le=MAX_STATIONS)]
"""Number of stations of a layout."""


class PlanPoint(TomlSection):
    """Point to be measured, in a plan file; with ``points = "points.csv"`` the keys are columns of that file.

    The file is a list of coordinates in any supported format, such as ``Name;X [m];Y [m];Z [m]``.
    """

    name: str
    """Name of the point and of its reflector."""
    x_mm: Finite
    """Coordinate x [mm] in the hall frame."""
    y_mm: Finite
    """Coordinate y [mm] in the hall frame."""
    z_mm: Finite
    """Coordinate z [mm] in the hall frame."""
    group: str = ""
    """Name of the group to which the point belongs; `goal.tolerances` and `reflectors.movable_points` refer to groups.
    """
    weight: NonNegative = 1.0
    """Weight of the squared point error in the objective of the search. In a plan with tolerances the weight is divided
    by the square of the point's tolerance; a point without a tolerance counts as if it had ten times the widest
    tolerance."""
    tolerance_mm: Positive | None = None
    """Largest permitted point error [mm] at the confidence level of the goal."""


class StationSettings(TomlSection):
    """Rules for the stations: number, fixed stations, spacing, number of stations that must see each target."""

    count: StationCount | None = None
    """Number of stations; default the number in the scenario."""
    max_count: StationCount = 8
    """Largest number of stations in the search for the fewest stations that meet the tolerances, if `count` is not
    given."""
    tradeoff_counts: DistinctValues[StationCount] = ()
    """Additional numbers of stations that are searched for the trade-off curve between cost and quality."""
    fixed_stations: DistinctValues[str] = ()
    """Names of stations of the scenario that keep their positions."""
    spacing_mm: Annotated[Finite, Field(ge=1)] = 1000.0
    """Smallest horizontal distance between two stations [mm], at least 1 mm."""
    clearance_mm: NonNegative = 400.0
    """Smallest horizontal distance of a station from bodies between floor and instrument: the room for its stand. The
    default is the radius of the circle through three feet that are 0.7 m apart; stands of trackers need 300 to 500 mm,
    a surveyor's tripod with feet 1 m apart 580 mm. Fixed stations need no clearance, nor does a wall of the hall,
    whose distance is `floor.margin_mm`.
    """
    position_tolerance_mm: NonNegative = 50.0
    """Largest distance [mm] of an instrument from its planned position at which every sight must still be free. The
    plan does not use a sight that is free only from a part of these positions."""
    min_stations_per_target: Literal["all"] | Annotated[int, Field(ge=1, le=MAX_STATIONS)] = "all"
    """Smallest number of stations that must see each reflector; default all stations, or as many as a layout permits.
    """


class CandidateSurface(TomlSection):
    """Flat rectangle with candidate positions (places) of reflectors in rows and columns."""

    name: str
    """Name of the surface; candidate positions on it are called NAME-ROW-COLUMN."""
    origin_mm: Vector
    """Corner of the rectangle [mm], in the hall frame."""
    across_mm: Vector
    """Vector [mm] from the corner along the side in the direction of the rows."""
    up_mm: Vector
    """Vector [mm] from the corner along the side in the direction of the columns."""
    columns: Annotated[int, Field(ge=1, le=200)] = 10
    """Number of candidate positions in each row."""
    rows: Annotated[int, Field(ge=1, le=200)] = 6
    """Number of rows of candidate positions."""


class CandidatePlace(TomlSection):
    """Single candidate position (place) of a reflector."""

    name: str
    """Name of a reflector at this position."""
    position_mm: Vector
    """Coordinates of the position [mm], in the hall frame."""


class ReflectorSettings(TomlSection):
    """Candidate positions of reflectors, and rules for them.

    Without candidate positions no reflector moves; the reflectors of the gauge (at known distances) never move.
    """

    surfaces: tuple[CandidateSurface, ...] = ()
    """Tables `[[reflectors.surfaces]]`: rectangles with a grid of candidate positions."""
    places: tuple[CandidatePlace, ...] = ()
    """Tables `[[reflectors.places]]`: single candidate positions."""
    candidate_bodies: DistinctValues[str] = ()
    """Names of obstacles, or `walls`, on whose surfaces candidate positions are generated."""
    place_spacing_mm: Positive = 1000.0
    """Smallest distance [mm] between candidate positions that are generated on obstacles and walls."""
    standoff_mm: Positive = 40.0
    """Height [mm] of a reflector's centre above the surface on which it may be placed."""
    movable_points: DistinctValues[str] = ()
    """Names of points to measure (`points` of the plan), or of their groups, that could be moved. The search leaves
    them where they are, but the plan reports the benefit of moving each of them."""
    fixed_reflectors: DistinctValues[str] = ()
    """Names of reflectors of the scenario that keep their positions. The points to measure (`points` of the plan) are
    always fixed in the search."""
    spacing_mm: NonNegative = 300.0
    """Smallest distance between two reflectors [mm]."""


class BudgetSettings(TomlSection):
    """Limit of the duration of the measurement, and candidate measuring procedures."""

    faces: Annotated[DistinctValues[Literal[1, 2]], Field(min_length=1)] | None = None
    """Candidate numbers of faces, from which the search selects if `max_hours` or tolerances are given; default 1 and
    2."""
    repeats: Annotated[DistinctValues[Annotated[int, Field(ge=1, le=20)]], Field(min_length=1)] | None = None
    """Candidate numbers of rounds (pointings to each target in each face), from which the search selects if `max_hours`
    or tolerances are given; default 1, 2 and the number in the scenario."""
    seconds_per_pointing: Positive | None = None
    """Time [s] from one pointing to the next; default the time in the scenario."""
    minutes_per_move: NonNegative | None = None
    """Time [min] to set up the instrument at each station, the first included; default the time in the scenario."""
    max_hours: Positive | None = None
    """Longest duration of the whole measurement [h]. Without it and without tolerances, the measuring procedure is that
    of the scenario."""


class PointTolerance(TomlSection):
    """Tolerance for a group of points: largest permitted distance of each point from its true position.

    A point must be within this distance with the probability `goal.confidence_level_pct`. Lengths between points are no
    goal of a plan; `ltsim uncertainty` evaluates them.
    """

    group: str = ""
    """Group in the list of points to which the tolerance applies; empty for all points of the list."""
    tolerance_mm: Positive
    """Largest permitted distance [mm] of a point from its true position, with the mean of all reflectors as datum."""


class GoalSettings(TomlSection):
    """Goal of a layout: weights of its qualities (0 for a quality that does not count), and tolerances of points.

    With tolerances but without a number of stations, the search determines the smallest sufficient number. In a plan
    with a list of points, the default of `targets_weight` is 1, and that of the other weights is 0.
    """

    instrument_weight: NonNegative = 1.0
    """Weight of the precision of the instrument parameters."""
    targets_weight: NonNegative = 0.0
    """Weight of the point errors of the reflectors."""
    diagnosis_weight: NonNegative = 0.0
    """Weight of the minimal detectable sizes of the `effects`."""
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
    """Names of effects that a diagnosis should detect."""
    tolerances: tuple[PointTolerance, ...] = ()
    """Tolerances of groups of points, in tables `[[goal.tolerances]]`; the `tolerance_mm` of a point has priority."""
    confidence_level_pct: Annotated[float, Field(ge=50, le=99.9)] = 95.0
    """Confidence level: percentage of cases in which a point must be within its tolerance."""
    loss_to_withstand: Literal["no", "sight", "station"] = "no"
    """Loss after which the tolerances must still be met: loss of any single `sight`, of any single `station`, or `no`
    loss."""

    @model_validator(mode="after")
    def _check_positive_weight(self) -> GoalSettings:
        if self.instrument_weight + self.targets_weight + self.diagnosis_weight == 0:
            raise ValueError("at least one of instrument_weight, targets_weight and diagnosis_weight should be above 0")
        return self


class SearchSettings(TomlSection):
    """Extent of the search: number of starts, grid of candidate set-ups, seed."""

    starts: Annotated[int, Field(ge=1, le=1000)] = 4
    """Number of independent searches for the planned layout, from different initial layouts."""
    tradeoff_starts: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of independent searches for each point of the trade-off curve except the planned layout."""
    grid_step_mm: Positive | None = None
    """Step [mm] of the grid of candidate positions of stations on the floor; by default the grid has about 250
    positions, at least 500 mm apart. At the end of the search the stations are moved off the grid."""
    yaw_count: Annotated[int, Field(ge=1, le=72)] = 6
    """Number of candidate yaws at each grid position."""
    height_count: Annotated[int, Field(ge=1, le=10)] = 2
    """Number of candidate heights at each grid position."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the random draws of the search."""


class PlanFile(TomlSection):
    """Content of a plan file (format ltsim-plan/1)."""

    format: Literal["ltsim-plan/1"] = "ltsim-plan/1"
    """Format and version of this file."""
    title: str = ""
    """Title of the plan, free text."""
    scenario: str = "paper-workshop"
    """Name of a built-in scenario, or of a scenario file in the same folder; not permitted with a `[workshop]` in the
    plan."""
    points: str | tuple[PlanPoint, ...] = ()
    """Points to measure: the name of a file with a list of coordinates in the same folder, or tables `[[points]]`."""
    workshop: Workshop | None = None
    """Hall of the plan, in place of a scenario, with the keys of the table `[workshop]` of a scenario file; the default
    height of tracker heads is then 1400 to 1800 mm."""
    instrument: ScenarioInstrument | None = None
    """Tracker in the hall that `workshop` describes, with the keys of the table `[instrument]` of a scenario file."""
    smr: Smr | None = None
    """Orientation and range error of the reflectors, with the keys of the table `[smr]` of a scenario file."""
    work: MeasurementProcedure | None = None
    """Order and timing of the measurement, with the keys of the table `[work]` of a scenario file; default order as in
    the list of points."""
    air: AirUncertainty | None = None
    """Uncertainty of the air, which matters for long ranges and is included in all results; default that of the
    scenario."""
    floor: Floor = Floor()
    """Areas where tripods may or may not stand."""
    stations: StationSettings = StationSettings()
    """Number of stations, and rules for their positions."""
    reflectors: ReflectorSettings = ReflectorSettings()
    """Candidate positions of reflectors."""
    budget: BudgetSettings = BudgetSettings()
    """Limit of the duration of the measurement, and candidate measuring procedures."""
    goal: GoalSettings = GoalSettings()
    """Goal of the layout: weights of qualities, tolerances of points."""
    search: SearchSettings = SearchSettings()
    """Extent of the search: number of starts, grid of candidate set-ups, seed."""

    def with_min_stations_per_target(self, min_stations: int) -> PlanFile:
        """Copy of the plan file that requires at least `min_stations` stations to see each reflector."""
        return self.model_copy(
            update={"stations": self.stations.model_copy(update={"min_stations_per_target": min_stations})}
        )

    def without_min_stations_per_target(self) -> PlanFile:
        """Copy of the plan file in which the default number of stations that must see each reflector applies."""
        other_settings = self.stations.model_dump(exclude={"min_stations_per_target"})
        return self.model_copy(update={"stations": StationSettings.model_validate(other_settings)})

    @property
    def gives_min_stations_per_target(self) -> bool:
        """True if the plan file sets how many stations must see each reflector; False if the default applies."""
        return "min_stations_per_target" in self.stations.model_fields_set

    @property
    def chooses_measuring_procedure(self) -> bool:
        """True if the search chooses the numbers of faces and rounds, by `budget.max_hours` or by tolerances."""
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
        """Points to measure; empty as long as the file that `points` names has not been read."""
        return () if isinstance(self.points, str) else self.points
