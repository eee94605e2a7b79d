"""Entries of plan.json and next.json, for writers and readers."""

from typing import Literal

from pydantic import Field

from ltsim.calibration.schema import Combination
from ltsim.core.arrays import Floats
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, Positive, Vector

Qualities = dict[str, OptionalFloat]


def in_millimetres(place: Floats, decimals: int = 1) -> Vector:
    """A place (3,) [m] as a result file has it."""
    x, y, z = (round(float(v) / MILLIMETRE, decimals) for v in place)
    return x, y, z


class StationEntry(Entry):
    """A place for a tripod."""

    name: str
    """Name of the station."""
    position_mm: Vector
    """Centre of the head, in the workshop's frame."""
    yaw_deg: Finite
    """Direction of azimuth zero, counter-clockwise from x."""
    sigma_position_um: tuple[OptionalFloat, ...] = ()
    """Expected standard deviation of x, y and z."""
    visible_reflectors: int = 0
    """Number of reflectors that the station sees."""


class ReflectorEntry(Entry):
    """A reflector with its expected precision."""

    name: str
    """Name of the reflector."""
    position_mm: Vector
    """Centre of the reflector, in the workshop's frame."""
    sigma_um: OptionalFloat
    """Expected standard deviation of the point: square root of the trace of its covariance."""
    u_um: tuple[OptionalFloat, ...] = Field(default=(), alias="U_um")
    """Expanded uncertainty (k = 2) of x, y and z, datum the mean of all points."""
    stations_seeing: int = 0
    """Number of stations that see the reflector."""
    visible_from: tuple[str, ...] = ()
    """Names of the stations that see the reflector."""
    within_mm: OptionalFloat = None
    """Distance that the point error does not exceed at the confidence level of the goal; of points with a tolerance."""
    tolerance_mm: OptionalFloat = None
    """Tolerance of the point error."""
    used: OptionalFloat = None
    """Point error over its tolerance: `within_mm` / `tolerance_mm`; 1 at the limit."""
    met: bool | None = None
    """True where the tolerance is kept; null without any."""


class PlannedParameterEntry(Entry):
    """An instrument parameter with its expected precision."""

    name: str
    """Name of the parameter."""
    unit: str = ""
    """Unit of both standard deviations."""
    sigma: Finite
    """Expected standard deviation after calibration."""
    prior_sigma: Positive
    """Standard deviation before any reading."""
    gain: OptionalFloat = None
    """Share of the prior variance that the readings would remove."""


class ImprovementEntry(Entry):
    """Expected improvement of a criterion of the paper."""

    before_um: Finite
    """Expected mean before calibration."""
    after_um: Finite
    """Expected mean after calibration."""
    improvement_percent: Finite
    """Reduction of the mean by the calibration."""


class WorkEntry(Entry):
    """A way of working."""

    faces: int = 1
    """Number of faces: 1 or 2."""
    repeats: int = 1
    """Number of rounds."""
    pointings: int = 0
    """Number of pointings."""
    hours: Finite
    """Duration of the whole work [h]."""
    quality: Qualities = Field(default_factory=dict)
    """Qualities that the goal weighs, by name; smaller is better."""


class LayoutEntry(WorkEntry):
    """A layout with its expected precision, before measuring."""

    broken_rules: tuple[str, ...] = ()
    """Rules of the plan that it breaks, a sentence each."""
    stations: tuple[StationEntry, ...]
    """Places of the tripods."""
    reflectors: tuple[ReflectorEntry, ...] = ()
    """Reflectors of the mesh."""
    parameters: tuple[PlannedParameterEntry, ...] = ()
    """Instrument parameters with their expected precision."""
    undetermined: tuple[Combination, ...] = ()
    """Undetermined combinations of instrument parameters."""
    expected_improvement: dict[str, ImprovementEntry] | None = None
    """Expected improvement, by the paper's criteria."""
    blocked_sights: tuple[str, ...] = ()
    """Sights that are not possible: station, reflector and reason, a sentence each."""


