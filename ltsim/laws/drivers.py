"""Drivers: what a carrier may follow, each as a few columns over the pointings with a prior on their coefficients.

A smooth driver is a Gaussian process in one covariate, in reduced rank: a linear part and the first eigenfunctions of
the Laplacian on the covariate's range with the spectral density of a squared-exponential kernel as variances (Solin and
Sarkka 2020, Hilbert space methods for reduced-rank Gaussian process regression, eq. 20); round a circle, Fourier
waves. Several length scales share the columns and differ in the variances; so does a random walk.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations, combinations_with_replacement, product

import numpy as np
from numpy.typing import NDArray

from ltsim.arrays import Bools, Floats
from ltsim.scene.sightings import Sightings

CLOCKS = ("time", "station-time")
CIRCULAR = ("azimuth", "circle", "bearing", "nest-direction")
MODES, LOW, FINE = 9, 4, 32
"""Eigenfunctions of a smooth driver: of most, of one among several, and of one that is looked at again."""
EDGE = 1.25
"""Half-width of the interval on which eigenfunctions live, over that of the covariate's range: they end beyond it."""
SCALES = {MODES: (0.9, 0.4, 0.18), LOW: (0.6,), FINE: (0.07,)}
"""Length scales, as far as eigenfunctions reach: over the half-width of a covariate's range; of a circle, a radian."""
MEMORY = ("approach-", "move-", "last-", "wound-", "lapse")
"""What names of covariates begin with that tell of the pointing before."""
WORDS = {
    "x": "place",
    "y": "place",
    "z": "place",
    "station-time": "time",
    "repeat": "time",
    "parity": "approach",
    "seating-parity": "approach",
    "bearing": "azimuth",
    "circle": "azimuth",
    "vertical-circle": "elevation",
    "nest-direction": "incidence",
    "air_temperature_c": "temperature",
}
"""Names of the interface for covariates that have others here."""
SIMPLE = {
    "power": lambda x, k: x**k,
    "abs": lambda x, k: np.abs(x),
    "cos": lambda x, k: np.cos(k * x),
    "sin": lambda x, k: np.sin(k * x),
    "tan": lambda x, k: np.tan(k * x),
    "step": lambda x, k: (x > k).astype(np.float64),
    "ramp": lambda x, k: np.maximum(x - k, 0.0),
    "relaxing": lambda x, k: 1.0 / (1.0 + x / k),
    "saturated": lambda x, k: x / (k + np.abs(x)),
    "decay": lambda x, k: np.exp(-x / k),
    "fading": lambda x, k: np.exp(-np.abs(x) / k),
}
"""Functions of a covariate and a constant, of which the shortest laws are made."""


def words_of(names: Iterable[str]) -> tuple[str, ...]:
    """Covariates in the words of the interface."""
    return tuple(dict.fromkeys("approach" if n.startswith(MEMORY) else WORDS.get(n, n) for n in names))


def further(sightings: Sightings) -> list[str]:
    """Columns of the recording beyond the format's that vary."""
    return [name for name, values in sightings.covariates.items() if np.nanstd(values) > 0]


