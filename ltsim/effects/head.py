"""Errors of the head beyond the maker's model: bearings, sag, backlash, the tracking detector."""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, SlotEffect, Stage, Term, on_readings
from ltsim.scene.sightings import Sightings
from ltsim.units import MICROMETRE, MICRORADIAN

Motion = Literal["tilt", "radial", "transit"]
SLOTS = {"tilt": ("standing-tilt-x", "standing-tilt-y"), "radial": ("standing-radial-x", "standing-radial-y")}
TRIED: tuple[tuple[Motion, int], ...] = (
    ("tilt", -1),
    ("tilt", 2),
    ("tilt", 3),
    ("radial", 2),
    ("radial", 3),
    ("transit", 2),
)


@dataclass(frozen=True)
class BearingWobble(Effect):
    """Bearing error motion: the standing axis wobbles or runs out as it turns, the transit axis wobbles as it tips.

    tilt, order n: w_x + i w_y = (A + i B) exp(i n x), x the raw azimuth, in the base frame;
        Delta_elevation = w_x sin(az) - w_y cos(az), Delta_azimuth = -tan(el) (w_x cos(az) + w_y sin(az)).
        n = 0 is the station's tilt, n = 1 index and transit tilt; n = -1, 2, 3 are new. Even n is the same on both
        faces.
    radial, order n: the axis shifts by r_x + i r_y = (A + i B) exp(i n x), and D = r.
    transit, order n: the transit axis yaws by A cos(n y) + B sin(n y), y the raw elevation; Delta_azimuth = f eX /
        cos(el).
    What betrays a tilt is the coupling of both angles by tan(el).

    Size: 0.3 to 1 urad and 0.3 to 1 um in a good bearing, 3 to 5 urad and 5 to 10 um in a bad one.
    Like: radial 2 the azimuth-eccentricity (0.92 / 0), transit 2 the beam-tilt (0.98 / 0.82), tilt -1 the tilt 3 (0.57
    / 0.74).
    Separate by: two faces (odd n), a change of yaw, an electronic level on the head during a turn.
    Valid: orders up to 3, which repeat every turn; ball passage does not and is noise.
    Source: ISO 230-7:2015 (axial, radial and tilt error motion); the algebra is derived here.
    Status: validated against the exact rotation of the base and against finite differences of the chain.
    """

    kind: Motion = "tilt"
    order: int = 2

    name = "bearing-wobble"
    stage = Stage.AXES
    covariates = ("azimuth", "elevation")
    parameters = (
        Parameter("wobble-cos", "urad", "tilt, part along cos(n x), then sin(n x)", 4 * MICRORADIAN),
        Parameter("wobble-sin", "urad", "tilt, part along -sin(n x), then cos(n x)", 4 * MICRORADIAN),
    )

    def __post_init__(self) -> None:
        if self.kind == "radial":
            run_out = (
                Parameter("run-out-cos", "um", "shift, part along cos(n x), then sin(n x)", 8 * MICROMETRE),
                Parameter("run-out-sin", "um", "shift, part along -sin(n x), then cos(n x)", 8 * MICROMETRE),
            )
            object.__setattr__(self, "parameters", run_out)
        else:
            seen = ("azimuth",) if self.kind == "transit" else ("azimuth", "elevation")
            object.__setattr__(self, "observables", seen)
        along = "elevation" if self.kind == "transit" else "azimuth"
        object.__setattr__(self, "covariates", (along,))

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """The motions that are no station tilt and no other effect."""
        return [cls(kind=kind, order=order) for kind, order in TRIED]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 2) of the raw readings per unit of either amplitude, first order."""
        acts, response = self.mask(sightings)[:, None], sightings.slot_responses
        phase = self.order * sightings.read[:, 2 if self.kind == "transit" else 1]
        c, s = np.cos(phase)[:, None], np.sin(phase)[:, None]
        if self.kind == "transit":
            yaw = response["beam-tilt"]
            return np.stack([acts * c * yaw, acts * s * yaw], axis=2)
        x, y = (response[slot] for slot in SLOTS[self.kind])
        return np.stack([acts * (c * x + s * y), acts * (c * y - s * x)], axis=2)


@dataclass(frozen=True)
class HeadSag(Effect):
    """Gravity sag of the head: the scope bends under its own weight.

    Delta_elevation = -g (e_up . vertical), e_up the upward unit vector across the beam; for an upright tracker -g
    cos(el), the same on both faces.

    Size: under 0.5 urad in a good head, 5 urad in a bad one; normally inside the maker's map.
    Like: elevation-eccentricity cosine, exactly for upright trackers; vertical-index (0.96 / 0).
    Separate by: the tracker on its side or hanging (0.84).
    Valid: any mounting; the vertical is the z axis of the network frame.
    Source: Wallace 2002, A rigorous algorithm for telescope pointing, Proc. SPIE 4848 (tube flexure follows the same
    law).
    Status: validated against the eccentricity's cosine column for upright stations.
    """

    name = "head-sag"
    stage = Stage.AXES
    observables = ("elevation",)
    covariates = ("elevation",)
    parameters = (Parameter("sag", "urad", "droop of a level beam", 5 * MICRORADIAN),)

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of sag."""
        upright = sightings.unit_vectors[2][:, 2]
        return on_readings(sightings, elevation=-self.mask(sightings) * upright)[:, :, None]


