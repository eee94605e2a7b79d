"""Functions with which a law is written: changes of readings, constants, stations, targets or noise.

RULES.md has an example.
"""

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
"""Directions upwards (`UP`) and away from the wall (`OUT`)."""
UNTOUCHED_FRACTION = 1e-9
"""Fraction of the largest amount up to which a pointing counts as not changed."""
LAWS = Path(__file__).resolve().parent / "laws"
FRESH, CATALOGUE = "fresh_", "catalogue"
__all__ = [
    "OUT", "UP", "Change", "Draw", "Hall", "gauge", "law", "leans", "level", "moves", "np", "reads", "scatters",
    "shifts", "varies",
]  # fmt: skip


@dataclass(frozen=True)
class Cause:
    """Cause of a recording: changes `parts` at size one, their sizes `values`, and its description for the truth."""

    parts: tuple[Change, ...] = ()
    values: Array = field(default_factory=lambda: np.zeros(0))
    words: dict[str, Any] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    """Names (`names`) and units (`units`) of the parameters of a catalogue effect."""
    units: tuple[str, ...] = ()

    @property
    def change(self) -> Change:
        """Sum of all parts at their sizes."""
        return sum((part.scaled(v) for v, part in zip(self.values.tolist(), self.parts, strict=True)), NOTHING)

    @property
    def truth(self) -> dict[str, Any]:
        """Description of the cause in the truth file, without its strength."""
        listed = zip(self.names, self.values.tolist(), self.units, strict=False)
        parameters = [{"name": n, "value": v, "unit": u} for n, v, u in listed]
        return {"coefficients": len(self.parts)} | self.words | {"parameters": parameters}


@dataclass(frozen=True)
class Law:
    """Law with its name and its regressors.

    `follows` has a tuple of accepted words for each quantity on which the law depends; words in `optional` are also
    accepted in a finding.
    """

    name: str
    text: str
    draw: Callable[[Hall, Draw], Change]
    follows: tuple[tuple[str, ...], ...]
    optional: tuple[str, ...]
    signals: int
    group: str

    def __call__(self, h: Hall, rng: Draw) -> Cause:
        """Cause with drawn constants of the law."""
        change = self.draw(h, rng)
        words = {"text": self.text, "follows": self.follows, "may": self.optional, "group": self.group}
        words["coefficients"] = self.signals
        return Cause((change,), np.ones(1), words | place(h, change))


_REGISTRY: dict[str, Law] = {}


def law(
    *follows: str, may: str = "", signals: int = 1
) -> Callable[[Callable[[Hall, Draw], Change]], Callable[[Hall, Draw], Change]]:
    """Decorator that registers a law with the quantities on which it depends.

    Accepted words for one quantity are separated as in `"time|approach"`; `may` lists further accepted words; `signals`
    is the number of independent signals of which the law is the sum, each with a coefficient. RULES.md lists the
    permitted words; the name of the law is that of the function.
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
    """Laws of the named files; `used` selects all files that are not fresh, `fresh` all fresh files."""
    files = sorted(f.stem for f in LAWS.glob("[a-z]*.py") if f.stem != CATALOGUE)
    of = {"used": [f for f in files if not f.startswith(FRESH)], "fresh": [f for f in files if f.startswith(FRESH)]}
    chosen = [f for g in groups for f in of.get(g, [g])]
    unknown = [g for g in chosen if g not in files]
    if unknown:
        raise ValueError(f"files of laws {', '.join(unknown)} do not exist; choose from {', '.join(files)}")
    for file in chosen:
        import_module(f"{__package__}.laws.{file}")
    return {name: law for name, law in sorted(_REGISTRY.items()) if law.group in chosen}


def reads(h: Hall, observable: str, amount: Array) -> Change:
    """Change of an observable by amounts (n,) [um, urad]; the raw elevation on the back face has the opposite sign."""
    change = np.zeros((h.n, 3))
    column = OBSERVABLES.index(observable)
    change[:, column] = MICRO * amount
    if column == 2:
        change[h.back > 0, 2] *= -1
    return Change(reading=change)


def varies(h: Hall, constant: str, amount: Array) -> Change:
    """Change of a tracker constant (`tracker.CONSTANTS`) by amounts (n,) [um, urad; ppm for range-scale]."""
    change = np.zeros((h.n, len(CONSTANTS)))
    change[:, CONSTANTS.index(constant)] = MICRO * amount
    return Change(constants=change)


def moves(h: Hall, amount: Array, way: Array) -> Change:
    """Motion of the target by amounts (n,) [um] in a direction (3,) or (n, 3) of the hall.

    `h.normal`: out of the nest.
    """
    return Change(target=MICRO * np.asarray(amount)[:, None] * way)


def shifts(h: Hall, amount: Array, way: Array) -> Change:
    """Motion of the stand by amounts (n,) [um] in a direction (3,) or (n, 3) of the hall."""
    return Change(station=MICRO * np.asarray(amount)[:, None] * way)


def leans(h: Hall, amount: Array, about: Array) -> Change:
    """Rotation of the stand by amounts (n,) [urad] about an axis (3,) or (n, 3).

    Horizontal axes tilt it, `UP` turns it.
    """
    return Change(turn=MICRO * np.asarray(amount)[:, None] * about)


def scatters(h: Hall, observables: str, amount: Array) -> Change:
    """Added variance of observables such as `"azimuth elevation"`, by amounts (n,) in units of the declared one."""
    is_changed = np.array([name in observables.split() for name in OBSERVABLES], dtype=np.float64)
    return Change(variance=np.asarray(amount)[:, None] * is_changed)


def gauge(h: Hall, amount: Array) -> Change:
    """Error of the certified reference lengths by amounts (g,) [um]."""
    return Change(lengths=MICRO * np.asarray(amount, dtype=np.float64))


def level(rng: Draw) -> Array:
    """(3,) Random horizontal direction."""
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def carriers(change: Change) -> list[str]:
    """Responses of a change: names of observables, constants of the tracker, station, targets, gauge, noise."""
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
    """Station, tracker or targets to which a change is confined; empty lists for a change that acts everywhere."""
    places: dict[str, list[str]] = {"stations": [], "targets": [], "instruments": []}
    parts = {name: np.abs(part).max(axis=1) for name, part in change.parts.items() if name != "lengths"}
    p, hit = h.pointings, np.zeros(h.n, dtype=bool)
    for amount in parts.values():
        hit |= amount > UNTOUCHED_FRACTION * amount.max()
    stations, trackers, targets = (np.unique(index[hit]) for index in (p.station, p.tracker, p.target))
    if len(stations) == 1:
        places["stations"] = [h.stations[stations[0]]]
    elif len(trackers) < len(h.trackers):
        places["instruments"] = [h.trackers[t] for t in trackers]
    if parts.keys() <= {"target", "variance"} and len(targets) < len(h.targets):
        places["targets"] = [h.targets[t] for t in targets]
    return places
