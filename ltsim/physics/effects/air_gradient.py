from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.physics.effects.rays import TemperatureField, WarmAirEffect, relative_index_decrease_per_kelvin
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class AirGradient(WarmAirEffect):
    """Uniform vertical gradient of the air's temperature: warm air lies above cool air, and refraction bends the beam.

    The corrections (true value minus reading) are Delta_elevation = -1/2 beta G d cos(el) (warm air above lifts the
    target's image) and Delta_d = +beta G d ((z_station + z_target) / 2 - z_sensor). They depend on the range d, the
    elevation el, the gradient G = dT/dz of the temperature, the sensitivity beta = -dn/dT of the refractive index, and
    the heights z. Together the two changes are a conformal map of space. Station poses and target coordinates therefore
    absorb the whole effect: the residuals do not change, but the coordinates of the targets are distorted (7 um rms at
    1 K/m). A weather sensor on the tracker head (`head`) has another height at each station, so that each station has
    another scale.

    Size: 0.1 K/m in a good hall, 1 to 2 K/m in a heated one; 1 K/m deflects a beam of 8 m by 3.7 urad (30 um).
    Similar to: with a sensor on the head, station-weather; with a sensor in the hall no effect, because the residuals
    do not change. Bending alone: head-sag (correlation 0.92), vertical-index (0.86 in one face, 0 in two).
    Separate by: thermometers at two heights; a length standard at the floor and at the ceiling (5.6 ppm over 6 m at 1
    K/m).
    Validity: up to some kelvin per metre; the vertical is the z axis of the network frame.
    Source: Born and Wolf, Principles of Optics, section 3.2 (ray equation); Ciddor 1996, Appl. Opt. 35, 1566,
    doi:10.1364/AO.35.001566 (beta). The absorption by the network is derived here.
    Validation: first-order form validated against the integrated ray; absorption by the network reproduced.
    """

    sensor: Literal["room", "head"] = "room"
    """Position of the weather sensor: `room` (at one height in the hall) or `head` (on the tracker head)."""

    name = "air-gradient"
    light_path_stage = LightPathStage.AIR
    covariates = ("height", "distance")
    parameters = (Parameter("air-gradient", "K/m", "rise of the temperature with the height", 1.0),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Air gradients that a diagnosis tries: one with the weather sensor in the hall, one with it on the head."""
        return [cls(sensor="room"), cls(sensor="head")]

    def _sensor_height(self, sightings: Sightings) -> Floats:
        """Height (n,) [m] in the network frame of the weather sensor at each of n pointings.

        At this height the air temperature used for the correction of the range is right.
        """
        if self.sensor == "head":
            return sightings.station_positions[sightings.station, 2]
        return np.full(len(sightings), float(sightings.target_points[:, 2].mean()))

    def design(self, sightings: Sightings) -> Floats:
        index_gradient = relative_index_decrease_per_kelvin() * self.pointing_indicator(sightings) * sightings.range_
        heights = sightings.station_positions[sightings.station, 2] + sightings.target_points[sightings.target, 2]
        _, across, up = sightings.beam_vectors
        column = design_from_front_face_corrections(
            sightings,
            distance=index_gradient * (0.5 * heights - self._sensor_height(sightings)),
            azimuth=-0.5 * index_gradient * across[:, 2] / np.cos(sightings.elevation),
            elevation=-0.5 * index_gradient * up[:, 2],
        )
        return column[:, :, None]

    def temperature_field(self, sightings: Sightings) -> TemperatureField:
        """Temperature as a function of position (`TemperatureField`), for a vertical gradient of 1 K/m."""
        sensor_height = self._sensor_height(sightings)

        def field(points: Floats) -> tuple[Floats, Floats]:
            height_difference = points[:, 2] - np.repeat(sensor_height, len(points) // max(len(sensor_height), 1))
            return height_difference, np.broadcast_to([0.0, 0.0, 1.0], points.shape)

        return field
