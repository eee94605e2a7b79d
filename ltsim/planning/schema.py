"""plan.json, next.json and the tables beside them: what stands in them, for writers and readers."""

from typing import Any, ClassVar, Literal

from pydantic import Field

from ltsim.arrays import Floats
from ltsim.calibration.schema import Combination
from ltsim.recording.result_file import Entry, Finite, Known, ResultFile, Vector
from ltsim.results import Table, columns_of, numbers, texts
from ltsim.units import MILLIMETRE

Qualities = dict[str, Known]


def in_millimetres(place: Floats, decimals: int = 1) -> Vector:
    """A place (3,) [m] as a result file has it."""
    x, y, z = (round(float(v) / MILLIMETRE, decimals) for v in place)
    return x, y, z


PLACE = numbers(".10g", ".3f", x_mm="place in the workshop, to 0.001 mm", y_mm="as x_mm", z_mm="as x_mm")
STATIONS = Table(
    "stations.csv",
    "where the tripod goes",
    (
        *texts(station="name"),
        *numbers(shown=".0f", x_mm="place in the workshop", y_mm="as x_mm", z_mm="as x_mm"),
        *numbers(shown=".0f", yaw_deg="where azimuth zero looks to"),
        *numbers(sigma_x_um="expected standard deviation", sigma_y_um="as x", sigma_z_um="as x"),
        *numbers(reflectors_seen="how many it sees"),
    ),
)
REFLECTORS = Table(
    "reflectors.csv",
    "reflectors and how well they become known",
    (
        *texts(target="name"),
        *PLACE,
        *numbers(sigma_um="expected, of the point"),
        *numbers(U_x_um="expanded uncertainty, k = 2", U_y_um="as U_x_um", U_z_um="as U_x_um"),
        *numbers(within_mm="distance that its error keeps at the goal's level", tolerance_mm="what that may be"),
        *texts(seen_from="stations that see it"),
    ),
)
PARAMETERS = Table(
    "parameters.csv",
    "how well the instrument becomes known",
    (
        *texts(parameter="name", unit="of the sigmas"),
        *numbers(sigma="expected", sigma_of_own_layout="with the scenario's own stations", prior_sigma="without data"),
        *numbers(gain="share of the prior variance that the data remove"),
    ),
)
VISIBILITY = Table(
    "visibility.csv",
    "which station sees which target",
    (
        *texts(station="name", target="name", sees="yes or no", why_not="what is in the way"),
        *numbers(distance_mm="between them", elevation_deg="of the beam", incidence_deg="on the reflector"),
    ),
)
NOMINALS = Table(
    "nominals.csv",
    "every point in the hall's axes, for the tracker's software",
    (*texts(name="of the point"), *PLACE),
)
WORK = Table(
    "work-order.csv",
    "every pointing in the order of the work, with what the tracker should show",
    (
        *numbers(step="from 1"),
        *texts(station="name", target="name"),
        *numbers(face="1 or 2", round="from 1", minutes="since the first pointing"),
        *numbers(azimuth_deg="expected", elevation_deg="expected", distance_mm="expected"),
    ),
)


class StationEntry(Entry):
    """A place for a tripod."""

    name: str
    """Its name."""
    position_mm: Vector
    """Centre of the head, in the workshop's frame."""
    yaw_deg: Finite
    """Direction of azimuth zero, counter-clockwise from x."""
    sigma_position_um: tuple[Known, ...] = ()
    """Expected, of each coordinate."""
    reflectors_seen: int = 0
    """How many."""


class ReflectorEntry(Entry):
    """A reflector and how well it becomes known."""

    name: str
    """Its name."""
    position_mm: Vector
    """Its place."""
    sigma_um: Known
    """Expected error of the point."""
    u_um: tuple[Known, ...] = Field(default=(), alias="U_um")
    """Expanded uncertainty (k = 2) of x, y and z, datum the mean of all points."""
    stations_seeing: int = 0
    """How many."""
    seen_from: tuple[str, ...] = ()
    """Which."""
    within_mm: Known = None
    """Distance that its error keeps at the goal's level; of points with a tolerance."""
    tolerance_mm: Known = None
    """What it may be."""
    used: Known = None
    """The first over the second."""
    kept: bool | None = None
    """The tolerance is kept; null without any."""


