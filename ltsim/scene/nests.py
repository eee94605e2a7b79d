"""Places for nests on surfaces of CAD: flat enough to carry one, spread out, with the reflector clear of the body."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.geometry.rotations import perpendicular
from ltsim.randomness import stream
from ltsim.scene.meshes import Obstacles

FOOT = 0.025
"""[m] from the middle of a nest to the rim of its foot."""
UNEVEN = 0.002
"""[m] that the surface may deviate from a plane under the foot."""
STEEPEST = -0.5
"""Height of the normal under which a face looks down too much: nobody hangs a nest under a body."""
DENSE = 12.0
"""Places that are drawn for every square of the wanted distance, before the near ones are dropped."""
MOST_DRAWN = 20_000


def nest_places(
    body: Floats, reach: float, apart: float, around: Obstacles | None = None, *, closed: bool = True
) -> Floats:
    """Places (P, 3) [m] of reflectors on a body's surfaces.

    Parameters
    ----------
    body : (m, 3, 3) float, [m]
        Its triangles.
    reach : float, [m]
        Height of a reflector's centre over the surface.
    apart : float, [m]
        Least distance between two places.
    around : Obstacles, optional
        Everything that stands there: no place lies in it.
    closed : bool
        The outer side is found, whatever way the triangles are wound; of open surfaces it is that of their normals.
    """
    drawn, normal = _drawn(body, apart)
    own = Obstacles(body)
    if closed:
        normal[own.holds(drawn + reach * normal)] *= -1.0
    places = drawn + reach * normal
    good = normal[:, 2] > STEEPEST
    good &= ~(closed & own.holds(places))
    if around is not None:
        good &= ~around.holds(places)
    good[good] = _flat(own, places[good], normal[good], reach)
    return _spread(places[good], apart)


def _drawn(body: Floats, apart: float) -> tuple[Floats, Floats]:
    """Points spread evenly by chance over triangles, and their normals (n, 3)."""
    cross = np.cross(body[:, 1] - body[:, 0], body[:, 2] - body[:, 0])
    size = np.linalg.norm(cross, axis=1)
    area = 0.5 * float(size.sum())
    rng = stream(0, "nests")
    count = int(np.clip(DENSE * area / apart**2, 200, MOST_DRAWN))
    face = rng.choice(len(body), size=count, p=size / size.sum())
    root, share = np.sqrt(rng.random(count))[:, None], rng.random(count)[:, None]
    a, b, c = np.moveaxis(body[face], 1, 0)
    return (1 - root) * a + root * (1 - share) * b + root * share * c, cross[face] / size[face, None]


def _flat(own: Obstacles, places: Floats, normal: Floats, reach: float) -> Bools:
    """(n,): around the foot of a nest the surface lies where the nest needs it."""
    side, other = perpendicular(normal)
    good = np.ones(len(places), dtype=bool)
    for shift in (side, -side, other, -other):
        rim = places + FOOT * shift
        good &= own.blocked(rim, rim - (reach + UNEVEN) * normal)
        good &= ~own.blocked(rim, rim - (reach - UNEVEN) * normal)
    return good


def _spread(places: Floats, apart: float) -> Floats:
    """Those that keep their distance from the ones before them."""
    kept: list[int] = []
    for i, place in enumerate(places):
        if not kept or np.linalg.norm(places[kept] - place, axis=1).min() >= apart:
            kept.append(i)
    return places[kept]
