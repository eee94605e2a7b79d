"""Responses: quantities of the forward model that may change, and the derivatives of readings with respect to them.

They are the instrument's constants along the kinematic chain, rotation and translation of a stand, coordinates of
targets, air, reflector and, if no physical quantity explains a mismatch, a reading itself. A motion in space in any
direction is one response, not three.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import ARCSECOND, FACTOR, MICROMETRE, PPM
from ltsim.physics.effects import BASELINE
from ltsim.physics.effects.air_gradient import AirGradient
from ltsim.physics.effects.azimuth_eccentricity import AzimuthEccentricity
from ltsim.physics.effects.effect import Term
from ltsim.physics.effects.elevation_eccentricity import ElevationEccentricity
from ltsim.physics.effects.motions import station_design
from ltsim.physics.effects.signature import by_displacement, on_readings
from ltsim.physics.effects.smr_centring import reflector_axes
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

ANGLE, LENGTH, STRAIN, MOTION = 2 * ARCSECOND, 10 * MICROMETRE, 2 * PPM, 30 * MICROMETRE
"""Plausible sizes of remaining errors of a good instrument (angle, length, scale), and of motions
of walls and floors.
"""


@dataclass(frozen=True)
class ResponseTerm:
    """Response: quantity of the forward model that an effect may change.

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
        reading, instrument, circle, stand, target, air or reflector.
    ways : tuple of str
        Its components in words; one of no name where it has no direction.
    scales : tuple of float
        Change [SI] of each component per unit of its coefficient; empty for ones.
    units : tuple of str
        Units of the components; empty where all have that of the response.
    """

    name: str
    unit: str
    size: float
    observables: tuple[str, ...] = ()
    kind: str = "instrument"
    ways: tuple[str, ...] = ("",)
    scales: tuple[float, ...] = ()
    units: tuple[str, ...] = ()

    def display(self, way: int) -> tuple[str, float]:
        """Unit of a component, and factor from its coefficient [SI] to that unit."""
        unit, scale = (self.units[way], self.scales[way]) if self.units else (self.unit, 1.0)
        return unit, scale / FACTOR[unit]


_SLOTS = {
    "elevation": ResponseTerm("vertical index", "urad", ANGLE, ("elevation",)),
    "transit-offset": ResponseTerm("transit offset", "um", LENGTH),
    "transit-tilt": ResponseTerm("transit tilt", "urad", ANGLE, ("azimuth",)),
    "beam-lateral": ResponseTerm("lateral beam offset", "um", LENGTH, ("azimuth",)),
    "beam-vertical": ResponseTerm("vertical beam offset", "um", LENGTH, ("elevation",)),
    "beam-tilt": ResponseTerm("beam tilt", "urad", ANGLE, ("azimuth",)),
}
"""Responses that are slots of the kinematic chain."""
_CIRCLES = {
    ResponseTerm(
        f"{effect.observables[0]} eccentricity", "urad", ANGLE, effect.observables, "circle", ("cosine", "sine")
    ): effect
    for effect in (AzimuthEccentricity(), ElevationEccentricity())
}
"""Responses of circles whose centre is off their axis."""
_READINGS = tuple(
    ResponseTerm(
        name, "um" if name == "distance" else "urad", LENGTH if name == "distance" else ANGLE, (name,), "reading"
    )
    for name in OBSERVABLES
)
_SIZE = {"distance": LENGTH, "azimuth": ANGLE, "elevation": ANGLE}
_TOGETHER = tuple(
    ResponseTerm(
        " and ".join(names),
        "um" if names[0] == "distance" else "urad",
        _SIZE[names[0]],
        names,
        "reading",
        names,
        tuple(_SIZE[name] / _SIZE[names[0]] for name in names),
        tuple("um" if name == "distance" else "urad" for name in names),
    )
    for count in (2, 3)
    for names in combinations(OBSERVABLES, count)
)
"""Responses of several observables that depend on the same regressor, each with a separate coefficient."""
_SCALE = ResponseTerm("range scale", "ppm", STRAIN, ("distance",))


def constants_in(slot: str) -> tuple[str, ...]:
    """Constants of the ordinary calibration that act on a slot of the chain."""
    return tuple(p.name for e in BASELINE for p, t in zip(e.parameters, e.terms, strict=True) if t == Term(slot))


VARIED = (
    {carrier.name: constants_in(slot) for slot, carrier in _SLOTS.items()}
    | {carrier.name: tuple(p.name for p in effect.parameters) for carrier, effect in _CIRCLES.items()}
    | {"distance": constants_in("range"), _SCALE.name: ("range-scale",)}
)
"""Constants of the ordinary calibration that a response varies, by response."""
_LEAN = ResponseTerm("lean of the stand", "urad", ANGLE, (), "stand", ("about x", "about y"))
_STAND = ResponseTerm("place of the stand", "um", MOTION, (), "stand", ("along x", "along y", "along z"))
_TARGETS = ResponseTerm("place of targets", "um", MOTION, (), "target", ("along x", "along y", "along z"))
_NORMAL = ResponseTerm("height of targets in their nests", "um", MOTION, (), "target")
_AIR = ResponseTerm("air gradient", "K/m", 1.0, (), "air")
_VERTEX = ResponseTerm("vertex of the reflectors", "um", LENGTH, (), "reflector", ("axially", "sideways", "up"))
_LEVEL = ResponseTerm("level displacement of reflectors towards the instrument", "um", LENGTH, (), "reflector")


def _reading(sightings: Sightings, observable: str) -> Floats:
    return on_readings(sightings, **{observable: np.ones(len(sightings))})[:, :, None]


def _readings(sightings: Sightings, carrier: ResponseTerm) -> Floats:
    ways = [scale * _reading(sightings, name) for name, scale in zip(carrier.observables, carrier.scales, strict=True)]
    return np.concatenate(ways, axis=2)


def _slot(sightings: Sightings, slot: str) -> Floats:
    return sightings.slot_responses[slot][:, :, None]


def _scale(sightings: Sightings) -> Floats:
    return on_readings(sightings, distance=sightings.range_)[:, :, None]


def _along_nest(sightings: Sightings) -> Floats:
    normal = np.nan_to_num(sightings.nest_normal[sightings.target])
    return by_displacement(sightings, normal[:, :, None])


def _vertex(sightings: Sightings) -> Floats:
    return by_displacement(sightings, reflector_axes(sightings))


def _towards_instrument(sightings: Sightings) -> Floats:
    """Change of the readings per unit of a horizontal motion of the reflectors towards the instrument."""
    way = sightings.position[sightings.station] - sightings.points[sightings.target]
    level = way * [1.0, 1.0, 0.0]
    return by_displacement(sightings, (level / np.maximum(np.linalg.norm(level, axis=1), 1e-9)[:, None])[:, :, None])


Derivative = Callable[[Sightings], Floats]


def _registry() -> dict[str, tuple[ResponseTerm, Derivative]]:
    derivatives: list[tuple[ResponseTerm, Derivative]] = [
        *((carrier, partial(_reading, observable=carrier.name)) for carrier in _READINGS),
        *((carrier, partial(_readings, carrier=carrier)) for carrier in _TOGETHER),
        *((carrier, partial(_slot, slot=slot)) for slot, carrier in _SLOTS.items()),
        *((carrier, effect.design) for carrier, effect in _CIRCLES.items()),
        (_SCALE, _scale),
        (_LEAN, lambda s: station_design(s)[:, :, 3:5]),
        (_STAND, lambda s: station_design(s)[:, :, :3]),
        (_TARGETS, lambda s: s.by_target),
        (_AIR, AirGradient().design),
        (_NORMAL, _along_nest),
        (_VERTEX, _vertex),
        (_LEVEL, _towards_instrument),
    ]
    return {carrier.name: (carrier, derivative) for carrier, derivative in derivatives}


RESPONSES = _registry()
"""Responses by name, each with the function for the change (n, 3, c) of the raw readings per unit of each component."""
_NEED_NESTS = {_NORMAL.name, _VERTEX.name}


def response_designs(sightings: Sightings) -> dict[str, tuple[ResponseTerm, Floats]]:
    """Responses by name with their designs (n, 3, c), without duplicates.

    On a single face, for example, the vertical index equals the elevation. A moving target and a moving stand have
    equal designs but different regressors.
    """
    designs: dict[str, tuple[ResponseTerm, Floats]] = {}
    nests = bool(np.isfinite(sightings.nest_normal).any())
    for name, (carrier, derivative) in RESPONSES.items():
        if name in _NEED_NESTS and not nests:
            continue
        design = derivative(sightings)
        comparable = (d for c, d in designs.values() if d.shape == design.shape and c.kind != "stand")
        same = (np.allclose(np.abs(design), np.abs(other), rtol=1e-9, atol=0.0) for other in comparable)
        if design.any() and not any(same):
            designs[name] = carrier, design
    return designs
