"""How a law is written: what it turns, moves or scatters, by how much at every pointing. RULES.md has an example."""

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from .hall import Draw, Hall
from .tracker import CONSTANTS, NOTHING, Array, Change

OBSERVABLES = ("distance", "azimuth", "elevation")
MICRO = 1e-6
UP, OUT = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
"""Upwards, and away from the wall."""
UNTOUCHED = 1e-9
"""Share of the largest amount below which a pointing is not touched."""
LAWS = Path(__file__).resolve().parent / "laws"
FRESH, CATALOGUE = "fresh_", "catalogue"
__all__ = [
    "OUT", "UP", "Change", "Draw", "Hall", "gauge", "law", "leans", "level", "moves", "np", "reads", "scatters",
    "shifts", "varies",
]  # fmt: skip


@dataclass(frozen=True)
class Cause:
    """What is hidden in a hall: changes at one unit each, how many units of each, and the truth in words."""

    parts: tuple[Change, ...] = ()
    values: Array = field(default_factory=lambda: np.zeros(0))
    words: dict[str, Any] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    """Parameters of an effect of the catalogue, and their units."""
    units: tuple[str, ...] = ()

    @property
    def change(self) -> Change:
        """All parts together."""
        return sum((part.scaled(v) for v, part in zip(self.values.tolist(), self.parts, strict=True)), NOTHING)

    @property
    def truth(self) -> dict[str, Any]:
        """What is sealed of it, but for its strength."""
        listed = zip(self.names, self.values.tolist(), self.units, strict=False)
        parameters = [{"name": n, "value": v, "unit": u} for n, v, u in listed]
        return {"coefficients": len(self.parts)} | self.words | {"parameters": parameters}


@dataclass(frozen=True)
class Law:
    """A law with its name and what it follows: a tuple of alternatives each; `optional` ones need not be told."""

    name: str
    text: str
    draw: Callable[[Hall, Draw], Change]
    follows: tuple[tuple[str, ...], ...]
    optional: tuple[str, ...]
    signals: int
    group: str

    def __call__(self, h: Hall, rng: Draw) -> Cause:
        """The law with its constants drawn."""
        change = self.draw(h, rng)
        words = {"text": self.text, "follows": self.follows, "may": self.optional, "group": self.group}
        words["coefficients"] = self.signals
        return Cause((change,), np.ones(1), words | place(h, change))


_REGISTRY: dict[str, Law] = {}


def law(
    *follows: str, may: str = "", signals: int = 1
) -> Callable[[Callable[[Hall, Draw], Change]], Callable[[Hall, Draw], Change]]:
    """Declare a law that follows all of these covariates, alternatives as `"time|approach"`; `may`: it may be told too.

    `signals`: the number of independent signals of which the law is the sum, each with a coefficient.
    The words are those of RULES.md; the law's name is the function's.
    """

    def keep(draw: Callable[[Hall, Draw], Change]) -> Callable[[Hall, Draw], Change]:
        name, group = draw.__name__.replace("_", "-"), draw.__module__.rpartition(".")[2]
        if name in _REGISTRY and _REGISTRY[name].group != group:
            raise ValueError(f"two laws are called {name}: in {_REGISTRY[name].group} and in {group}")
        items = tuple(tuple(item.split("|")) for item in follows)
        _REGISTRY[name] = Law(name, (draw.__doc__ or "").strip(), draw, items, tuple(may.split()), signals, group)
        return draw

    return keep


def laws_of(groups: tuple[str, ...]) -> dict[str, Law]:
    """Laws of the files that are named, `used` for all that are not fresh, `fresh` for all that are."""
    files = sorted(f.stem for f in LAWS.glob("[a-z]*.py") if f.stem != CATALOGUE)
    of = {"used": [f for f in files if not f.startswith(FRESH)], "fresh": [f for f in files if f.startswith(FRESH)]}
    chosen = [f for g in groups for f in of.get(g, [g])]
    unknown = [g for g in chosen if g not in files]
    if unknown:
        raise ValueError(f"there is no file of laws called {', '.join(unknown)}; there are {', '.join(files)}")
    for file in chosen:
        import_module(f"{__package__}.laws.{file}")
    return {name: law for name, law in sorted(_REGISTRY.items()) if law.group in chosen}