class OptionEntry(WorkEntry):
    """A way of working with the best layout found for it."""

    stations: int
    """Number of stations."""
    value: OptionalFloat = None
    """Objective of the layout; smaller is better."""
    efficient: bool = False
    """True where no cheaper way of working is as good."""
    layout: tuple[StationEntry, ...] = ()
    """Places of the tripods."""


class DetectableSize(Entry):
    """Minimal detectable size of an effect in a layout, at its best and its worst place."""

    effect: str
    """Identifier of the effect in the catalogue."""
    parameter: str = ""
    """Name of the parameter."""
    unit: str = ""
    """Unit of the sizes."""
    best: OptionalFloat = None
    """Minimal detectable size at the best place or shape."""
    typical: OptionalFloat = None
    """Minimal detectable size at the median place or shape."""
    worst: OptionalFloat = None
    """Minimal detectable size at the worst place or shape."""
    worst_at: str = ""
    """Worst place or shape: station, target or shape."""
    plausible: Finite = 0.0
    """A large but plausible size of the effect."""
    visible: OptionalFloat = None
    """Median share of the effect's signature that remains in the residuals."""


class ConfusablePair(Entry):
    """Two effects that a layout can hardly distinguish; `share` of the first's signature is explained by the second."""

    effect: str
    """Identifier of the effect in the catalogue."""
    taken_for: str
    """Identifier of the effect that explains its signature too."""
    share: Finite
    """Share of the signature that the second effect explains; 1 for all of it."""


class PlanChange(Entry):
    """Change of one reflector: moved, added or omitted; `quality` is a factor on the plan's objective."""

    do: Literal["move", "add", "remove"]
    """Type of the change."""
    words: str = ""
    """Change and its benefit, as a sentence."""
    reflector: str = ""
    """Name of the reflector that is moved or left out."""
    place: str = ""
    """Name of the new place."""
    position_mm: Vector | None = None
    """Coordinates of the new place."""
    gain_um: Finite
    """Fall of the point error of all other targets, root mean square, inner constraints; negative: it rises."""
    quality: Finite
    """Factor on the plan's objective, where that is targets alone on the error of all other targets; smaller is better.
    """
    serves: str = ""
    """The parameter, or the target, that gains most, or loses most where a reflector is left out."""
    serves_factor: Finite = 1.0
    """Factor on the standard deviation of that parameter or target; below 1: it falls."""

    @property
    def deed(self) -> str:
        """Change in words, with the place in metres."""
        if self.position_mm is None:
            return f"leave out {self.reflector}"
        place = f"{self.place} ({', '.join(f'{v / 1000:.2f}' for v in self.position_mm)}) m"
        return f"move {self.reflector} to {place}" if self.reflector else f"add a reflector at {place}"


class LossEntry(Entry):
    """Tolerances after the loss of a station or a sight."""

    lost: str
    """Lost station or sight, in words."""
    met: bool
    """True where all tolerances hold after the loss."""
    ratio: OptionalFloat = None
    """Largest point error over its tolerance; null where a point is no longer determined."""
    worst: str = ""
    """The point with that ratio."""
    unseen: tuple[str, ...] = ()
    """Points with a tolerance that no station sees any more."""


class ProposalEntry(Entry):
    """Further measurement; factors are on standard deviations, `evidence` is chi-square between explanations."""

    do: str
    """Action in words."""
    kind: str = ""
    """Kind of measurement: pointings, return, station, survey, length or reflectors."""
    minutes: Finite
    """Duration of the work [min]."""
    sharper: Finite
    """Factor on the mean standard deviation of the instrument's parameters (geometric mean); below 1 is better."""
    serves: str = ""
    """The parameter that gains most."""
    serves_factor: Finite = 1.0
    """Factor on the standard deviation of that parameter; below 1 is better."""
    evidence: dict[str, Finite] = Field(default_factory=dict)
    """Expected difference of chi-square between the first explanation and each other one, by name."""
    distinguishes: tuple[str, ...] = ()
    """Explanations that the measurement would distinguish from the first."""
    decides: bool = False
    """True where it would distinguish all of them from the first."""
    position_mm: Vector | None = None
    """Position of the head at a new set-up, in the workshop's frame; null for other measurements."""
    yaw_deg: OptionalFloat = None
    """Direction of azimuth zero at a new set-up; null for other measurements."""
