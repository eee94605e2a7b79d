"""Responses: quantities of the measurement that an unknown cause may change, and the resulting changes of readings.

Responses are instrument constants, rotation and translation of a stand, coordinates of targets, and properties of air
and reflectors. If no physical quantity explains a misfit, the response is a reading itself. A motion in space is one
response with three components. In this module n is the number of pointings, and c the number of components.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import ARCSECOND, MICROMETRE, PPM, SI_PER_UNIT
from ltsim.physics.effects import ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.effects.air_gradient import AirGradient
from ltsim.physics.effects.azimuth_eccentricity import AzimuthEccentricity
from ltsim.physics.effects.effect import ChainErrorTerm
from ltsim.physics.effects.elevation_eccentricity import ElevationEccentricity
from ltsim.physics.effects.linear_effect import design_from_displacements, design_from_front_face_corrections
from ltsim.physics.effects.smr_centring import reflector_axes
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

PLAUSIBLE_ANGLE_ERROR = 2 * ARCSECOND
"""Prior standard deviation [rad] of the coefficients of errors of angles, tilts and the vertical index."""
PLAUSIBLE_LENGTH_ERROR = 10 * MICROMETRE
"""Prior standard deviation [m] of the coefficients of errors of ranges, beam offsets and reflectors."""
PLAUSIBLE_SCALE_ERROR = 2 * PPM
"""Prior standard deviation of the coefficients of range scale errors, as a fraction of the range."""
PLAUSIBLE_MOTION = 30 * MICROMETRE
"""Prior standard deviation [m] of the coefficients of motions: of targets, stands, walls and floors."""


@dataclass(frozen=True)
class Response:
    """Response: quantity of the measurement, such as the vertical index, that an effect or law changes.

    A law describes an error as a function of covariates.
    """

    name: str
    """Name of the quantity, as in files and sentences."""
    display_unit: str
    """Display unit of a change of the quantity."""
    plausible_size: float
    """Plausible size [SI] of a change of the quantity; the prior standard deviation of the coefficients of a law (error
    as a function of covariates)."""
    observables: tuple[str, ...] = ()
    """Names of the observables that the quantity changes most; empty if they depend on positions of stations and
    targets."""
    changed_part: str = "instrument"
    """Part of the measurement to which the quantity belongs: `reading`, `instrument`, `circle`, `stand`, `target`,
    `air` or `reflector`."""
    component_names: tuple[str, ...] = ("",)
    """Names of the c components of the quantity. A scalar quantity has one component with an empty name."""
    component_si_per_coefficient: tuple[float, ...] = ()
    """Change [SI] of each component per unit of its coefficient; empty if all are 1."""
    component_units: tuple[str, ...] = ()
    """Display units of the components; empty if all have `display_unit`."""

    def display_unit_and_factor_on_coefficient(self, component_index: int) -> tuple[str, float]:
        """Display unit of the component `component_index`, and the factor from its coefficient to this unit."""
        unit, scale = (
            (self.component_units[component_index], self.component_si_per_coefficient[component_index])
            if self.component_units
            else (self.display_unit, 1.0)
        )
        return unit, scale / SI_PER_UNIT[unit]


_CHAIN_ERROR_RESPONSES = {
    "elevation": Response("vertical index", "urad", PLAUSIBLE_ANGLE_ERROR, ("elevation",)),
    "transit-offset": Response("transit offset", "um", PLAUSIBLE_LENGTH_ERROR),
    "transit-tilt": Response("transit tilt", "urad", PLAUSIBLE_ANGLE_ERROR, ("azimuth",)),
    "beam-lateral": Response("lateral beam offset", "um", PLAUSIBLE_LENGTH_ERROR, ("azimuth",)),
    "beam-vertical": Response("vertical beam offset", "um", PLAUSIBLE_LENGTH_ERROR, ("elevation",)),
    "beam-tilt": Response("beam tilt", "urad", PLAUSIBLE_ANGLE_ERROR, ("azimuth",)),
}
"""Responses (quantities that an empirical law changes) that are instrument constants, by the name of the constant in
the kinematic chain, such as `beam-tilt`."""
_ECCENTRICITY_RESPONSES = {
    Response(
        f"{effect.observables[0]} eccentricity",
        "urad",
        PLAUSIBLE_ANGLE_ERROR,
        effect.observables,
        "circle",
        ("cosine", "sine"),
    ): effect
    for effect in (AzimuthEccentricity(), ElevationEccentricity())
}
"""Responses (changed quantities) that are eccentricities of the circles, each with the catalogue effect that has the
same derivatives."""
_READING_RESPONSES = tuple(
    Response(
        name,
        "um" if name == "distance" else "urad",
        PLAUSIBLE_LENGTH_ERROR if name == "distance" else PLAUSIBLE_ANGLE_ERROR,
        (name,),
        "reading",
    )
    for name in OBSERVABLES
)
"""Responses (changed quantities) that are single observables."""
_PLAUSIBLE_SIZE_BY_OBSERVABLE = {
    "distance": PLAUSIBLE_LENGTH_ERROR,
    "azimuth": PLAUSIBLE_ANGLE_ERROR,
    "elevation": PLAUSIBLE_ANGLE_ERROR,
}
"""Plausible size [SI] of an error by the name of the observable."""
_MULTI_OBSERVABLE_RESPONSES = tuple(
    Response(
        " and ".join(names),
        "um" if names[0] == "distance" else "urad",
        _PLAUSIBLE_SIZE_BY_OBSERVABLE[names[0]],
        names,
        "reading",
        names,
        tuple(_PLAUSIBLE_SIZE_BY_OBSERVABLE[name] / _PLAUSIBLE_SIZE_BY_OBSERVABLE[names[0]] for name in names),
        tuple("um" if name == "distance" else "urad" for name in names),
    )
    for count in (2, 3)
    for names in combinations(OBSERVABLES, count)
)
"""Responses (changed quantities) that are pairs or triples of observables, each observable with separate coefficients
of the same regressor (function of covariates)."""
_RANGE_SCALE_RESPONSE = Response("range scale", "ppm", PLAUSIBLE_SCALE_ERROR, ("distance",))


def instrument_constants_of_chain_error(error_key: str) -> tuple[str, ...]:
    """Names of the instrument constants of the ordinary calibration that change an error of the kinematic chain.

    `error_key` is the key of the error of the chain, such as `azimuth`.
    """
    return tuple(
        p.name
        for e in ORDINARY_CALIBRATION_EFFECTS
        for p, t in zip(e.parameters, e.terms, strict=True)
        if t == ChainErrorTerm(error_key)
    )


INSTRUMENT_CONSTANTS_BY_RESPONSE = (
    {response.name: instrument_constants_of_chain_error(key) for key, response in _CHAIN_ERROR_RESPONSES.items()}
    | {response.name: tuple(p.name for p in effect.parameters) for response, effect in _ECCENTRICITY_RESPONSES.items()}
    | {"distance": instrument_constants_of_chain_error("range"), _RANGE_SCALE_RESPONSE.name: ("range-scale",)}
)
"""Names of the instrument constants of the ordinary calibration that a law (error as a function of covariates) changes,
by the name of its response (changed quantity)."""
_STAND_TILT_RESPONSE = Response("lean of the stand", "urad", PLAUSIBLE_ANGLE_ERROR, (), "stand", ("about x", "about y"))
_STAND_POSITION_RESPONSE = Response(
    "position of the stand", "um", PLAUSIBLE_MOTION, (), "stand", ("along x", "along y", "along z")
)
_TARGET_POSITION_RESPONSE = Response(
    "position of targets", "um", PLAUSIBLE_MOTION, (), "target", ("along x", "along y", "along z")
)
_TARGET_HEIGHT_RESPONSE = Response("height of targets in their nests", "um", PLAUSIBLE_MOTION, (), "target")
_AIR_GRADIENT_RESPONSE = Response("air gradient", "K/m", 1.0, (), "air")
_REFLECTOR_VERTEX_RESPONSE = Response(
    "vertex of the reflectors", "um", PLAUSIBLE_LENGTH_ERROR, (), "reflector", ("axially", "sideways", "up")
)
_DISPLACEMENT_TOWARDS_INSTRUMENT_RESPONSE = Response(
    "level displacement of reflectors towards the instrument", "um", PLAUSIBLE_LENGTH_ERROR, (), "reflector"
)


def _observable_design(sightings: Sightings, observable: str) -> Floats:
    """Derivatives (n, 3, 1) of the raw readings of n pointings with respect to a correction of one observable.

    The correction refers to readings in face 1. In face 2 the raw reading of an angle may change with the opposite
    sign.
    """
    return design_from_front_face_corrections(sightings, **{observable: np.ones(len(sightings))})[:, :, None]


def _multi_observable_design(sightings: Sightings, response: Response) -> Floats:
    """Derivatives (n, 3, c) of the raw readings of n pointings by the coefficients of a response with c observables."""
    component_designs = [
        scale * _observable_design(sightings, name)
        for name, scale in zip(response.observables, response.component_si_per_coefficient, strict=True)
    ]
    return np.concatenate(component_designs, axis=2)


def _chain_error_design(sightings: Sightings, error_key: str) -> Floats:
    """Derivatives (n, 3, 1) of the raw readings of n pointings with respect to an error of the kinematic chain.

    `error_key` is the key of the error, such as `azimuth`.
    """
    return sightings.reading_change_by_error_key[error_key][:, :, None]


def _range_scale_design(sightings: Sightings) -> Floats:
    """Derivatives (n, 3, 1) of the raw readings of n pointings with respect to the range scale."""
    return design_from_front_face_corrections(sightings, distance=sightings.range_)[:, :, None]


def _nest_normal_design(sightings: Sightings) -> Floats:
    """Derivatives (n, 3, 1) of the raw readings of n pointings by a motion of targets along their nests' normals."""
    normal = np.nan_to_num(sightings.nest_normals[sightings.target])
    return design_from_displacements(sightings, normal[:, :, None])