@dataclass(frozen=True)
class Backlash(Effect):
    """Backlash: what an axis reads depends on the side it came from (hysteresis).

    Correction of the raw angle = -h/2 sgn(last move of that axis), on either axis. The last move is that between two
    pointings of a station in the order of the work; the first pointing of a station has none.

    Size: 0.1 to 0.3 urad in a good drive, 2 to 5 urad in a bad one.
    Like: encoder harmonics, where the route is always the same.
    Separate by: the same targets in the reverse order.
    Valid: constant width; the order of the rows is the order of the work. Cable drag that decays with the travel is not
    in it.
    Source: general knowledge of drives; the law is that of a play of constant width.
    Status: validated by reversing the order of the work, which turns the sign.
    """

    name = "backlash"
    stage = Stage.AXES
    observables = ("azimuth", "elevation")
    covariates = ("approach",)
    parameters = (
        Parameter("backlash-azimuth", "urad", "width of the dead zone of the standing axis", 6 * MICRORADIAN),
        Parameter("backlash-elevation", "urad", "width of the dead zone of the transit axis", 6 * MICRORADIAN),
    )

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 2) of the raw readings per unit of width."""
        half = -0.5 * sightings.approach * self.mask(sightings)[:, None]
        columns = [sightings.slot_responses[slot] * half[:, [i]] for i, slot in enumerate(("azimuth", "elevation"))]
        return np.stack(columns, axis=2)


def half(raw: Floats) -> Floats:
    """The beam misses by half of what the returning spot is off."""
    return np.full(len(raw), 0.5)


class DetectorOffset(SlotEffect):
    """Null offset of the tracking detector: the return spot is held at a wrong place, so the beam misses the vertex.

    D_t = f eps_y / 2, D_v = f eps_z / 2, fixed to the scope: exactly a beam offset of half the size.

    Size: under 1 um in a good tracker, 5 to 20 um in a bad one.
    Like: beam-offset, exactly.
    Separate by: another reflector (coating, size, dirt) or a log of the returned power: the beam offset stays.
    Valid: one kind of reflector, a constant offset.
    Source: general knowledge; half, because a retroreflector returns the beam mirrored at its vertex.
    Status: validated against the beam offset.
    """

    name = "detector-offset"
    stage = Stage.OPTICS
    observables = ("azimuth", "elevation")
    covariates = ("distance",)
    parameters = (
        Parameter("detector-offset-lateral", "um", "null offset along the transit axis", 20 * MICROMETRE),
        Parameter("detector-offset-vertical", "um", "null offset across the transit axis", 20 * MICROMETRE),
    )
    terms = (Term("beam-lateral", half), Term("beam-vertical", half))
