"""Content of an input file of GNU Gama, before it is a recording."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from ltsim.core.units import MILLIMETRE
from ltsim.recordings.pointings import Observed, numbered
from ltsim.recordings.setup import GaugeDistance, KnownDifference, Vector

FIXED_MM = 1e-4
"""Standard deviation of a fixed coordinate."""


@dataclass
class GamaPoint:
    """A point of the file: coordinates [m] by axis, and the axes that are fixed, of the datum, or used."""

    values: dict[str, float] = field(default_factory=dict)
    fixed: str = ""
    datum: str = ""
    active: str = ""
    sigma: float = FIXED_MM
    covariance: tuple[float, ...] | None = None
    """xx, xy, xz, yy, yz, zz [mm^2]."""

    @property
    def place(self) -> Vector | None:
        """Coordinates [mm], where all three are there."""
        return self.known if len(self.values) == 3 else None

    @property
    def known(self) -> Vector:
        """Coordinates [mm], 0 for what is not there."""
        x, y, z = (round(self.values.get(axis, 0.0) / MILLIMETRE, 9) for axis in "xyz")
        return x, y, z


@dataclass
class GamaNetwork:
    """Content read so far."""

    file: Path
    title: str = ""
    y_sign: float = 1.0
    angle_sign: float = -1.0
    stdev: dict[str, str] = field(default_factory=dict)
    points: dict[str, GamaPoint] = field(default_factory=dict)
    sets: Counter[str] = field(default_factory=Counter)
    over: dict[str, str] = field(default_factory=dict)
    north: float = 0.0  # [deg] counter-clockwise from x
    oriented: set[str] = field(default_factory=set)  # set-ups of azimuths: their circles are zero in the north
    observed: list[Observed] = field(default_factory=list)
    apriori: float = 10.0  # [mm, cc] standard deviation of unit weight
    differences: list[KnownDifference] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    shared: int = 0  # number of errors that observations share
    notes: list[str] = field(default_factory=list)

    def station(self, point: str, *, with_directions: bool = False) -> str:
        """Name of the set-up over a point; further sets of directions get further set-ups."""
        self.sets[point] += with_directions
        name = numbered(point, max(self.sets[point] - 1, 0))
        self.over[name] = point
        return name


def take_plan(network: GamaNetwork) -> None:
    """Leave out what concerns heights that are neither fixed nor adjusted, and hold those heights, as Gama does."""
    flat = {name for name, point in network.points.items() if point.active == "xy"}
    if not flat:
        return
    kept = []
    for o in network.observed:
        in_plan = bool({network.over[o.station], o.target} & flat)
        if not in_plan or o.kind == "azimuth" or o.horizontal:
            kept.append(replace(o, instrument_height=0.0, target_height=0.0) if in_plan else o)
    joined = [one for one in network.differences if not ({one.from_, one.to} & flat and one.known_axes == "z")]
    count = len(network.observed) - len(kept) + len(network.differences) - len(joined)
    network.differences = [
        one.model_copy(update={"known_axes": "xy"}) if {one.from_, one.to} & flat else one for one in joined
    ]
    for name in flat:
        network.points[name].values.setdefault("z", 0.0)
        network.points[name].fixed += "z"
    network.notes.append(
        f'{len(flat)} points are adjusted in plan only (adj="xy"): they have no heights, and '
        f"{count} observations that need heights are left out, as Gama does"
    )
    network.observed = kept


def lengths_of(network: GamaNetwork) -> tuple[list[GaugeDistance], list[Observed]]:
    """Slope distances from points where nothing else is measured, between marks that others see: known lengths."""
    angles = {o.station for o in network.observed if o.kind != "distance" or o.horizontal}
    seen = {o.target for o in network.observed if o.station in angles}
    gauge, rest = [], []
    for o in network.observed:
        start = network.over[o.station]
        if o.station in angles or start == o.target or not {start, o.target} <= seen or any(o.heights) or o.shared:
            rest.append(o)
        else:
            length = {"length_mm": o.value / MILLIMETRE, "sigma_mm": o.sigma / MILLIMETRE}
            gauge.append(GaugeDistance.model_validate({"from": start, "to": o.target, **length}))
    return gauge, rest


def named(differences: list[KnownDifference]) -> Iterator[KnownDifference]:
    """The differences, with a number where several join the same points, as a line that was levelled twice."""
    before: Counter[str] = Counter()
    for one in differences:
        number = before[one.called]
        before[one.called] += 1
        yield one.model_copy(update={"name": numbered(one.called, number)}) if number else one