def reads(h: Hall, observable: str, amount: Array) -> Change:
    """A reading changes by amounts (n,) [um, urad]; the raw elevation of the back face runs backwards by itself."""
    change = np.zeros((h.n, 3))
    column = OBSERVABLES.index(observable)
    change[:, column] = MICRO * amount
    if column == 2:
        change[h.back > 0, 2] *= -1
    return Change(reading=change)


def varies(h: Hall, constant: str, amount: Array) -> Change:
    """A constant of the tracker, one of `tracker.CONSTANTS`, varies by amounts (n,) [um, urad; of range-scale ppm]."""
    change = np.zeros((h.n, len(CONSTANTS)))
    change[:, CONSTANTS.index(constant)] = MICRO * amount
    return Change(constants=change)


def moves(h: Hall, amount: Array, way: Array) -> Change:
    """The target moves by amounts (n,) [um] along a way (3,) or (n, 3) in the room, `h.normal` for out of its nest."""
    return Change(target=MICRO * np.asarray(amount)[:, None] * way)


def shifts(h: Hall, amount: Array, way: Array) -> Change:
    """The stand moves by amounts (n,) [um] along a way (3,) or (n, 3) in the room."""
    return Change(station=MICRO * np.asarray(amount)[:, None] * way)


def leans(h: Hall, amount: Array, about: Array) -> Change:
    """The stand turns by amounts (n,) [urad] about an axis (3,) or (n, 3) in the room: level ones lean, `UP` turns."""
    return Change(turn=MICRO * np.asarray(amount)[:, None] * about)


def scatters(h: Hall, observables: str, amount: Array) -> Change:
    """Variance is added to readings, such as `"azimuth elevation"`, by amounts (n,) in units of the stated one."""
    is_changed = np.array([name in observables.split() for name in OBSERVABLES], dtype=np.float64)
    return Change(variance=np.asarray(amount)[:, None] * is_changed)


def gauge(h: Hall, amount: Array) -> Change:
    """The certificate of the known lengths is wrong by amounts (g,) [um]."""
    return Change(lengths=MICRO * np.asarray(amount, dtype=np.float64))


def level(rng: Draw) -> Array:
    """(3,) A level direction."""
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def carriers(change: Change) -> list[str]:
    """What a change turns, moves or scatters: readings, constants of the tracker, station, targets, gauge, noise."""
    responses = []
    for name, part in change.parts.items():
        columns = np.flatnonzero(np.abs(part).max(axis=0)).tolist()
        names = {"reading": OBSERVABLES, "constants": CONSTANTS}.get(name)
        response_names = {
            "target": "targets",
            "station": "station",
            "turn": "station",
            "variance": "noise",
            "lengths": "gauge",
        }
        responses += [names[c] for c in columns] if names else [response_names[name]]
    return sorted(set(responses))


def place(h: Hall, change: Change) -> dict[str, list[str]]:
    """One station, one of two trackers, or some targets that a change is confined to; otherwise everywhere."""
    places: dict[str, list[str]] = {"stations": [], "targets": [], "instruments": []}
    parts = {name: np.abs(part).max(axis=1) for name, part in change.parts.items() if name != "lengths"}
    p, hit = h.pointings, np.zeros(h.n, dtype=bool)
    for amount in parts.values():
        hit |= amount > UNTOUCHED * amount.max()
    stations, trackers, targets = (np.unique(index[hit]) for index in (p.station, p.tracker, p.target))
    if len(stations) == 1:
        places["stations"] = [h.stations[stations[0]]]
    elif len(trackers) < len(h.trackers):
        places["instruments"] = [h.trackers[t] for t in trackers]
    if parts.keys() <= {"target", "variance"} and len(targets) < len(h.targets):
        places["targets"] = [h.targets[t] for t in targets]
    return places