class PlannedParameterEntry(Entry):
    """How well an instrument parameter becomes known."""

    name: str
    """Its name."""
    unit: str = ""
    """Of both sigmas."""
    sigma: Finite
    """Expected."""
    prior_sigma: Finite
    """What is known before."""
    gain: Known = None
    """Share of the prior variance that the readings would remove."""


class ImprovementEntry(Entry):
    """One of the paper's criteria, expected."""

    before_um: Finite
    """Mean."""
    after_um: Finite
    """Mean."""
    improvement_percent: Finite
    """Of the mean."""


class WorkEntry(Entry):
    """A way of working."""

    faces: int = 1
    """One face or both."""
    repeats: int = 1
    """How many rounds."""
    pointings: int = 0
    """How many."""
    hours: Finite
    """What the work takes."""
    quality: Qualities = Field(default_factory=dict)
    """Each that the goal weighs; smaller is better."""


class LayoutEntry(WorkEntry):
    """A layout with what is known of it before measuring."""

    broken_rules: tuple[str, ...] = ()
    """Rules of the plan that it breaks, a sentence each."""
    stations: tuple[StationEntry, ...]
    """Where the tripods go."""
    reflectors: tuple[ReflectorEntry, ...] = ()
    """The mesh."""
    parameters: tuple[PlannedParameterEntry, ...] = ()
    """Of the instrument."""
    undetermined: tuple[Combination, ...] = ()
    """What it would not tell."""
    expected_improvement: dict[str, ImprovementEntry] | None = None
    """By the paper's criteria."""
    not_seen: tuple[str, ...] = ()
    """Which station does not see which reflector, and why."""


class OptionEntry(WorkEntry):
    """One way of working and the best layout found for it."""

    stations: int
    """How many."""
    value: Known = None
    """Its quality as one number; smaller is better."""
    efficient: bool = False
    """Nothing cheaper is as good."""
    layout: tuple[StationEntry, ...] = ()
    """Where the tripods go."""


class DetectableSize(Entry):
    """Smallest size of an effect that a layout would show, at its best and its worst place."""

    effect: str
    """Id of the catalogue."""
    parameter: str = ""
    """Name of the parameter."""
    unit: str = ""
    """Of the sizes."""
    best: Known = None
    """Smallest size found, at the best place or shape."""
    typical: Known = None
    """At the median one."""
    worst: Known = None
    """At the worst one."""
    worst_at: str = ""
    """Which that is."""
    plausible: Finite = 0.0
    """A bad but plausible size."""
    visible: Known = None
    """Median share of its signature that the adjustment leaves."""


class AlikeEntry(Entry):
    """Two effects that a layout can hardly tell apart; `share` of the first's trace is explained by the second."""

    effect: str
    """Id of the catalogue."""
    taken_for: str
    """The effect that explains it too."""
    share: Finite
    """Of the trace that is explained."""


class PlanChange(Entry):
    """One reflector moved, added or left out; `quality` is a factor on the plan's objective."""

    do: Literal["move", "add", "remove"]
    """What is done."""
    words: str = ""
    """What to do and what it brings, for a person."""
    reflector: str = ""
    """Which is moved or left out."""
    place: str = ""
    """Where it goes."""
    position_mm: Vector | None = None
    """Of that place."""
    gain_um: Finite
    """Fall of the point error of all other targets, root mean square, inner constraints; negative: it rises."""
    quality: Finite
    """Factor on the plan's objective, where that is targets alone on the error of all other targets; smaller is better.
    """
    serves: str = ""
    """The parameter, or the target, that gains most, or loses most where a reflector is left out."""
    serves_factor: Finite = 1.0
    """Factor on that one's standard deviation."""

    @property
    def deed(self) -> str:
        """What to do, with the place in metres."""
        if self.position_mm is None:
            return f"leave out {self.reflector}"
        place = f"{self.place} ({', '.join(f'{v / 1000:.2f}' for v in self.position_mm)}) m"
        return f"move {self.reflector} to {place}" if self.reflector else f"add a reflector at {place}"


class LossEntry(Entry):
    """What remains of the tolerances when a station or a sight is lost."""

    lost: str
    """The station, or the sight, in words."""
    kept: bool
    """All tolerances hold."""
    ratio: Known = None
    """Largest error over its tolerance; null where a point has no place any more."""
    worst: str = ""
    """The point with that ratio."""
    unseen: tuple[str, ...] = ()
    """Points with a tolerance that nobody sees any more."""


