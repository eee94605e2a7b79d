"""Uneven air: it bends the light, and it boils."""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import NoiseEffect, Parameter, ShapeParameter, Stage, on_readings
from ltsim.effects.rays import AirField, WarmAir, bending
from ltsim.scene.sightings import Sightings
from ltsim.units import MICROMETRE


@dataclass(frozen=True)
class AirGradient(WarmAir):
    """Uniform vertical gradient of the air's temperature: the air is warmer the higher it lies, and light bends.

    Delta_elevation = -1/2 beta G d cos(el) (warm air above lifts the target's image), Delta_d = +beta G d ((z_station +
    z_target) / 2 - z_sensor), with G = dT/dz and beta = -dn/dT. The two together are a conformal map of empty space, so
    poses and targets absorb the whole and nothing is left in the residuals, while the mesh is distorted (7 um rms at 1
    K/m); either alone would invent a signature. A weather sensor that rides on the head (`head`) reads another height
    at each station and leaves a scale a station.

    Size: 0.1 K/m in a good hall, 1 to 2 K/m in a heated one; 1 K/m bends 8 m by 3.7 urad, 30 um.
    Like: nothing is left to be like anything; `head`: station-weather. Bending alone: head-sag (0.92), vertical-index
    (0.86 / 0).
    Separate by: thermometers at two heights; a length standard at the floor and at the ceiling (5.6 ppm over 6 m at 1
    K/m).
    Valid: up to some kelvin a metre; the vertical is the z axis of the network frame.
    Source: Born and Wolf, Principles of Optics, section 3.2 (ray equation); Ciddor 1996, Appl. Opt. 35, 1566,
    doi:10.1364/AO.35.001566 (beta); that a network absorbs it is derived here.
    Status: first order validated against the integrated ray; absorption by the network reproduced.
    """

    sensor: Literal["room", "head"] = "room"

    name = "air-gradient"
    stage = Stage.AIR
    covariates = ("height", "distance")
    parameters = (Parameter("air-gradient", "K/m", "rise of the temperature with the height", 1.0),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """A weather sensor in the room, and one on the head."""
        return [cls(sensor="room"), cls(sensor="head")]

    def _sensor_height(self, sightings: Sightings) -> Floats:
        """(n,) [m]: height at which the used temperature is right."""
        if self.sensor == "head":
            return sightings.position[sightings.station, 2]
        return np.full(len(sightings), float(sightings.points[:, 2].mean()))

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of gradient, first order."""
        steep = bending() * self.mask(sightings) * sightings.range_
        heights = sightings.position[sightings.station, 2] + sightings.points[sightings.target, 2]
        _, left, up = sightings.unit_vectors
        column = on_readings(
            sightings,
            distance=steep * (0.5 * heights - self._sensor_height(sightings)),
            azimuth=-0.5 * steep * left[:, 2] / np.cos(sightings.elevation),
            elevation=-0.5 * steep * up[:, 2],
        )
        return column[:, :, None]

    def field(self, sightings: Sightings) -> AirField:
        """The field of a gradient of one kelvin a metre."""
        bottom = self._sensor_height(sightings)

        def field(points: Floats) -> tuple[Floats, Floats]:
            higher = points[:, 2] - np.repeat(bottom, len(points) // max(len(bottom), 1))
            return higher, np.broadcast_to([0.0, 0.0, 1.0], points.shape)

        return field


HEIGHTS = 7
WIDTHS = (0.15, 0.5)


def _ends(sightings: Sightings) -> Floats:
    """Heights [m] of all targets and stations in the network frame."""
    return np.concatenate([sightings.points[:, 2], sightings.position[:, 2]])


@dataclass(frozen=True)
class AirLayer(WarmAir):
    """Layered room: a warm layer lies under the roof.

    T(z) = D / (1 + exp(-(z - height) / width)), z above the lowest target or station, and along the path from the
    station, (D_t, D_v) = integral of (d - s) grad_perp n ds, Delta_d = -integral of (n - n_sensor) ds, s = 0 to d. Only
    the curvature of the profile is seen: targets in the layer are read too near and too high.

    Size: 2 to 6 K across the layer; it shows from 12 K on in one face, from 4.5 K on in two.
    Like: elevation-second-order sine (0.59); a drift, where the ceiling row is measured first.
    Separate by: a temperature profile; another time of day; stations at different heights.
    Valid: steps of 1 to 10 K; the weather sensor is below the layer; height and width along the network's z
    axis.
    Source: Born and Wolf, Principles of Optics, section 3.2 (ray equation); Ciddor 1996, Appl. Opt. 35, 1566,
    doi:10.1364/AO.35.001566 (index).
    Status: first order validated against the integrated ray.
    """

    height: float = 4.0
    width: float = 0.3

    name = "air-layer"
    stage = Stage.AIR
    covariates = ("height",)
    parameters = (Parameter("layer-step", "K", "how much warmer the layer is than the air below", 4.0),)
    shape = (
        ShapeParameter("height", "m", "middle of the step above the lowest target or station", 0.0, 40.0, steps=41),
        ShapeParameter("width", "m", "width of the step", 0.05, 1.5, logarithmic=True, steps=3),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Heights between the lowest and the highest target or station."""
        heights = np.linspace(0.0, float(np.ptp(_ends(sightings))), HEIGHTS + 2)[1:-1]
        return [cls(height=float(z), width=w) for z in heights for w in WIDTHS]

    def field(self, sightings: Sightings) -> AirField:
        """The step of one kelvin above the lowest target or station."""
        from scipy.special import expit

        floor = float(_ends(sightings).min(initial=np.inf))

        def field(points: Floats) -> tuple[Floats, Floats]:
            risen: Floats = expit((points[:, 2] - floor - self.height) / self.width)
            gradient = np.zeros_like(points)
            gradient[:, 2] = risen * (1.0 - risen) / self.width
            return risen, gradient

        return field


RING = 8
LEVELS = (-0.6, 0.0, 0.6)
"""[rad] elevations of the directions that are tried, besides the poles."""
REACH = 0.5
"""[m] from a station to the centres that are tried."""
MOVES = (0.2, 0.08)
"""[m] steps by which a centre is refined."""
NEAR_STATION, NEAR_TARGET = 0.25, 0.5
MOST_PLACES = 40
"""Stations, or targets, beyond which single plumes are not tried."""


def _rounded(offset: Floats) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 6) for v in offset)
    return x, y, z


