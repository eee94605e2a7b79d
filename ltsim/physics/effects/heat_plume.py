from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import LightPathStage, Parameter, ShapeParameter, design_from_front_face_corrections
from ltsim.physics.effects.rays import TemperatureField, WarmAirEffect, relative_index_decrease_per_kelvin
from ltsim.scene.regions import HallRegion, candidate_regions
from ltsim.scene.sightings import Sightings

N_CANDIDATE_PLUME_AZIMUTHS = 8
"""Number of azimuths in which a diagnosis tries centres of plumes around a station."""
CANDIDATE_PLUME_ELEVATIONS = (-0.6, 0.0, 0.6)
"""Elevations [rad], in addition to zenith and nadir, in which a diagnosis tries centres of plumes around a station."""
CANDIDATE_PLUME_DISTANCE = 0.5
"""Distance [m] from a station at which a diagnosis tries centres of plumes."""
CANDIDATE_PLUME_CENTRE_SHIFTS = (0.2, 0.08)
"""Shifts [m] of the centre of a plume that a local search tries along each axis."""
CANDIDATE_STATION_PLUME_RADIUS = 0.25
"""Radius [m] of the plumes that a diagnosis tries near a station."""
CANDIDATE_TARGET_PLUME_RADIUS = 0.5
"""Radius [m] of the plumes that a diagnosis tries at a target."""
MAX_PLACES_WITH_CANDIDATE_PLUMES = 40
"""Number of stations above which a diagnosis tries no plumes near stations, and number of targets above which it tries
no plumes at targets. The limit saves time."""


def _rounded_coordinates(offset: Floats) -> tuple[float, float, float]:
    """Coordinates of an offset (3,) [m], rounded to 6 decimals, as a tuple."""
    x, y, z = (round(float(v), 6) for v in offset)
    return x, y, z