@dataclass(frozen=True)
class Driver:
    """What a carrier follows.

    Attributes
    ----------
    kind : str
        constant, smooth, wave (cosine and sine of `constant` times a covariate), cycle (a wave of any shape), simple,
        product, visits (something else at every set-up), pieces (the sum of steps and ramps of one covariate), or
        field: the same for all, growing across the room, and bent, for what carries targets.
    covariates : tuple of str
    function : str
        Of a simple driver.
    constant : float
        Of a simple driver or a wave; the eigenfunctions of a smooth one; the order of a field.
    factors : tuple of Driver
        Of a product; the pieces.
    around : tuple of str
        Targets about whose middle a field grows; empty for all.
    """

    kind: str
    covariates: tuple[str, ...] = ()
    function: str = ""
    constant: float = 0.0
    factors: tuple[Driver, ...] = ()
    around: tuple[str, ...] = ()

    def columns(self, sightings: Sightings, *, moving: bool = False) -> Floats:
        """Columns (n, k), each of rms about one over the pointings.

        Coordinates are those of some moment: what is `moving` is where it says at the start of the work, or while a
        column of the recording is at its zero, and where there is no such moment in the mean of the work.
        """
        found = self._columns(sightings, moving)
        if not moving or self.kind in ("constant", "field", "product"):
            return found
        found = found - found[self._resting(sightings)].mean(axis=0)
        return _sized(found) if self.kind == "simple" else found

    def _resting(self, sightings: Sightings) -> Bools:
        """The pointings (n,) at which what moves is where its coordinates say."""
        every = np.ones(len(sightings), dtype=bool)
        name = "".join(self.covariates)
        if name == "time" and self.kind in ("simple", "pieces"):
            return np.asarray(sightings.time == sightings.time.min())
        x = np.abs(sightings.covariates.get(name, every))
        return x == np.nanmin(x) if _has_zero(x) else every

    def _columns(self, sightings: Sightings, moving: bool) -> Floats:
        match self.kind:
            case "constant":
                return np.ones((len(sightings), 1))
            case "smooth":
                return _smooth(self.covariates[0], sightings.quantities[self.covariates[0]], int(self.constant))
            case "wave" | "cycle":
                return waves_of(self.constant * sightings.quantities[self.covariates[0]], self.size // 2)
            case "field":
                place = np.stack([sightings.quantities[name] for name in self.covariates], axis=1)
                ids = [i for name in self.around for i in sightings.target_ids[name]]
                near = np.isin(sightings.target, ids) if ids else slice(None)
                place = place - place[near].mean(axis=0)
                place = place / max(float(place[near].std()), 1e-300)
                bent = [place[:, [a]] * place[:, [b]] for a, b in combinations_with_replacement(range(3), 2)]
                return np.hstack([np.ones((len(place), 1)), place, *(bent if self.constant > 1 else [])])
            case "simple":
                x = sightings.quantities[self.covariates[0]]
                if self.function == "power" and self.covariates[0] in sightings.covariates and not _has_zero(x):
                    x = x - x.mean()
                with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                    values = SIMPLE[self.function](x, self.constant)
                return _sized(np.nan_to_num(values, posinf=0.0, neginf=0.0)[:, None])
            case "visits":
                return (sightings.station[:, None] == np.unique(sightings.station)).astype(np.float64)
            case "pieces":
                return np.hstack([factor.columns(sightings) for factor in self.factors])
        found = np.ones((len(sightings), 1))
        for factor in self.factors:
            part = factor.columns(sightings, moving=moving)
            part = np.hstack([np.ones((len(part), 1)), part]) if factor.kind == "smooth" else part
            found = (found[:, :, None] * part[:, None, :]).reshape(len(sightings), -1)
        return found

    @cached_property
    def spreads(self) -> tuple[Floats, ...]:
        """Prior standard deviations (k,) of the coefficients, one set a length scale."""
        match self.kind:
            case "constant" | "simple":
                return (np.ones(1),)
            case "visits" | "pieces":
                return (np.ones(int(self.constant)),)
            case "wave":
                return (np.full(2, np.sqrt(0.5)),)
            case "cycle":
                return (np.repeat(1.0 / np.arange(1, OVERTONES + 1), 2) / np.sqrt(2.0),)
            case "field":
                spread = np.concatenate([np.ones(4), np.full(6 if self.constant > 1 else 0, 0.5)])
                return (spread / np.linalg.norm(spread),)
            case "smooth":
                return _spreads(self.covariates[0] in CIRCULAR, int(self.constant))
        spread = np.ones(1)
        for factor in self.factors:
            part = factor.spreads[0]
            part = np.append(1.0, part) if factor.kind == "smooth" else part
            spread = np.outer(spread, part / np.linalg.norm(part)).ravel()
        return (spread,)

    def about(self, targets: tuple[str, ...]) -> Driver:
        """The driver with the field of some targets in the place of that of the room."""
        if all(f.kind != "field" for f in self.factors):
            return self
        factors = tuple(replace(f, around=targets) if f.kind == "field" else f for f in self.factors)
        return replace(self, factors=factors)

    @property
    def size(self) -> int:
        """Number of columns k."""
        return len(self.spreads[0])

    @property
    def told(self) -> tuple[str, ...]:
        """What it depends on, in the words of the interface."""
        names = [*self.covariates, *(name for factor in self.factors for name in factor.covariates)]
        return words_of([*names, "x"] if self.kind == "visits" else names)


RESTING = 0.02
"""Share of its largest value up to which a column counts as zero."""


def _has_zero(x: Floats) -> bool:
    """Whether a column comes to zero; one that does not is told from its mean (a load, but no temperature, rests)."""
    return bool(np.nanmin(np.abs(x)) < RESTING * np.nanmax(np.abs(x)))


def _sized(column: Floats) -> Floats:
    """A column (n, 1) with an rms of one."""
    size = float(np.sqrt(np.mean(column**2)))
    return column / size if size > 0 else column


OVERTONES = 5
"""Waves of which a cycle of any shape is made."""


def waves_of(phase: Floats, count: int) -> Floats:
    """Cosines and sines (n, 2 count) of a phase (n,) and its multiples."""
    return np.sqrt(2.0) * _turns(phase, count).view(np.float64)


def _turns(phase: Floats, count: int) -> NDArray[np.complex128]:
    """Unit complex numbers (n, count) of a phase (n,) and its multiples: powers of the first."""
    first = np.broadcast_to(np.exp(1j * phase)[:, None], (len(phase), count))
    return np.cumprod(first, axis=1)


def _smooth(name: str, x: Floats, count: int) -> Floats:
    if name in CIRCULAR:
        return waves_of(x, (count + 1) // 2)
    low, high = float(x.min()), float(x.max())
    half = max(0.5 * (high - low), 1e-300)
    u = (x - 0.5 * (low + high)) / half
    waves = _turns(0.5 * np.pi * (u + EDGE) / EDGE, count).imag / np.sqrt(EDGE)
    return np.hstack([np.sqrt(3.0) * u[:, None], np.sqrt(2.0) * waves])


@cache
def _spreads(circular: bool, count: int) -> tuple[Floats, ...]:
    found = []
    if circular:
        orders = np.repeat(np.arange(1, count // 2 + 1 + count % 2), 2)
        found = [np.exp(-0.25 * (orders * scale) ** 2) for scale in SCALES[count]]
    else:
        rates = 0.5 * np.pi * np.arange(1, count + 1) / EDGE
        found = [np.concatenate([[0.5], np.exp(-0.25 * (rates * scale) ** 2)]) for scale in SCALES[count]]
        found += [np.concatenate([[0.5], 1.0 / np.arange(1, count + 1)])] if count != LOW else []
    return tuple(spread / np.linalg.norm(spread) for spread in found)


CONSTANT = Driver("constant")


def across_the_room(drivers: Sequence[Driver], order: int) -> list[Driver]:
    """Drivers whose size may grow across the room, or bend with it."""
    field = Driver("field", ("x", "y", "z"), constant=order)
    return [Driver("product", factors=(driver, field)) for driver in drivers]


def simple(name: str, function: str, constant: float = 1.0) -> Driver:
    """A driver with one column."""
    return Driver("simple", (name,), function, constant)


def pieces(steps: Sequence[Driver]) -> Driver:
    """A driver that is the sum of steps and ramps of one covariate, of any sizes."""
    return Driver("pieces", steps[0].covariates, constant=len(steps), factors=tuple(steps))


def smooth(name: str, modes: int = MODES) -> Driver:
    """A smooth driver."""
    return Driver("smooth", (name,), constant=modes)


_AXES = ("azimuth", "elevation")
_OWN = ("azimuth", "elevation", "distance", "time", "station-time", "height", "bearing")
_CIRCLES = ("circle", "vertical-circle")
_BALL = ("incidence", "nest-direction")
_BEFORE = ("wound-azimuth", "lapse", *(f"{when}-{n}" for when in ("move", "last") for n in (*_AXES, "distance")))


def _varying(sightings: Sightings, names: Iterable[str]) -> list[str]:
    """What of some covariates, and which further columns, vary here."""
    seen = np.isfinite(sightings.incidence).any()
    asked = [n for n in (*names, *further(sightings)) if seen or n not in _BALL]
    asked += _CIRCLES if np.ptp(sightings.face) else ()
    return [n for n in asked if np.ptp(sightings.quantities[n]) > 0]


def covariates_of(sightings: Sightings) -> list[str]:
    """What a smooth driver may follow here."""
    return _varying(sightings, (*_OWN, "x", "y", *_BALL, *_BEFORE))


def general_drivers(sightings: Sightings, modes: int = MODES) -> list[Driver]:
    """Drivers of every carrier: constants, signs, clocks that decay, smooth in every covariate."""
    tried = ["face", "approach-azimuth", "approach-elevation", "parity", "repeat"]
    one, other = (sightings.quantities[name] for name in ("parity", "seating-parity"))
    tried += ["seating-parity"] if abs(one @ other) < len(one) else []
    signs = [s for s in tried if np.ptp(sightings.quantities[s]) > 0]
    found = [CONSTANT, *(simple(name, "power") for name in signs)]
    visits = len(np.unique(sightings.station))
    found += [Driver("visits", constant=visits)] if FEW_VISITS < visits <= MOST_VISITS else []
    for name in CLOCKS:
        span = float(np.ptp(sightings.quantities[name]))
        found += [simple(name, "decay", float(t)) for t in span * np.array([0.03, 0.1, 0.3, 1.0]) if span > 0]
    for name in ("move-azimuth", "move-elevation", "move-distance"):
        if np.ptp(sightings.quantities[name]) > 0:
            found.append(simple(name, "abs"))
    return [*found, *(smooth(name, modes) for name in covariates_of(sightings))]


FEW_VISITS, MOST_VISITS = 3, 12
"""Set-ups beyond and up to which something may be another at each; of few, it is another at one or two of them."""
_MOVES = tuple(f"{when}-{axis}" for when in ("approach", "move", "last") for axis in _AXES)
_HEAD = (*_AXES, *_CIRCLES, "face", "wound-azimuth", *_MOVES)
_TURNS = ("parity", "seating-parity", "repeat")
DRIVES: dict[str, tuple[str, ...]] = {
    "instrument": (*CLOCKS, "lapse", *_HEAD, *_TURNS, "distance", "height", "move-distance", "last-distance"),
    "circle": (*CLOCKS, "lapse", *_TURNS),
    "stand": (*CLOCKS, "lapse", *_AXES, "wound-azimuth", "distance"),
    "target": ("time", *_TURNS),
    "reflector": ("time", "lapse", *_TURNS, *_BALL),
    "air": CLOCKS,
}
"""What each kind of carrier can follow beside columns of the recording: a wall does not know where a tracker looks; its
stand does, for a head is never quite in balance, and the floor gives under whoever holds the reflector."""
FOLLOWED = tuple(dict.fromkeys((*_OWN, "x", "y", "z", *_BALL, *_BEFORE, *_HEAD, *_TURNS)))
"""Everything that a reading can follow beside columns of the recording."""


def moves(kind: str, driver: Driver, sightings: Sightings) -> bool:
    """Whether a driver can move a kind of carrier; a reading may err with anything."""
    names = [*driver.covariates, *(n for f in driver.factors if f.kind != "field" for n in f.covariates)]
    return kind == "reading" or all(n in DRIVES[kind] or n in sightings.covariates for n in names)


def products(sightings: Sightings) -> Iterator[Driver]:
    """Products of two drivers: a sign and a smooth one, and two smooth ones in different covariates."""
    names = _varying(sightings, (*_OWN, *_BALL))
    for sign in ("face", "approach-azimuth", "approach-elevation"):
        if np.ptp(sightings.quantities[sign]) > 0:
            for name in names:
                yield Driver("product", factors=(simple(sign, "power"), smooth(name, LOW)))
    weights = [simple("distance", "power"), simple("elevation", "power")]
    weights += [smooth("lapse", LOW)] if np.ptp(sightings.quantities["lapse"]) > 0 else []  # a move is forgotten
    moved = [f"move-{axis}" for axis in (*_AXES, "distance")]
    for length, function, weight in product(moved, ("abs", "power"), weights):
        if np.ptp(sightings.quantities[length]) > 0:
            yield Driver("product", factors=(simple(length, function), weight))
    for one, other in combinations(names, 2):
        if {one, other} not in ({"time", "station-time"}, {"azimuth", "bearing"}) and other not in _CIRCLES:
            yield Driver("product", factors=(smooth(one, LOW), smooth(other, LOW)))


WAVE_STEP = 0.6
"""Step of the rates tried for a wave, in cycles over the covariate's span: no rate lies far from one that is tried."""
MOST_CYCLES = 60


def rates(sightings: Sightings, name: str, most: float) -> Floats:
    """Rates of waves in a covariate with up to `most` cycles over its span."""
    span = float(np.ptp(sightings.quantities[name]))
    return 2 * np.pi * np.arange(1.0, most, WAVE_STEP) / span if span > 0 else np.zeros(0)


def waves(sightings: Sightings, *, visits: bool = False) -> Iterator[Driver]:
    """Waves in clock, range, angles and place; of one of the `visits`, in its clock."""
    most = min(len(sightings) / 8, MOST_CYCLES)
    if visits:
        for rate in rates(sightings, "station-time", most / len(sightings.station_names)):
            yield Driver("wave", ("station-time",), constant=float(rate))
        return
    for name in ("time", "distance", "azimuth", "elevation", "x", "y", "z", "station-time"):
        for rate in rates(sightings, name, most):
            yield Driver("wave", (name,), constant=float(rate))
