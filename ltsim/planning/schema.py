"""Entries of plan.json and next.json, for writers and readers."""

from typing import Literal

from pydantic import Field

from ltsim.calibration.schema import Combination
from ltsim.core.arrays import Floats
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.result_file import Entry, Finite, Known, Vector

Qualities = dict[str, Known]


def in_millimetres(place: Floats, decimals: int = 1) -> Vector:
    """A place (3,) [m] as a result file has it."""
    x, y, z = (round(float(v) / MILLIMETRE, decimals) for v in place)
    return x, y, z


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
