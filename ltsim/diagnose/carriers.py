"""Carriers: what the forward model knows, and how a reading changes when it does.

Each is a derivative of the readings: of the instrument's constants and pose along the kinematic chain, of the targets'
coordinates, of the structure that carries them, of the air, of the reflector; and, when nothing physical carries a
mismatch, a reading itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.air_gradient import AirGradient
from ltsim.effects.signature import by_displacement, on_readings
from ltsim.effects.smr_centring import reflector_axes
from ltsim.recording.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings
from ltsim.units import ARCSECOND, MICROMETRE, PPM

ANGLE, LENGTH, STRAIN = 2 * ARCSECOND, 10 * MICROMETRE, 2 * PPM
"""Plausible sizes: what a good instrument and a quiet hall leave of an angle, a length, a scale."""


@dataclass(frozen=True)
class Carrier:
    """One quantity of the forward model.

    Attributes
    ----------
    name : str
        In the words of the interface and of sentences.
    unit : str
    size : float
        Plausible size [SI].
    observables : tuple of str
        What it mainly shows in; empty for all.
    kind : str
        reading, instrument, stand, target, structure, air or reflector.
    """

    name: str
    unit: str
    size: float
    observables: tuple[str, ...] = ()
    kind: str = "instrument"


_SLOTS = {
    "elevation": Carrier("vertical index", "urad", ANGLE, ("elevation",)),
    "transit-offset": Carrier("transit offset", "um", LENGTH),
    "transit-tilt": Carrier("transit tilt", "urad", ANGLE, ("azimuth",)),
    "beam-lateral": Carrier("lateral beam offset", "um", LENGTH, ("azimuth",)),
    "beam-vertical": Carrier("vertical beam offset", "um", LENGTH, ("elevation",)),
    "beam-tilt": Carrier("beam tilt", "urad", ANGLE, ("azimuth",)),
    "standing-radial-x": Carrier("stand along x", "um", LENGTH, kind="stand"),
    "standing-radial-y": Carrier("stand along y", "um", LENGTH, kind="stand"),
    "standing-axial": Carrier("stand upwards", "um", LENGTH, kind="stand"),
    "standing-tilt-x": Carrier("stand about x", "urad", ANGLE, kind="stand"),
    "standing-tilt-y": Carrier("stand about y", "urad", ANGLE, kind="stand"),
}
"""Slots of the kinematic chain; the standing axis moves with the stand, along the axes of the instrument."""
_READINGS = tuple(
    Carrier(name, "um" if name == "distance" else "urad", LENGTH if name == "distance" else ANGLE, (name,), "reading")
    for name in OBSERVABLES
)
_SCALE = Carrier("range scale", "ppm", STRAIN, ("distance",))
_MOVES = tuple(Carrier(f"targets along {a}", "um", LENGTH, kind="target") for a in "xyz")
_NORMAL = Carrier("targets along the nest", "um", LENGTH, kind="target")
_FIELDS = tuple((a, b) for a in "xyz" for b in "xyz")
"""Motions of the structure: along one axis, growing along another."""
_AIR = Carrier("air gradient", "K/m", 1.0, kind="air")
_VERTEX = tuple(Carrier(f"reflector {way}", "um", LENGTH, kind="reflector") for way in ("axially", "sideways", "up"))


def _reading(sightings: Sightings, observable: str) -> Floats:
    return on_readings(sightings, **{observable: np.ones(len(sightings))})


def _slot(sightings: Sightings, slot: str) -> Floats:
    return sightings.slot_responses[slot]


def _scale(sightings: Sightings) -> Floats:
    return on_readings(sightings, distance=sightings.range_)


def _moved(sightings: Sightings, axis: int) -> Floats:
    return sightings.by_target[:, :, axis]


def _grown(sightings: Sightings, a: str, b: str) -> Floats:
    """Targets move along `a` by their distance from the middle along `b`."""
    arm = sightings.points[sightings.target] - sightings.points.mean(axis=0)
    moved: Floats = sightings.by_target[:, :, "xyz".index(a)] * arm[:, "xyz".index(b), None]
    return moved


def _air(sightings: Sightings) -> Floats:
    return AirGradient().design(sightings)[:, :, 0]


def _along_nest(sightings: Sightings) -> Floats:
    normal = np.nan_to_num(sightings.nest_normal[sightings.target])
    return by_displacement(sightings, normal[:, :, None])[:, :, 0]


def _vertex(sightings: Sightings, axis: int) -> Floats:
    return by_displacement(sightings, reflector_axes(sightings)[:, :, [axis]])[:, :, 0]


def _field_carrier(a: str, b: str) -> Carrier:
    words = f"structure stretched along {a}" if a == b else f"structure along {a} with {b}"
    return Carrier(words, "ppm", STRAIN, kind="structure")


Derivative = Callable[[Sightings], Floats]


def _registry() -> dict[str, tuple[Carrier, Derivative]]:
    found: list[tuple[Carrier, Derivative]] = [
        *((carrier, partial(_reading, observable=carrier.name)) for carrier in _READINGS),
        *((carrier, partial(_slot, slot=slot)) for slot, carrier in _SLOTS.items()),
        (_SCALE, _scale),
        *((carrier, partial(_moved, axis=i)) for i, carrier in enumerate(_MOVES)),
        *((_field_carrier(a, b), partial(_grown, a=a, b=b)) for a, b in _FIELDS),
        (_AIR, _air),
        (_NORMAL, _along_nest),
        *((carrier, partial(_vertex, axis=i)) for i, carrier in enumerate(_VERTEX)),
    ]
    return {carrier.name: (carrier, derivative) for carrier, derivative in found}


CARRIERS = _registry()
"""Every carrier by name with the change (n, 3) of the raw readings per unit."""
_NEED_NESTS = {c.name for c in (_NORMAL, *_VERTEX)}


def carrier_designs(sightings: Sightings) -> dict[str, tuple[Carrier, Floats]]:
    """Carriers by name with their designs (n, 3); one that equals an earlier one is left out.

    On a single face the vertical index is the elevation, say.
    """
    found: dict[str, tuple[Carrier, Floats]] = {}
    nests = bool(np.isfinite(sightings.nest_normal).any())
    for name, (carrier, derivative) in CARRIERS.items():
        if name in _NEED_NESTS and not nests:
            continue
        design = derivative(sightings)
        same = (np.allclose(np.abs(design), np.abs(other), rtol=1e-9, atol=0.0) for _, other in found.values())
        if design.any() and not any(same):
            found[name] = carrier, design
    return found