class PlanResult(ResultFile, LayoutEntry):
    """`plan.json`: from `plan`."""

    FILE: ClassVar[str] = "plan.json"
    format: Literal["ltsim-plan-result/1"] = "ltsim-plan-result/1"
    """Which format and version this file is in."""
    title: str = ""
    """Free text."""
    summary: str
    """The answer in a sentence."""
    reasons: tuple[str, ...] = ()
    """Why."""
    frame: str = ""
    """Of all coordinates."""
    reference: LayoutEntry | None = None
    """The scenario's own layout."""
    fewest_stations: OptionEntry | None = None
    """The fewest that match the scenario's own layout."""
    tradeoff: tuple[OptionEntry, ...] = ()
    """All ways of working that were tried, the cheapest first."""
    starts: tuple[Known, ...] = ()
    """Value that each independent search found."""
    reflector_changes: tuple[PlanChange, ...] = ()
    """One reflector moved, added or left out, the best first."""
    changes_tried: str = ""
    """How many such changes were tried, and how many help."""
    bodies: tuple[str, ...] = ()
    """What stands in the hall: what its file was taken for, its size and its place."""
    reached: bool | None = None
    """The goal is reached: no rule is broken and tolerances are kept, after any one loss too where that is asked for;
    null without any."""
    tolerances_kept: bool | None = None
    """All points keep their tolerances while nothing is lost; null without any."""
    losses: tuple[LossEntry, ...] = ()
    """What remains of the tolerances without each station, and without each sight of such a point."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """The plan file."""
    seed: int | None = None
    """Root of the search."""
    detectable: tuple[DetectableSize, ...] = ()
    """How small effects may be and still be found."""
    alike: tuple[AlikeEntry, ...] = ()
    """Pairs that it could not tell apart."""
    silent: tuple[str, ...] = ()
    """Effects that leave no trace."""


class ProposalEntry(Entry):
    """One further measurement; factors are on standard deviations, `evidence` is chi-square between explanations."""

    do: str
    """What to do, for a person."""
    kind: str = ""
    """What sort of addition it is."""
    minutes: Finite
    """What it takes."""
    sharper: Finite
    """Factor on the standard deviations of the instrument's parameters."""
    serves: str = ""
    """The parameter that gains most."""
    serves_factor: Finite = 1.0
    """Factor on that one's standard deviation."""
    evidence: dict[str, Finite] = Field(default_factory=dict)
    """Expected chi-square against each other explanation."""
    tells_apart: tuple[str, ...] = ()
    """Explanations that it would tell apart."""
    decides: bool = False
    """It tells all of them apart."""
    position_mm: Vector | None = None
    """Of a further station."""
    yaw_deg: Known = None
    """Of a further station."""


class NextFile(ResultFile):
    """`next.json`: from `plan --after`."""

    FILE: ClassVar[str] = "next.json"
    format: Literal["ltsim-next/1"] = "ltsim-next/1"
    """Which format and version this file is in."""
    diagnosis: str = ""
    """What the diagnosis said."""
    between: tuple[str, ...] = ()
    """The explanations to decide between."""
    evidence_now: dict[str, Finite] = Field(default_factory=dict)
    """Chi-square between them as it is."""
    advice: str = ""
    """What to do first, in a sentence."""
    proposals: tuple[ProposalEntry, ...] = Field(min_length=1)
    """The best first."""


TRADEOFF = Table(
    "tradeoff.csv",
    "ways of working, each with the best layout found for it",
    columns_of(OptionEntry, "stations faces repeats pointings hours value efficient"),
)
EFFECTS = Table("effects.csv", "smallest effects that would be found", columns_of(DetectableSize))
NEXT = Table(
    "next.csv",
    "proposals of further measurements, the best first",
    columns_of(
        ProposalEntry,
        "kind minutes sharper serves serves_factor tells_apart decides do",
        tells_apart={"kind": "text"},
        decides={"kind": "text"},
    ),
)
TABLES = (NOMINALS, WORK, STATIONS, REFLECTORS, TRADEOFF, PARAMETERS, VISIBILITY, EFFECTS)
"""Beside plan.json."""