def _reflector_vertex_design(sightings: Sightings) -> Floats:
    """Derivatives (n, 3, 3) of the raw readings of n pointings by displacements of reflector vertices on three axes.

    The axes are the normal of the open face, the horizontal to the right (seen from the front), and up.
    """
    return design_from_displacements(sightings, reflector_axes(sightings))


def _displacement_towards_instrument_design(sightings: Sightings) -> Floats:
    """Derivatives (n, 3, 1) of the raw readings of n pointings by a horizontal motion of reflectors to the tracker."""
    back_sight = sightings.station_positions[sightings.station] - sightings.target_points[sightings.target]
    level = back_sight * [1.0, 1.0, 0.0]
    return design_from_displacements(
        sightings, (level / np.maximum(np.linalg.norm(level, axis=1), 1e-9)[:, None])[:, :, None]
    )


ResponseDesignFunction = Callable[[Sightings], Floats]
"""Function from the sightings of n pointings to the derivatives (n, 3, c) of their raw readings with respect to the c
components of a response (changed quantity)."""


def _response_registry() -> dict[str, tuple[Response, ResponseDesignFunction]]:
    """Responses by name, each with the function that returns the derivatives of the raw readings by the response.

    A law describes an error as a function of covariates. A response is the quantity that a law changes.
    """
    derivatives: list[tuple[Response, ResponseDesignFunction]] = [
        *((response, partial(_observable_design, observable=response.name)) for response in _READING_RESPONSES),
        *((response, partial(_multi_observable_design, response=response)) for response in _MULTI_OBSERVABLE_RESPONSES),
        *((response, partial(_chain_error_design, error_key=key)) for key, response in _CHAIN_ERROR_RESPONSES.items()),
        *((response, effect.design) for response, effect in _ECCENTRICITY_RESPONSES.items()),
        (_RANGE_SCALE_RESPONSE, _range_scale_design),
        (_STAND_TILT_RESPONSE, lambda s: s.pose_derivatives[:, :, 3:5]),
        (_STAND_POSITION_RESPONSE, lambda s: s.pose_derivatives[:, :, :3]),
        (_TARGET_POSITION_RESPONSE, lambda s: s.target_derivatives),
        (_AIR_GRADIENT_RESPONSE, AirGradient().design),
        (_TARGET_HEIGHT_RESPONSE, _nest_normal_design),
        (_REFLECTOR_VERTEX_RESPONSE, _reflector_vertex_design),
        (_DISPLACEMENT_TOWARDS_INSTRUMENT_RESPONSE, _displacement_towards_instrument_design),
    ]
    return {response.name: (response, derivative) for response, derivative in derivatives}


