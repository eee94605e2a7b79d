"""plan.json, next.json and the tables beside them: what stands in them, for writers and readers."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from ltsim.calibrate.schema import CombinationEntry
from ltsim.recording.result_file import Entry, Finite, Known, ResultFile, Vector
from ltsim.recording.result_table import ResultTable, numbers, texts

Qualities = dict[str, Known]

STATIONS = ResultTable(
    "stations.csv",
    "where the tripod goes",
    (
        *texts(station="name"),
        *numbers(x_mm="place in the workshop", y_mm="as x_mm", z_mm="as x_mm", yaw_deg="where azimuth zero looks to"),
        *numbers(sigma_x_um="expected standard deviation", sigma_y_um="as x", sigma_z_um="as x"),
    ),
)
REFLECTORS = ResultTable(
    "reflectors.csv",
    "reflectors and how well they become known",
    (
        *texts(target="name"),
        *numbers(x_mm="place in the workshop", y_mm="as x_mm", z_mm="as x_mm", sigma_um="expected, rms of the axes"),
    ),
)
TRADEOFF = ResultTable(
    "tradeoff.csv",
    "ways of working, each with the best layout found for it",
    (
        *numbers(stations="how many", faces="1 or 2", repeats="rounds", pointings="how many", hours="of work"),
        *numbers(value="objective, smaller is better"),
        *texts(efficient="True where nothing as cheap is better"),
    ),
)
PARAMETERS = ResultTable(
    "parameters.csv",
    "how well the instrument becomes known",
    (
        *texts(parameter="name", unit="of the sigmas"),
        *numbers(sigma="expected", sigma_of_own_layout="with the scenario's own stations", prior_sigma="without data"),
        *numbers(gain="share of the prior variance that the data remove"),
    ),
)
VISIBILITY = ResultTable(
    "visibility.csv",
    "which station sees which target",
    (
        *texts(station="name", target="name", sees="yes or no", why_not="what is in the way"),
        *numbers(distance_mm="between them", elevation_deg="of the beam", incidence_deg="on the reflector"),
    ),
)
EFFECTS = ResultTable(
    "effects.csv",
    "smallest effects that would be found",
    (
        *texts(effect="id", parameter="name", unit="of the sizes"),
        *numbers(best="at the best place", typical="at a place in the middle", worst="at the worst place"),
        *texts(worst_at="which that is"),
        *numbers(plausible="sigma of what is to be expected", visible="median share of its signature that is left"),
    ),
)
NEXT = ResultTable(
    "next.csv",
    "proposals of further measurements, the best first",
    (
        *texts(kind="of measurement"),
        *numbers(minutes="of work", sharper="mean factor on the sigmas of the instrument's parameters"),
        *texts(serves="the parameter it serves most"),
        *numbers(serves_factor="factor on that one's sigma"),
        *texts(tells_apart="effects that it tells from the first", decides="True where all are told apart", do="words"),
    ),
)
TABLES = (STATIONS, REFLECTORS, TRADEOFF, PARAMETERS, VISIBILITY, EFFECTS)


class PlaceEntry(Entry):
    """A place for a tripod."""

    name: str
    position_mm: Vector
    yaw_deg: Finite


class StationEntry(PlaceEntry):
    """Where a tripod goes."""

    sigma_position_um: tuple[Known, ...] = ()
    reflectors_seen: int = 0


class ReflectorEntry(Entry):
    """A reflector and how well it becomes known."""

    name: str
    position_mm: Vector
    sigma_um: Known
    stations_seeing: int = 0


class ParameterEntry(Entry):
    """How well an instrument parameter becomes known."""

    name: str
    unit: str = ""
    sigma: Finite
    prior_sigma: Finite
    gain: Known = None


class ImprovementEntry(Entry):
    """One of the paper's criteria, expected."""

    before_um: Finite
    after_um: Finite
    improvement_percent: Finite


class LayoutEntry(Entry):
    """A layout with what is known of it before measuring."""

    allowed: bool = True
    hours: Finite
    pointings: int = 0
    faces: int = 1
    repeats: int = 1
    quality: Qualities = Field(default_factory=dict)
    stations: tuple[StationEntry, ...]
    reflectors: tuple[ReflectorEntry, ...] = ()
    parameters: tuple[ParameterEntry, ...] = ()
    undetermined: tuple[CombinationEntry, ...] = ()
    expected_improvement: dict[str, ImprovementEntry] | None = None
    not_seen: tuple[str, ...] = ()


class OptionEntry(Entry):
    """One way of working and the best layout found for it."""

    stations: int
    faces: int
    repeats: int
    pointings: int
    hours: Finite
    value: Known = None
    quality: Qualities = Field(default_factory=dict)
    efficient: bool = False
    layout: tuple[PlaceEntry, ...] = ()


class DetectableSize(Entry):
    """Smallest size of an effect that a layout would show, at its best and its worst place."""

    effect: str
    parameter: str = ""
    unit: str = ""
    best: Known = None
    typical: Known = None
    worst: Known = None
    worst_at: str | None = None
    plausible: Finite = 0.0
    visible: Known = Field(None, description="Median share of its signature that the adjustment leaves.")


class AlikeEntry(Entry):
    """Two effects that a layout can hardly tell apart; `share` of the first's trace is explained by the second."""

    effect: str
    taken_for: str
    share: Finite


class ChangeEntry(Entry):
    """One reflector moved, added or left out; `quality` is a factor on the plan's objective."""

    do: str
    reflector: str = ""
    place: str = ""
    position_mm: Vector | None = None
    gain_um: Finite = Field(description="Fall of the point error of all other targets, root mean square.")
    quality: Finite
    serves: str = ""
    serves_factor: Finite = 1.0


class PlanResult(ResultFile, LayoutEntry):
    """`plan.json`: from `plan`."""

    FILE: ClassVar[str] = "plan.json"
    format: Literal["ltsim-plan-result/1"] = "ltsim-plan-result/1"
    title: str = ""
    summary: str
    reasons: tuple[str, ...] = ()
    frame: str = ""
    reference: LayoutEntry | None = None
    fewest_stations: OptionEntry | None = None
    tradeoff: tuple[OptionEntry, ...] = ()
    starts: tuple[Known, ...] = ()
    reflector_changes: tuple[ChangeEntry, ...] = ()
    settings: dict[str, Any] = Field(default_factory=dict)
    seed: int | None = None
    detectable: tuple[DetectableSize, ...] = ()
    alike: tuple[AlikeEntry, ...] = ()
    silent: tuple[str, ...] = ()


class ProposalEntry(Entry):
    """One further measurement; factors are on standard deviations, `evidence` is chi-square between explanations."""

    do: str
    kind: str = ""
    minutes: Finite
    sharper: Finite
    serves: str = ""
    serves_factor: Finite = 1.0
    evidence: dict[str, Finite] = Field(default_factory=dict)
    tells_apart: tuple[str, ...] = ()
    decides: bool = False
    position_mm: Vector | None = None
    yaw_deg: Known = None


class NextFile(ResultFile):
    """`next.json`: from `plan --after`."""

    FILE: ClassVar[str] = "next.json"
    format: Literal["ltsim-next/1"] = "ltsim-next/1"
    diagnosis: str = ""
    between: tuple[str, ...] = ()
    evidence_now: dict[str, Finite] = Field(default_factory=dict)
    advice: str = ""
    proposals: tuple[ProposalEntry, ...] = Field(min_length=1)