@dataclass(frozen=True)
class HeatPlume(WarmAir):
    """Heat plume: a motor, a radiator or the tracker's own exhaust warms a part of the air.

    T = D exp(-|r - c|^2 / (2 radius^2)), its centre c at an offset from a station or a target; along the path, s = 0 to
    d, (D_t, D_v) = integral of (d - s) grad_perp n ds, Delta_d = -integral of (n - n_sensor) ds. The weight (d - s)
    makes heat near the station bend the aim (a shift that grows with d), heat near a target hardly at all; the range
    falls short by beta times the integral of T wherever it is.

    Size: 5 K over 0.5 m changes a range by 2.3 um; at the head, with a gradient of 5 K in 0.2 m, it bends by 7 urad.
    Like: the station's tilt and index-drift there (near a station); a range constant of that target (near a target).
    Separate by: a fan on and off; a repeat after cooling; the scatter of repeats by direction.
    Valid: on while its station, or target, is measured; the centre is searched half a metre away in all directions,
    then moved, and the radius refined.
    Source: Born and Wolf, Principles of Optics, section 3.2 (ray equation); Ciddor 1996, Appl. Opt. 35, 1566,
    doi:10.1364/AO.35.001566 (index).
    Status: first order validated against the integrated ray; the Gaussian form is a choice.
    """

    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.3

    name = "heat-plume"
    stage = Stage.AIR
    covariates = ("azimuth", "elevation", "place")
    scope = "station"
    ways = 3
    parameters = (Parameter("plume-temperature", "K", "how much warmer its centre is", 5.0),)
    shape = (ShapeParameter("radius", "m", "standard deviation of the warm ball", 0.1, 1.0, logarithmic=True, steps=4),)

    def __post_init__(self) -> None:
        if self.targets and not any(self.offset):  # all rays then point at the centre, and none is bent
            object.__setattr__(self, "observables", ("distance",))

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """A ring of directions, above and below at every station; around every target."""
        angles = np.linspace(0.0, 2 * np.pi, RING, endpoint=False)
        ways = [(np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)) for a in angles for e in LEVELS]
        offsets = [_rounded(REACH * np.array(way)) for way in (*ways, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))]
        stations = sightings.station_names if len(sightings.station_names) <= MOST_PLACES else ()
        targets = sightings.target_names if len(sightings.target_names) <= MOST_PLACES else ()
        return [
            *(cls((name,), (), offset, NEAR_STATION) for name in stations for offset in offsets),
            *(cls((), (name,), radius=NEAR_TARGET) for name in targets),
        ]

    def finer(self, sightings: Sightings) -> list[Self]:
        """Centres a little farther along or against each axis."""
        if not self.stations:
            return []
        moved = [sign * step * axis for step in MOVES for axis in np.eye(3) for sign in (1.0, -1.0)]
        return [self.reshaped(offset=_rounded(np.array(self.offset) + move)) for move in moved]

    def field(self, sightings: Sightings) -> AirField:
        """The plume with a centre warmer by one kelvin: from the station where one is named, else from the target."""
        anchor = np.zeros(3)
        if self.stations:
            anchor = sightings.position[sightings.station_names.index(self.stations[0])]
        elif self.targets:
            anchor = sightings.points[sightings.target_names.index(self.targets[0])]
        centre = anchor + np.asarray(self.offset)

        def field(points: Floats) -> tuple[Floats, Floats]:
            arm = points - centre
            warm = np.exp(-0.5 * np.einsum("mi,mi->m", arm, arm) / self.radius**2)
            return warm, -arm * (warm / self.radius**2)[:, None]

        return field


