from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import LightPathStage, Parameter, ShapeParameter
from ltsim.physics.effects.rays import TemperatureField, WarmAirEffect
from ltsim.scene.sightings import Sightings

N_CANDIDATE_LAYER_HEIGHTS = 7
"""Number of heights of the warm layer that a diagnosis tries, between the lowest and the highest target or station."""
CANDIDATE_TRANSITION_WIDTHS = (0.15, 0.5)
"""Widths [m] that a diagnosis tries for the transition from the cool air to the warm layer."""


def _point_heights(sightings: Sightings) -> Floats:
    """Heights (T + S,) [m] in the network frame of the T targets, followed by the heights of the S stations."""
    return np.concatenate([sightings.target_points[:, 2], sightings.station_positions[:, 2]])


@dataclass(frozen=True)
class AirLayer(WarmAirEffect):
    """Layered air: a warm layer lies under the roof.

    The temperature excess at the height z is T(z) = D / (1 + exp(-(z - height) / width)). Here z counts from the lowest
    target or station, and D is the temperature difference between warm and cool air. The corrections (true value minus
    reading) are integrals along the path from the station, s = 0 to d: to the left and upward (D_t, D_v) = integral of
    (d - s) grad_perp n ds, of the range Delta_d = -integral of (n - n_sensor) ds. Here n is the refractive index,
    grad_perp n its gradient across the beam, and n_sensor its value at the weather sensor. Residuals show only the
    curvature of the profile: targets in the layer are measured too near and too high.

    Size: 2 to 6 K across the layer; it is detected from 12 K on in one face, from 4.5 K on in two faces.
    Similar to: elevation-second-order sine (correlation 0.59); a drift, if the targets at the ceiling are measured
    first.
    Separate by: a measured temperature profile; another time of day; stations at different heights.
    Validity: temperature differences of 1 to 10 K; the weather sensor is below the layer; height and width along the
    network's z axis.
    Source: Born and Wolf, Principles of Optics, section 3.2 (ray equation); Ciddor 1996, Appl. Opt. 35, 1566,
    doi:10.1364/AO.35.001566 (index).
    Validation: first-order form validated against the integrated ray.
    """

    height: float = 4.0
    """Height [m] of the middle of the transition to the warm layer, above the lowest target or station."""
    width: float = 0.3
    """Width [m] of the transition from the cool air to the warm layer."""

    name = "air-layer"
    light_path_stage = LightPathStage.AIR
    covariates = ("height",)
    parameters = (Parameter("layer-step", "K", "temperature of the layer minus that of the air below", 4.0),)
    shape_parameters = (
        ShapeParameter(
            "height", "m", "height of the transition above the lowest target or station", 0.0, 40.0, n_grid_values=41
        ),
        ShapeParameter("width", "m", "width of the transition", 0.05, 1.5, has_logarithmic_grid=True, n_grid_values=3),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Air layers that a diagnosis tries, at heights between the lowest and the highest target or station."""
        heights = np.linspace(0.0, float(np.ptp(_point_heights(sightings))), N_CANDIDATE_LAYER_HEIGHTS + 2)[1:-1]
        return [cls(height=float(z), width=w) for z in heights for w in CANDIDATE_TRANSITION_WIDTHS]

    def temperature_field(self, sightings: Sightings) -> TemperatureField:
        """Temperature as a function of position (`TemperatureField`), for a layer 1 K warmer than the air below."""
        from scipy.special import expit

        floor = float(_point_heights(sightings).min(initial=np.inf))

        def field(points: Floats) -> tuple[Floats, Floats]:
            risen: Floats = expit((points[:, 2] - floor - self.height) / self.width)
            gradient = np.zeros_like(points)
            gradient[:, 2] = risen * (1.0 - risen) / self.width
            return risen, gradient

        return field