@dataclass(frozen=True)
class HeatPlume(WarmAirEffect):
    """Heat plume: a motor, a radiator or the tracker's exhaust warms a region of the air.

    The temperature excess is T = D exp(-|r - c|^2 / (2 radius^2)) at the position r, with the excess D at the centre c.
    The centre is at an offset from a station or a target, or at a position in the hall. The corrections (true value
    minus reading) are integrals along the path, s = 0 to d: to the left and upward (D_t, D_v) = integral of (d - s)
    grad_perp n ds, of the range Delta_d = -integral of (n - n_sensor) ds. Here n is the refractive index, grad_perp n
    its gradient across the beam, and n_sensor its value at the weather sensor. Because of the weight (d - s), heat near
    the station changes the direction of the beam, while heat near a target hardly does. The range is too short by beta
    times the integral of T, wherever the plume is; beta is the decrease of n per kelvin.

    Size: 5 K over 0.5 m changes a range by 2.3 um. At the head a gradient of 5 K in 0.2 m bends the beam by 7 urad.
    Similar to: near a station a tilt of the station and index-drift; near a target a constant error of its ranges.
    Separate by: a fan that is switched on and off; a repeat after cooling; the scatter of repeats by direction.
    Validity: the plume acts always, or while its station or target is measured. A diagnosis tries centres half a metre
    from each station, at targets, and on a grid over the hall, and then refines centre and radius.
    Source: Born and Wolf, Principles of Optics, section 3.2 (ray equation); Ciddor 1996, Appl. Opt. 35, 1566,
    doi:10.1364/AO.35.001566 (index).
    Validation: first-order form validated against the integrated ray; the Gaussian form is a choice.
    """

    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre [m] of the plume relative to its station or target. For a plume without station and target it is the
    position of the centre in the network frame."""
    radius: float = 0.3
    """Standard deviation [m] of the Gaussian temperature profile of the plume."""

    name = "heat-plume"
    light_path_stage = LightPathStage.AIR
    covariates = ("azimuth", "elevation", "place")
    scope = "station"
    n_neighbour_directions = 3
    parameters = (
        Parameter("plume-temperature", "K", "temperature excess at the centre of the plume", 5.0, is_nonnegative=True),
    )
    shape_parameters = (
        ShapeParameter(
            "radius",
            "m",
            "standard deviation of the temperature profile",
            0.1,
            1.0,
            has_logarithmic_grid=True,
            n_grid_values=4,
        ),
    )

    def __post_init__(self) -> None:
        if self.targets and not any(self.offset):  # all rays then point at the centre, and none is bent
            object.__setattr__(self, "observables", ("distance",))

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Plumes that a diagnosis tries: near every station, at every target, and on a grid over the hall."""
        angles = np.linspace(0.0, 2 * np.pi, N_CANDIDATE_PLUME_AZIMUTHS, endpoint=False)
        directions = [
            (np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e))
            for a in angles
            for e in CANDIDATE_PLUME_ELEVATIONS
        ]
        offsets = [
            _rounded_coordinates(CANDIDATE_PLUME_DISTANCE * np.array(direction))
            for direction in (*directions, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
        ]
        stations = sightings.station_names if len(sightings.station_names) <= MAX_PLACES_WITH_CANDIDATE_PLUMES else ()
        targets = sightings.target_names if len(sightings.target_names) <= MAX_PLACES_WITH_CANDIDATE_PLUMES else ()
        return [
            *(cls((name,), (), offset, CANDIDATE_STATION_PLUME_RADIUS) for name in stations for offset in offsets),
            *(cls((), (name,), radius=CANDIDATE_TARGET_PLUME_RADIUS) for name in targets),
            *(
                cls((), (), _rounded_coordinates(np.array(ball.centre)), ball.width)
                for ball in candidate_regions(sightings, ("xyz",))
            ),
        ]

    def neighbours(self, sightings: Sightings) -> list[Self]:
        """Copies of this plume with a shifted centre, which a local search tries."""
        if self.targets:
            return []
        offsets = [
            sign * step * axis for step in CANDIDATE_PLUME_CENTRE_SHIFTS for axis in np.eye(3) for sign in (1.0, -1.0)
        ]
        return [
            self.with_shape_parameters(offset=_rounded_coordinates(np.array(self.offset) + move)) for move in offsets
        ]

    @property
    def region_centre(self) -> tuple[float, ...]:
        """Centre [m] of a plume that is fixed in the hall; empty for a plume at a station or target."""
        return () if self.stations or self.targets else self.offset

    def centred_at(self, centre: tuple[float, ...]) -> Self:
        """Copy of the plume with its centre at `centre` (3 coordinates [m], network frame)."""
        return self.with_shape_parameters(offset=centre)

    def _centre(self, sightings: Sightings) -> Floats:
        """Centre (3,) [m] of the plume in the network frame."""
        anchor = np.zeros(3)
        if self.stations:
            anchor = sightings.station_positions[sightings.station_names.index(self.stations[0])]
        elif self.targets:
            anchor = sightings.target_points[sightings.target_names.index(self.targets[0])]
        return anchor + np.asarray(self.offset)

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the readings of n pointings, to first order, if the centre of the plume is 1 K warmer."""
        ball = HallRegion("xyz", tuple(self._centre(sightings).tolist()), self.radius)
        path, bending = ball.path_lengths_and_bending(sightings)
        _, across, up = sightings.beam_vectors
        acts = relative_index_decrease_per_kelvin() * self.pointing_indicator(sightings)
        bend = -bending * (acts / sightings.range_)[:, None]
        return design_from_front_face_corrections(
            sightings,
            distance=acts * path,
            azimuth=np.sum(bend * across, axis=1) / np.cos(sightings.elevation),
            elevation=np.sum(bend * up, axis=1),
        )[:, :, None]

    def temperature_field(self, sightings: Sightings) -> TemperatureField:
        """Temperature as a function of position (`TemperatureField`), for a plume whose centre is 1 K warmer."""
        centre = self._centre(sightings)

        def field(points: Floats) -> tuple[Floats, Floats]:
            relative_position = points - centre
            warm = np.exp(-0.5 * np.einsum("mi,mi->m", relative_position, relative_position) / self.radius**2)
            return warm, -relative_position * (warm / self.radius**2)[:, None]

        return field