RESPONSE_AND_DESIGN_BY_NAME = _response_registry()
"""Responses (changed quantities) by name, each with the function for the derivatives (n, 3, c) of the raw readings of n
pointings with respect to its c components."""
_RESPONSES_NEEDING_NESTS = {_TARGET_HEIGHT_RESPONSE.name, _REFLECTOR_VERTEX_RESPONSE.name}
"""Names of the responses (changed quantities) that need the declared normals of nests."""


def response_designs(sightings: Sightings) -> dict[str, tuple[Response, Floats]]:
    """Responses by name, each with the derivatives (n, 3, c) of the raw readings of n pointings by its c components.

    A regressor is a function of covariates to which the error is proportional. A response is the quantity that a law
    changes. Of several responses with the same derivatives only the first is listed: for example, errors of the
    vertical index and of the elevation are the same if all readings are in one face. A motion of the stand is always
    listed, because it can depend on other regressors than a motion of the targets.
    """
    designs: dict[str, tuple[Response, Floats]] = {}
    has_nest_normals = bool(np.isfinite(sightings.nest_normals).any())
    for name, (response, derivative) in RESPONSE_AND_DESIGN_BY_NAME.items():
        if name in _RESPONSES_NEEDING_NESTS and not has_nest_normals:
            continue
        design = derivative(sightings)
        comparable = (d for c, d in designs.values() if d.shape == design.shape and c.changed_part != "stand")
        same = (np.allclose(np.abs(design), np.abs(other), rtol=1e-9, atol=0.0) for other in comparable)
        if design.any() and not any(same):
            designs[name] = response, design
    return designs
