from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.physics.effects.rays import TemperatureField, WarmAirEffect, relative_index_change_per_kelvin
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class AirGradient(WarmAirEffect):
    """Uniform vertical gradient of the air's temperature: warm air lies above cool air, and refraction bends the beam.

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
    stage = LightPathStage.AIR
    covariates = ("height", "distance")
    parameters = (Parameter("air-gradient", "K/m", "rise of the temperature with the height", 1.0),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Candidates with a weather sensor in the room, and with one on the head."""
        return [cls(sensor="room"), cls(sensor="head")]

    def _sensor_height(self, sightings: Sightings) -> Floats:
        """Height (n,) [m] of the weather sensor, for which the temperature used is correct."""
        if self.sensor == "head":
            return sightings.station_positions[sightings.station, 2]
        return np.full(len(sightings), float(sightings.target_points[:, 2].mean()))

    def design(self, sightings: Sightings) -> Floats:
        steep = relative_index_change_per_kelvin() * self.row_weights(sightings) * sightings.range_
        heights = sightings.station_positions[sightings.station, 2] + sightings.target_points[sightings.target, 2]
        _, across, up = sightings.beam_vectors
        column = design_from_front_face_corrections(
            sightings,
            distance=steep * (0.5 * heights - self._sensor_height(sightings)),
            azimuth=-0.5 * steep * across[:, 2] / np.cos(sightings.elevation),
            elevation=-0.5 * steep * up[:, 2],
        )
        return column[:, :, None]

    def field(self, sightings: Sightings) -> TemperatureField:
        """Temperature field with a gradient of 1 K/m."""
        bottom = self._sensor_height(sightings)

        def field(points: Floats) -> tuple[Floats, Floats]:
            higher = points[:, 2] - np.repeat(bottom, len(points) // max(len(bottom), 1))
            return higher, np.broadcast_to([0.0, 0.0, 1.0], points.shape)

        return field
