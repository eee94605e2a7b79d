from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE, MICRORADIAN
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter
from ltsim.scene.sightings import Sightings

BearingMotionKind = Literal["tilt", "radial", "transit"]
"""Kind of error motion of a bearing: `tilt` or `radial` (run-out) of the standing axis, or `transit` (tilt of the
transit axis)."""


CHAIN_ERROR_KEYS_BY_BEARING_MOTION = {
    "tilt": ("standing-tilt-x", "standing-tilt-y"),
    "radial": ("standing-radial-x", "standing-radial-y"),
}
"""Keys of the two errors of the kinematic chain that each kind of bearing motion changes: along or about x and y."""
CANDIDATE_BEARING_MOTIONS: tuple[tuple[BearingMotionKind, int], ...] = (
    ("tilt", -1),
    ("tilt", 2),
    ("tilt", 3),
    ("radial", 2),
    ("radial", 3),
    ("transit", 2),
)
"""Bearing motions that a diagnosis tries: pairs of a kind of motion and its number of periods per turn."""


@dataclass(frozen=True)
class BearingWobble(Effect):
    """Bearing error motion: tilt or run-out of the standing axis as it turns, tilt of the transit axis as it tips.

    tilt (w_x, w_y) of the standing axis, order n: w_x + i w_y = (A + i B) exp(i n x), raw azimuth x, base frame;
        Delta_elevation = w_x sin(az) - w_y cos(az), Delta_azimuth = -tan(el) (w_x cos(az) + w_y sin(az)).
        n = 0 equals a tilt of the station, n = 1 equals vertical index and transit tilt; the other orders equal no
        other effect. For even n the error is the same in both faces.
    radial, order n: the axis shifts by (r_x, r_y), r_x + i r_y = (A + i B) exp(i n x); this is the correction D.
    transit, order n: the transit axis yaws by eX = A cos(n y) + B sin(n y), y the raw elevation;
        Delta_azimuth = f eX / cos(el), f = +1 in face 1 and -1 in face 2.
    A tilt differs from errors of single angles because it changes both, in the ratio tan(el).

    Size: 0.3 to 1 urad and 0.3 to 1 um in a good bearing, 3 to 5 urad and 5 to 10 um in a bad one.
    Similar to: radial, order 2: azimuth-eccentricity (correlation 0.92 in one face, 0 in two); transit, order 2:
    beam-tilt (0.98, 0.82); tilt, order -1: tilt of order 3 (0.57, 0.74).
    Separate by: two faces (odd n), a change of yaw, an electronic level on the head during a turn.
    Validity: orders up to 3, which repeat in every turn. The passage of balls does not repeat; it is noise.
    Source: ISO 230-7:2015 (axial, radial and tilt error motion); the algebra is derived here.
    Validation: validated against the exact rotation of the base and against finite differences of the kinematic chain.
    """

    kind: BearingMotionKind = "tilt"
    """Kind of error motion of the bearing: `tilt` or `radial` (run-out) of the standing axis, or `transit` (tilt of the
    transit axis)."""
    order: int = 2
    """Number of periods of the error motion per turn of the axis; negative if it rotates against the axis."""

    name = "bearing-wobble"
    base_rate = 0.5
    light_path_stage = LightPathStage.AXES
    covariates = ("azimuth", "elevation")
    parameters = (
        Parameter(
            "wobble-cos", "urad", "tilt A: A cos(n x) about the x axis, A sin(n x) about the y axis", 4 * MICRORADIAN
        ),
        Parameter(
            "wobble-sin", "urad", "tilt B: -B sin(n x) about the x axis, B cos(n x) about the y axis", 4 * MICRORADIAN
        ),
    )

    def __post_init__(self) -> None:
        if self.kind == "radial":
            run_out = (
                Parameter(
                    "run-out-cos",
                    "um",
                    "shift A: A cos(n x) along the x axis, A sin(n x) along the y axis",
                    8 * MICROMETRE,
                ),
                Parameter(
                    "run-out-sin",
                    "um",
                    "shift B: -B sin(n x) along the x axis, B cos(n x) along the y axis",
                    8 * MICROMETRE,
                ),
            )
            object.__setattr__(self, "parameters", run_out)
        else:
            observables = ("azimuth",) if self.kind == "transit" else ("azimuth", "elevation")
            object.__setattr__(self, "observables", observables)
        along = "elevation" if self.kind == "transit" else "azimuth"
        object.__setattr__(self, "covariates", (along,))

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Bearing motions that a diagnosis tries: each pair of kind and order in `CANDIDATE_BEARING_MOTIONS`."""
        return [cls(kind=kind, order=order) for kind, order in CANDIDATE_BEARING_MOTIONS]

    def design(self, sightings: Sightings) -> Floats:
        acts, response = self.pointing_indicator(sightings)[:, None], sightings.reading_change_by_error_key
        phase = self.order * sightings.instrument_readings[:, 2 if self.kind == "transit" else 1]
        c, s = np.cos(phase)[:, None], np.sin(phase)[:, None]
        if self.kind == "transit":
            yaw = response["beam-tilt"]
            return np.stack([acts * c * yaw, acts * s * yaw], axis=2)
        x, y = (response[key] for key in CHAIN_ERROR_KEYS_BY_BEARING_MOTION[self.kind])
        return np.stack([acts * (c * x + s * y), acts * (c * y - s * x)], axis=2)