@dataclass(frozen=True)
class Turbulence(NoiseEffect):
    """Turbulence: the air boils, and readings scatter more the farther they reach.

    var(D_t) and var(D_v) grow by C d^3, var(d) by C_r d: a change of the noise, not of its mean.

    Size: C of 100 um^2/m^3 on a shop floor; shielding a path of 2.5 m cut the lateral spread from 40 to 23 um there.
    Like: noise-level, small drifts.
    Separate by: repeats over minutes; a shielded path.
    Valid: white from pointing to pointing; averaging within one helps less than 1 / sqrt(N).
    Source: Chernov 1960, Wave Propagation in a Random Medium (a ray's displacement grows with d^3); Hughes et al. 2011,
    Meas. Sci. Technol. 22, 045103, doi:10.1088/0957-0233/22/4/045103 (sizes, second hand).
    Status: form validated; sizes second hand.
    """

    name = "turbulence"
    stage = Stage.AIR
    covariates = ("distance",)
    parameters = (
        Parameter(
            "turbulence-across", "um2/m3", "variance across the beam over the cube of the range", 9 * MICROMETRE**2
        ),
        Parameter("turbulence-along", "um2/m", "variance of the range over the range", 9 * MICROMETRE**2),
    )

    def variance(self, sightings: Sightings, sigma: Floats, values: Floats) -> Floats:
        """Variance (n, 3) of the readings."""
        range_, acts = sightings.range_, self.mask(sightings)
        across = values[0] * range_  # C d^3 over d^2: an angle
        added = np.stack([values[1] * range_, across / np.cos(sightings.elevation) ** 2, across], axis=1)
        return sigma**2 + acts[:, None] * added
