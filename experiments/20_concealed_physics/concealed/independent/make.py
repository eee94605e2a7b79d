"""A recording with something hidden in it, by this simulator alone, and the truth that is sealed apart from it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import brentq

from ltsim.recording import Recording

from . import eighth, eleventh, laws as sixth, ninth, seventh, tenth, twelfth
from .cause import CARRIERS, Cause
from .hall import LENGTH_SIGMA, Hall, draw_hall
from .known import KNOWN, Known
from .network import Network
from .tracker import NOTHING, Array, Change, within_a_turn

SETS = {
    "sixth": sixth.LAWS,
    "seventh": seventh.LAWS,
    "eighth": eighth.LAWS,
    "ninth": ninth.LAWS,
    "tenth": tenth.LAWS,
    "eleventh": eleventh.LAWS,
    "twelfth": twelfth.LAWS,
}
"""Which laws are drawn."""
TRIES = 60
ABSURD = {"reading": 300e-6, "target": 600e-6, "station": 600e-6, "turn": 300e-6, "constants": 300e-6, "variance": 50.0}
"""[m, rad] Causes as large as this would be seen by eye, and are not drawn."""
STRIDE = 7
"""From law to law, so that the first few are of every kind; it shares no factor with the number of laws."""
SMALLEST, LARGEST = -4.0, 4.0
"""Decades of the size that are tried."""
Draw = np.random.Generator


@dataclass(frozen=True)
class Made:
    """A recording, its truth, the same recording without noise and cause, and what the cause changes (n, 3)."""

    recording: Recording
    truth: dict[str, Any]
    silent: Recording
    change: Array


def make(kind: str, strength: int, number: int, draw: Draw, noise: Draw, laws: str = "sixth") -> Made:
    """Hide a cause of a kind in a hall.

    Parameters
    ----------
    kind : str
        `clean`, `single` (a catalogued cause) or `unknown`.
    strength : int
        Noncentrality that the network's least squares leaves.
    number : int
        Laws and causes take turns by it.
    draw, noise : numpy.random.Generator
        Of hall and cause, and of the noise.
    laws : str
        The set that an unknown law is drawn from.
    """
    excluded: Counter[str] = Counter()
    hall, network, cause, change, name = _drawn(kind, strength, number, draw, excluded, laws)
    standard = network.noise(noise)
    spread = hall.sigma if change.variance is None else hall.sigma * np.sqrt(1.0 + change.variance)
    quiet = hall.pointings.readings(change)
    recording = hall.recording(quiet + spread * standard[0], hall.lengths + LENGTH_SIGMA * standard[1])
    told = cause.parts if isinstance(cause, Known) else (change,) if cause else ()
    truth = {
        "effects": [] if cause is None else [_entry(name, cause, change, network)],
        "nearest_known": None,
        "targets_mm": dict(zip(hall.targets, (1e3 * hall.pointings.points).tolist(), strict=True)),
        "told_um": network.target_error(standard, change, told),
        "ordinary_um": network.target_error(standard, change),
        "stations": len(hall.stations),
        "faces": int(hall.pointings.face.max()),
        "pointings": len(recording),
        "simulator": "independent",
        "excluded": dict(excluded),
    }
    silent = hall.recording(network.base, hall.lengths)
    difference = quiet - network.base
    difference[:, 1] = within_a_turn(difference[:, 1])
    return Made(recording, truth, silent, difference)


def _drawn(
    kind: str, strength: int, number: int, rng: Draw, excluded: Counter[str], laws: str
) -> tuple[Hall, Network, Known | Cause | None, Change, str]:
    """A hall and a cause of the wanted strength that acts in it; halls that were thrown away are counted."""
    causes: dict[str, Any] = KNOWN if kind == "single" else SETS[laws]
    name = list(causes)[STRIDE * number % len(causes)] if kind != "clean" else ""
    for _ in range(TRIES):
        hall = draw_hall(rng)
        network = Network.of(hall)
        if not name:
            return hall, network, None, NOTHING, name
        try:
            cause = causes[name](hall, rng)
        except LookupError:
            excluded["no second tracker, no such column, or two faces"] += 1
            continue
        whole = cause.change() if isinstance(cause, Known) else cause.change
        size = _size(network, whole, strength)
        change = whole.scaled(size)
        if size and all(np.abs(part).max() < ABSURD[k] for k, part in vars(change).items() if part is not None):
            if isinstance(cause, Known):
                cause = replace(cause, values=size * cause.values)
            return hall, network, cause, change, name
        excluded["hidden by the network" if not size else "absurdly large"] += 1
    raise RuntimeError(f"no hall was found where '{name}' has a strength of {strength} at a sensible size")


def _size(network: Network, change: Change, wanted: float) -> float:
    """Factor at which a change has the wanted strength; 0 where none has."""

    def miss(decade: float) -> float:
        return float(np.log(max(network.strength(change.scaled(10**decade)), 1e-30) / wanted))

    if miss(LARGEST) <= 0.0:
        return 0.0
    return float(10 ** brentq(miss, SMALLEST, LARGEST, xtol=1e-4))


def _entry(name: str, cause: Known | Cause, change: Change, network: Network) -> dict[str, Any]:
    """What was hidden, in the words of the examination."""
    entry: dict[str, Any] = {
        "stations": list(cause.stations),
        "targets": list(cause.targets),
        "observables": list(cause.observables),
        "strengths": network.strengths(change).tolist(),
    }
    entry["strength"] = sum(entry["strengths"])
    if isinstance(cause, Known):
        units = cause.unit.split() if " " in cause.unit else [cause.unit] * len(cause.names)
        listed = zip(cause.names, cause.values.tolist(), units, strict=True)
        parameters = [{"name": n, "value": v, "unit": u} for n, v, u in listed]
        return entry | {
            "effect": name,
            "text": f"{name} {cause.stations} {cause.targets}",
            "covariates": [],
            "parameters": parameters,
            "shape": cause.shape,
            "words": {},
        }
    largest = max(float(np.abs(part).max()) for part in vars(change).values() if part is not None)
    return entry | {
        "effect": "unknown",
        "text": f"Unknown(law='{name}')",
        "covariates": list(cause.drivers),
        "parameters": [{"name": "size", "value": largest, "unit": ""}],
        "shape": {},
        "told_as": {"carrier": CARRIERS[cause.carrier], "driver": cause.drivers},
        "words": {"carrier": cause.carrier, "driver": " or ".join(cause.drivers), "place": cause.place},
    }
