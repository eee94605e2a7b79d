"""Light paths through air of non-uniform temperature: integration of the ray equation, and its first-order solution.

A temperature field is a function of m points (m, 3) in the network frame. Its values are the temperature minus the
temperature at the weather sensor, (m,) [K], and the gradient of the temperature, (m, 3) [K/m].

The ray equation is d/ds (n dr/ds) = grad n, with the refractive index n and the position r at the distance s from the
station. Corrections (true value - reading) follow to first order. With the gradient grad_perp n across the beam and the
index n_sensor at the weather sensor, the corrections to the left (D_t), upward (D_v) and of the range d are (D_t, D_v)
= integral of (d - s) grad_perp n ds, Delta_d = -integral of (n - n_sensor) ds.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import Polynomial

from ltsim.core.arrays import Bools, Floats
from ltsim.physics.effects.ciddor import refractive_index_decrease_per_kelvin, refractivity
from ltsim.physics.effects.effect import Effect, design_from_front_face_corrections
from ltsim.physics.effects.motions import reading_change_by_target_positions
from ltsim.scene.sightings import Sightings

TemperatureField = Callable[[Floats], tuple[Floats, Floats]]
"""Function from n points (n, 3) [m] to two arrays: the temperature minus the temperature at the weather sensor (n,)
[K], and the gradient of the temperature (n, 3) [K/m]."""

REFERENCE_AIR_TEMPERATURE = 20.0
"""Temperature [C] at the weather sensor for which the decrease of the refractive index per kelvin is computed. The
decrease changes by 0.5 % per kelvin."""
N_RAY_STEPS = 64
"""Number of Runge-Kutta steps for the integration along a ray."""
QUADRATURE_NODES, QUADRATURE_WEIGHTS = (a for a in np.polynomial.legendre.leggauss(32))
"""Nodes and weights of the Gauss-Legendre quadrature along a straight path, for the interval from -1 to 1."""


@lru_cache
def _refractivity_polynomials() -> tuple[Polynomial, Polynomial]:
    """Polynomials of the refractivity (refractive index minus one) of air, and of its derivative [1/K].

    The variable is the temperature minus the temperature at the weather sensor, from -15 to +40 K.
    """
    excess = np.linspace(-15.0, 40.0, 56)
    law: Polynomial = Polynomial.fit(excess, refractivity(REFERENCE_AIR_TEMPERATURE + excess), 8).convert()
    return law, law.deriv()


@lru_cache
def relative_index_decrease_per_kelvin() -> float:
    """Relative decrease beta / n [1/K] of the refractive index n of air per kelvin, at `REFERENCE_AIR_TEMPERATURE`."""
    law, _ = _refractivity_polynomials()
    return refractive_index_decrease_per_kelvin(REFERENCE_AIR_TEMPERATURE) / (1.0 + float(law(0.0)))


def first_order_reading_change(
    sightings: Sightings, field: TemperatureField, pointing_indicator: Bools | None = None
) -> Floats:
    """Change (n, 3) of the raw readings of n pointings by a temperature field, from integrals along straight paths.

    The result is exact to first order. If `pointing_indicator` (n,) is given, only the pointings it flags change.
    """
    pointing_indices = np.arange(len(sightings)) if pointing_indicator is None else np.flatnonzero(pointing_indicator)
    beam, across, up = (way[pointing_indices] for way in sightings.beam_vectors)
    ray_lengths = sightings.range_[pointing_indices]
    path_fractions = 0.5 * (1.0 + QUADRATURE_NODES)
    origins = sightings.station_positions[sightings.station[pointing_indices]]
    points = origins[:, None] + (ray_lengths[:, None] * path_fractions)[:, :, None] * beam[:, None]
    temperature_deviation, gradient = field(points.reshape(-1, 3))
    beta = relative_index_decrease_per_kelvin()
    weight = 0.5 * QUADRATURE_WEIGHTS
    mean_deviation = temperature_deviation.reshape(len(ray_lengths), len(QUADRATURE_NODES)) @ weight
    weighted_gradient = np.einsum(
        "nqi,q->ni", gradient.reshape(len(ray_lengths), len(QUADRATURE_NODES), 3), weight * (1.0 - path_fractions)
    )
    bending_angles = -beta * ray_lengths[:, None] * weighted_gradient  # D over d: an angle
    change = np.zeros((3, len(sightings)))
    change[0, pointing_indices] = beta * ray_lengths * mean_deviation
    change[1, pointing_indices] = np.sum(bending_angles * across, axis=1) / np.cos(
        sightings.elevation[pointing_indices]
    )
    change[2, pointing_indices] = np.sum(bending_angles * up, axis=1)
    return design_from_front_face_corrections(sightings, distance=change[0], azimuth=change[1], elevation=change[2])


def integrated_reading_change(sightings: Sightings, field: TemperatureField, *, n_steps: int = N_RAY_STEPS) -> Floats:
    """Change (n, 3) of the raw readings of n pointings by a temperature field, from the ray equation.

    The ray equation is integrated by the Runge-Kutta method of fourth order with `n_steps` steps. The ray starts in the
    direction of the first-order solution. This direction is then corrected for the distance between the end of the ray
    and the target.
    """
    start, target = sightings.station_positions[sightings.station], sightings.target_points[sightings.target]
    ray_lengths = sightings.range_
    start_direction = _apparent_directions(sightings, field)
    end, arrival, optical = _trace_rays(start, start_direction, ray_lengths, field, n_steps)
    end_error = target - end
    along = np.sum(end_error * arrival, axis=1)
    aim = start_direction + (end_error - along[:, None] * arrival) / ray_lengths[:, None]
    law, _ = _refractivity_polynomials()
    at_target = law(field(target)[0])
    excess = (optical + at_target * along - law(0.0) * (ray_lengths + along)) / (1.0 + law(0.0))
    local = np.einsum("nji,nj->ni", sightings.station_rotations[sightings.station], aim)
    apparent = local / np.linalg.norm(local, axis=1, keepdims=True) * (ray_lengths + along + excess)[:, None]
    return reading_change_by_target_positions(sightings, apparent)


def _apparent_directions(sightings: Sightings, field: TemperatureField) -> Floats:
    """Unit vectors (n, 3) from the station to where the target of n pointings appears, to first order."""
    beam, across, up = sightings.beam_vectors
    change = first_order_reading_change(sightings, field)
    lateral_angle = change[:, 1] * np.cos(sightings.elevation)
    aim = beam + lateral_angle[:, None] * across + (change[:, 2] * sightings.face_sign)[:, None] * up
    return aim / np.linalg.norm(aim, axis=1, keepdims=True)


def _trace_rays(
    origins: Floats, direction: Floats, ray_lengths: Floats, field: TemperatureField, n_steps: int
) -> tuple[Floats, Floats, Floats]:
    """End points (n, 3) [m] and end directions (n, 3) of n rays, and integrals (n,) [m] of the refractivity along them.

    The rays have the start points `origins` (n, 3) [m], the start directions `direction` (n, 3) and the arc lengths
    `ray_lengths` (n,) [m].
    """
    law, slope = _refractivity_polynomials()

    def rates(position: Floats, ray_direction: Floats) -> tuple[Floats, Floats]:
        warmer, gradient = field(position)
        above = law(warmer)
        index_gradient = slope(warmer)[:, None] * gradient
        turn = (index_gradient - np.sum(index_gradient * ray_direction, axis=1, keepdims=True) * ray_direction) / (
            1.0 + above
        )[:, None]
        return turn, above

    place, heading, optical = origins.copy(), direction.copy(), np.zeros(len(origins))
    h = ray_lengths / n_steps
    hv = h[:, None]
    for _ in range(n_steps):
        t1, n1 = rates(place, heading)
        h2 = heading + 0.5 * hv * t1
        t2, n2 = rates(place + 0.5 * hv * heading, h2)
        h3 = heading + 0.5 * hv * t2
        t3, n3 = rates(place + 0.5 * hv * h2, h3)
        h4 = heading + hv * t3
        t4, n4 = rates(place + hv * h3, h4)
        place = place + hv / 6.0 * (heading + 2.0 * h2 + 2.0 * h3 + h4)
        heading = heading + hv / 6.0 * (t1 + 2.0 * t2 + 2.0 * t3 + t4)
        heading /= np.linalg.norm(heading, axis=1, keepdims=True)
        optical = optical + h / 6.0 * (n1 + 2.0 * n2 + 2.0 * n3 + n4)
    return place, heading, optical


@dataclass(frozen=True)
class WarmAirEffect(Effect):
    """Base class of effects of warm air, whose only parameter is a temperature difference [K]."""

    def temperature_field(self, sightings: Sightings) -> TemperatureField:
        """Temperature as a function of position (`TemperatureField`), if the parameter of the effect is 1 K."""
        raise NotImplementedError

    def design(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, 1) of the raw readings of n pointings with respect to the temperature difference."""
        return first_order_reading_change(
            sightings, self.temperature_field(sightings), self.pointing_indicator(sightings) > 0
        )[:, :, None]

    def reading_change(self, sightings: Sightings, parameter_values: Floats) -> Floats:
        """Change (n, 3) of the raw readings of n pointings, from the integrated ray equation.

        `parameter_values` (1,) is the temperature difference [K].
        """
        kelvin = self.temperature_field(sightings)

        def field(points: Floats) -> tuple[Floats, Floats]:
            warmer, gradient = kelvin(points)
            return parameter_values[0] * warmer, parameter_values[0] * gradient

        return integrated_reading_change(sightings, field) * self.pointing_indicator(sightings)[:, None]
