"""Geometric error model of a tracker: a kinematic chain with error parameters, from readings to points and back."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import ModelError, NetworkError, unknown_name_error
from ltsim.core.units import ARCSECOND, MICROMETRE, PPM
from ltsim.geometry import kinematics
from ltsim.geometry.polar import polar_jacobian, swap_front_and_raw, to_polar, wrap_angle
from ltsim.physics.effects import ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.effects.azimuth_eccentricity import AzimuthEccentricity
from ltsim.physics.effects.azimuth_second_order import AzimuthSecondOrder
from ltsim.physics.effects.effect import (
    BasisFunction,
    ChainErrorEffect,
    ChainErrorTerm,
    HarmonicBasis,
    Parameter,
    RangePowerBasis,
    constant_basis,
)
from ltsim.physics.effects.linear_effect import SpecifiedQuantity
from ltsim.physics.effects.range_offset import RangeOffset
from ltsim.physics.effects.range_scale import RangeScale
from ltsim.physics.effects.transit_offset import TransitOffset
from ltsim.physics.effects.transit_tilt import TransitTilt
from ltsim.physics.effects.vertical_index import VerticalIndex
from ltsim.recordings.recording import Recording

MAX_NEWTON_STEPS = 12
"""Largest number of Newton steps in the inversion of the kinematic chain."""
NEWTON_TOLERANCE = 1e-14
"""Size of a Newton step [m, rad] at which the inversion of the kinematic chain ends."""
NEWTON_FINAL_STEP_THRESHOLD = 1e-11
"""Size of a Newton step [m, rad] after which one more step, with the exact derivative, leaves only rounding errors."""


@dataclass(frozen=True)
class GeometricErrorModel:
    """Geometric error model of a tracker: its kinematic chain, and parameters for the errors of this chain."""

    name: str
    """Name of the model: `misalignment`, `dh`, `steering-mirror` or `ideal`."""
    kinematic_chain: kinematics.KinematicChain
    """Kinematic chain from the base of the tracker to the target."""
    parameters: tuple[Parameter, ...]
    """The p error parameters of the instrument, with priors."""
    terms: tuple[ChainErrorTerm, ...]
    """Terms, one per parameter: error of the kinematic chain that the parameter changes, and error per unit of it."""

    @property
    def n_parameters(self) -> int:
        """Number p of error parameters."""
        return len(self.parameters)

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of `parameters`."""
        return tuple(p.name for p in self.parameters)

    def instrument_parameter_names(self, instruments: Sequence[str]) -> tuple[str, ...]:
        """Names of the p parameters of each of I instruments, I p in number; ``beam-tilt@NAME`` if I > 1."""
        marks = [f"@{name}" if name and len(instruments) > 1 else "" for name in instruments]
        return tuple(name + mark for mark in marks for name in self.parameter_names)

    def parameter_index(self, name: str) -> int:
        """Index in `parameters` of the parameter with the name `name`."""
        if name not in self.parameter_names:
            raise unknown_name_error("instrument parameter", name, self.parameter_names)
        return self.parameter_names.index(name)

    def with_parameter_subset(self, indices: Iterable[int]) -> Self:
        """Copy of the model with only the parameters that have the given indices."""
        subset = [int(k) for k in indices]
        parameters, terms = tuple(self.parameters[k] for k in subset), tuple(self.terms[k] for k in subset)
        return replace(self, parameters=parameters, terms=terms)

    @cached_property
    def _chain_with_reading_errors(self) -> tuple[kinematics.KinematicChain, tuple[str, ...]]:
        """Kinematic chain with an additional error in each motion that is a reading, and names of the three errors."""
        zero_reading, chain, error_keys = np.zeros((1, 3)), list(self.kinematic_chain), []
        functions = [m.motion_amount_function for m in self.kinematic_chain]
        for column in range(3):
            unit_reading = np.eye(3)[[column]]
            place = [f is not None and f(unit_reading)[0] != f(zero_reading)[0] for f in functions].index(True)
            error_keys.append(chain[place].error_key or f"reading-{column}")
            chain[place] = replace(chain[place], error_key=error_keys[-1])
        return tuple(chain), tuple(error_keys)

    def basis_values(self, readings: Floats) -> Floats:
        """Values (n, p) of the basis functions (errors per unit of p parameters) at n raw readings (n, 3)."""
        bases = np.ones((len(self.terms), len(readings)))
        for k, term in self._reading_dependent_terms:
            bases[k] = term.basis(readings)
        return bases.T

    @cached_property
    def _reading_dependent_terms(self) -> list[tuple[int, ChainErrorTerm]]:
        """Indices and terms of the parameters whose basis function (error per unit) depends on the readings."""
        return [(k, term) for k, term in enumerate(self.terms) if term.basis is not constant_basis]

    def chain_errors(self, readings: Floats, parameter_values: Floats) -> dict[str, Floats]:
        """Errors [m, rad] of the chain by key (such as `beam-tilt`), each (n,) or a number, at n raw readings (n, 3).

        `parameter_values` (p,), or (n, p) with separate values for each reading, are in SI units.
        """
        errors: dict[str, Floats] = {}
        for term, value in zip(self.terms, parameter_values.T, strict=True):
            amount = value if term.basis is constant_basis else term.basis(readings) * value
            key = term.chain_error_key
            errors[key] = errors[key] + amount if key in errors else amount
        return errors

    def _errors_from_basis_values(self, basis_values: Floats, parameter_values: Floats) -> dict[str, Floats]:
        """Errors (n,) of the chain by key (such as `beam-tilt`), from errors (n, p) per unit of p parameters."""
        errors: dict[str, Floats] = {}
        for term, amount in zip(self.terms, (basis_values * parameter_values).T, strict=True):
            key = term.chain_error_key
            errors[key] = errors[key] + amount if key in errors else amount
        return errors

    def points_from_readings(self, readings: Floats, values: Floats) -> Floats:
        """Points (n, 3) [m] in the instrument frame from n raw readings (n, 3); `values` are the parameters [SI]."""
        errors = self.chain_errors(readings, values)
        return kinematics.points_from_raw_readings(self.kinematic_chain, readings, errors)

    def linearise(self, readings: Floats, values: Floats) -> tuple[Floats, Floats, Floats]:
        """Points (n, 3) [m] in the instrument frame, and derivatives by readings (n, 3, 3) and parameters (n, 3, p).

        The derivatives by the n raw readings neglect that the errors of the chain depend on the readings, a relative
        error of 1e-5.
        """
        (chain, reading_error_keys), bases = self._chain_with_reading_errors, self.basis_values(readings)
        error_keys = {term.chain_error_key for term in self.terms} | set(reading_error_keys)
        errors = self._errors_from_basis_values(bases, values)
        p, by_error = kinematics.points_and_error_derivatives(chain, readings, errors, error_keys)
        by_reading = np.stack([by_error[key] for key in reading_error_keys], axis=2)
        if not self.terms:
            return p, by_reading, np.zeros((len(readings), 3, 0))
        by_value = np.stack([by_error[term.chain_error_key] for term in self.terms], axis=2)
        return p, by_reading, by_value * bases[:, None, :]

    def readings_from_points(self, points: Floats, face: Ints, parameter_values: Floats) -> Floats:
        """Raw readings (n, 3) in the faces `face` (n,) of n points (n, 3) [m] in the instrument frame; exact."""
        raw = self._invert_chain(points, face, parameter_values, NEWTON_TOLERANCE)
        raw[:, 1] = wrap_angle(raw[:, 1])
        return raw

    def _invert_chain(self, points: Floats, face: Ints, parameter_values: Floats, tolerance: float) -> Floats:
        """Raw readings (n, 3) of n points (n, 3) [m] by Newton's method, with errors below `tolerance` [m, rad].

        Azimuths may exceed pi. Each step uses the derivative of an ideal tracker and reduces the error by a factor of
        about 1e-5. The last step is omitted if this factor predicts a step below `tolerance`.
        """
        polar = to_polar(points)
        raw = swap_front_and_raw(polar, face)
        if not np.any(parameter_values):
            return raw
        by_point, before = polar_jacobian(polar, face), np.inf
        for _ in range(MAX_NEWTON_STEPS):
            step = np.einsum("nij,nj->ni", by_point, points - self.points_from_readings(raw, parameter_values))
            raw = raw + step
            size = float(np.max(np.abs(step), initial=0.0))
            if not (size > tolerance and (before == np.inf or size * size > tolerance * before)):
                break
            before = size
        return raw

    def readings_and_design(self, points: Floats, face: Ints, values: Floats) -> tuple[Floats, Floats, Floats]:
        """Raw readings (n, 3) of n points (n, 3) [m], and derivatives by points (n, 3, 3) and parameters (n, 3, p)."""
        raw = self._invert_chain(points, face, values, NEWTON_FINAL_STEP_THRESHOLD)
        reached, by_reading, by_value = self.linearise(raw, values)
        by_point: Floats = np.asarray(np.linalg.inv(by_reading), dtype=np.float64)
        raw = raw + np.einsum("nij,nj->ni", by_point, points - reached)
        raw[:, 1] = wrap_angle(raw[:, 1])
        return raw, by_point, -by_point @ by_value

    def reading_design(self, readings: Floats, parameter_values: Floats) -> tuple[Floats, Floats]:
        """Derivatives of n raw readings (n, 3) by instrument-frame points (n, 3, 3) and by p parameters (n, 3, p)."""
        _, by_reading, by_value = self.linearise(readings, parameter_values)
        by_point = np.asarray(np.linalg.inv(by_reading), dtype=np.float64)
        return by_point, -by_point @ by_value


def misalignment_construction(
    effects: Iterable[ChainErrorEffect] = ORDINARY_CALIBRATION_EFFECTS,
) -> GeometricErrorModel:
    """Geometric error model of a tracker with the laser source in the head; usually with all 16 misalignments."""
    effects = tuple(effects)
    parameters, terms = (tuple(p for e in effects for p in e.parameters), tuple(t for e in effects for t in e.terms))
    return GeometricErrorModel("misalignment", kinematics.MISALIGNMENT_CHAIN, parameters, terms)


UNIT_AND_SIGMA_BY_SPECIFIED_QUANTITY: dict[str, tuple[str, float]] = {
    "offset": ("um", 20 * MICROMETRE),
    "angle": ("urad", 3 * ARCSECOND),
    "range_offset": ("um", 10 * MICROMETRE),
    "range_scale": ("ppm", 2 * PPM),
}
"""Display unit and prior standard deviation [SI] of a parameter, by the quantity for which the specification limits the
parameter."""
COEFFICIENT_SUFFIXES = ("c", "sin", "cos", "sin2", "cos2", "sin3", "cos3", "sin4", "cos4")
"""Suffixes of the names of the coefficients in the error function of an axis: constant, sines and cosines."""
DH_ERROR_MOTIONS = ("eX", "eY", "eZ", "dX", "dY", "dZ")
"""Names of the six error motions of an axis in the Denavit-Hartenberg model: rotations (e) and translations (d)."""
MAX_DH_HARMONIC_ORDER = 4
"""Highest order of the harmonics in the errors of the azimuth and elevation axes of the Denavit-Hartenberg model."""
MAX_DH_POLYNOMIAL_DEGREE = 9
"""Highest degree of the polynomials of the range in the Denavit-Hartenberg model."""

SPECIFIED_QUANTITY_BY_DH_COEFFICIENT: dict[str, SpecifiedQuantity] = {
    "J1.dX_c": "offset",
    "T.dX_0": "offset",
    "T.dY_0": "offset",
    **dict.fromkeys(("J1.eX_c", "J2.eX_c", "J2.eY_c"), "angle"),
    **dict.fromkeys(
        (f"{joint}.eY_{wave}" for joint in ("J1", "J2") for wave in ("sin", "cos", "sin2", "cos2")), "angle"
    ),
    "T.dZ_0": "range_offset",
    "T.dZ_1": "range_scale",
}
"""Quantity of the specification that limits a Denavit-Hartenberg coefficient, by name. These coefficients are
equivalent to the misalignments of a tracker with the laser source in the head."""

_EQUAL_PRIOR_CONTRIBUTION_RANGE = 5.0
"""Range [m] at which the terms of all degrees of a range polynomial have equal prior contributions."""
UNPHYSICAL_DH_SIGMA = 0.05
"""Prior standard deviation [5 um or 1 arcsec] of coefficients that are not in `SPECIFIED_QUANTITY_BY_DH_COEFFICIENT`.
They have no physical cause, and most of them act like other coefficients (`DH_CHAIN`)."""


def dh_construction(max_order: int = 2, degree: int = 2) -> GeometricErrorModel:
    """Denavit-Hartenberg model of a tracker (Sensors 2021, 21, 7479) with all coefficients of its eq. 3, 4, 6 and 7.

    Parameters
    ----------
    max_order : int
        Highest order of the harmonics of the azimuth and elevation axes, 0 to 4.
    degree : int
        Degree of the polynomials in the range that describe the error motions of the range axis.

    Notes
    -----
    Sine and cosine coefficients replace amplitude and phase of Sensors 2021, 21, 7479, because the phase is undefined
    at zero amplitude. Units are um and urad; coefficient k of a polynomial is per metre^k.
    """
    joints = [(f"{joint}.{motion}", column) for joint, column in (("J1", 1), ("J2", 2)) for motion in DH_ERROR_MOTIONS]
    waves = range(2 * max_order + 1)
    rows = [(key, COEFFICIENT_SUFFIXES[k], _axis_error_basis(column, k), 1.0) for key, column in joints for k in waves]
    rows += [
        (f"T.{motion}", str(k), RangePowerBasis(k), _EQUAL_PRIOR_CONTRIBUTION_RANGE**-k)
        for motion in DH_ERROR_MOTIONS
        for k in range(degree + 1)
    ]
    parameters, terms = [], []
    for key, end, basis, scale in rows:
        name = f"{key}_{end}"
        quantity = SPECIFIED_QUANTITY_BY_DH_COEFFICIENT.get(name)
        unit, size = ("urad", ARCSECOND) if ".e" in key else ("um", 5 * MICROMETRE)
        unspecified = unit, UNPHYSICAL_DH_SIGMA * size * scale
        unit, sigma = UNIT_AND_SIGMA_BY_SPECIFIED_QUANTITY[quantity] if quantity else unspecified
        parameters.append(Parameter(name, unit, f"coefficient {name} of the Denavit-Hartenberg chain", sigma, quantity))
        terms.append(ChainErrorTerm(key, basis))
    return GeometricErrorModel("dh", kinematics.DH_CHAIN, tuple(parameters), tuple(terms))


def _axis_error_basis(column: int, basis_number: int) -> BasisFunction:
    """Basis function `basis_number` of the series 1, sin x, cos x, sin 2x, ... of the angle x in the given `column`."""
    order = (basis_number + 1) // 2
    return HarmonicBasis("sin" if basis_number % 2 else "cos", column, order) if basis_number else constant_basis


GEOMETRIC_ERRORS_OF_BOTH_DESIGNS: tuple[ChainErrorEffect, ...] = (
    RangeOffset(),
    RangeScale(),
    TransitOffset(),
    TransitTilt(),
    VerticalIndex(),
    AzimuthEccentricity(),
    AzimuthSecondOrder(),
)
"""Geometric errors that trackers with the source in the head and with a steering mirror have, with equal error keys."""
MIRROR_PARAMETERS: tuple[tuple[str, SpecifiedQuantity, HarmonicBasis | None, str], ...] = (
    ("mirror-offset", "offset", None, "mirror in front of the transit axis, along its normal"),
    ("mirror-tilt", "angle", None, "angle from the transit axis to the plane of the mirror, positive to the left"),
    ("cover-forward", "offset", None, "beam forward of the standing axis, turning with the head"),
    ("cover-left", "offset", None, "beam left of the standing axis, turning with the head"),
    ("beam-x", "offset", None, "distance of the beam from the standing axis, along x of the base"),
    ("beam-y", "offset", None, "distance of the beam from the standing axis, along y of the base"),
    ("beam-tilt-x", "angle", None, "tilt of the beam about x of the base"),
    ("beam-tilt-y", "angle", None, "tilt of the beam about y of the base"),
    (
        "elevation-eccentricity-cos",
        "angle",
        HarmonicBasis("cos", 2, 0.5),
        "cosine of the mirror's angle, half the raw elevation",
    ),
    ("elevation-eccentricity-sin", "angle", HarmonicBasis("sin", 2, 0.5), "sine of the mirror's angle"),
    ("elevation-second-order-cos", "angle", HarmonicBasis("cos", 2, 1.0), "cosine of twice the mirror's angle"),
    ("elevation-second-order-sin", "angle", HarmonicBasis("sin", 2, 1.0), "sine of twice the mirror's angle"),
)
"""Misalignments of mirror, axes, cover plate and beam: name, specified quantity, harmonic of the mirror's angle (half
the raw elevation), description. Without harmonic, the chain error of that name is changed (`STEERING_MIRROR_CHAIN`)."""


def steering_mirror_construction() -> GeometricErrorModel:
    """Geometric error model of a tracker with a beam-steering mirror, with 21 parameters."""
    parameters = [p for effect in GEOMETRIC_ERRORS_OF_BOTH_DESIGNS for p in effect.parameters]
    terms = [t for effect in GEOMETRIC_ERRORS_OF_BOTH_DESIGNS for t in effect.terms]
    for name, kind, lobe, meaning in MIRROR_PARAMETERS:
        unit, sigma = UNIT_AND_SIGMA_BY_SPECIFIED_QUANTITY[kind]
        parameters.append(Parameter(name, unit, meaning, sigma, kind))
        terms.append(ChainErrorTerm("elevation", lobe) if lobe else ChainErrorTerm(name))
    return GeometricErrorModel("steering-mirror", kinematics.STEERING_MIRROR_CHAIN, tuple(parameters), tuple(terms))


def ideal_construction() -> GeometricErrorModel:
    """Geometric error model of an ideal tracker, which has no parameters."""
    return GeometricErrorModel("ideal", kinematics.MISALIGNMENT_CHAIN, (), ())


CONSTRUCTION_FACTORY_BY_NAME: dict[str, Callable[[], GeometricErrorModel]] = {
    "misalignment": misalignment_construction,
    "dh": dh_construction,
    "steering-mirror": steering_mirror_construction,
    "ideal": ideal_construction,
}
"""Functions that create a geometric error model with its usual orders of series, by the name of the model."""


def make_construction(name: str, max_order: int | None = None, degree: int | None = None) -> GeometricErrorModel:
    """Geometric error model by name; `dh` has harmonics up to `max_order` and range polynomials of `degree`.

    Raises ModelError for an unknown name, for orders of another model than `dh`, and for an order out of bounds.
    """
    if name not in CONSTRUCTION_FACTORY_BY_NAME:
        raise unknown_name_error("construction", name, CONSTRUCTION_FACTORY_BY_NAME)
    if max_order is None and degree is None:
        return CONSTRUCTION_FACTORY_BY_NAME[name]()
    if name != "dh":
        raise ModelError(f"harmonics and degree can be set for the construction 'dh' only, not for '{name}'")
    limits = (("harmonics", max_order, MAX_DH_HARMONIC_ORDER), ("degree", degree, MAX_DH_POLYNOMIAL_DEGREE))
    for what, order, highest in limits:
        if order is not None and not 0 <= order <= highest:
            raise ModelError(f"{what} is {order}, expected 0 to {highest}")
    return dh_construction(2 if max_order is None else max_order, 2 if degree is None else degree)


def construction_with_dh_orders(name: str, max_order: int, degree: int) -> GeometricErrorModel:
    """Geometric error model by name; order of the harmonics and degree of the polynomials apply to ``dh`` only."""
    return dh_construction(max_order, degree) if name == "dh" else make_construction(name)


def construction_for_parameters(name: str, parameters: Iterable[str]) -> GeometricErrorModel:
    """Geometric error model by name; for ``dh`` the smallest orders of its series that include all `parameters`."""
    if name != "dh":
        return make_construction(name)
    ends = [p.rpartition("_") for p in parameters]
    orders = [
        (COEFFICIENT_SUFFIXES.index(end) + 1) // 2
        for front, _, end in ends
        if not front.startswith("T.") and end in COEFFICIENT_SUFFIXES
    ]
    powers = [int(end) for front, _, end in ends if front.startswith("T.") and end.isdecimal()]
    return dh_construction(max(orders, default=2), min(max(powers, default=2), MAX_DH_POLYNOMIAL_DEGREE))


@cache
def all_instrument_parameter_names() -> frozenset[str]:
    """Names of the parameters of all geometric error models, with all coefficients of the Denavit-Hartenberg model."""
    constructions = (
        misalignment_construction(),
        steering_mirror_construction(),
        dh_construction(MAX_DH_HARMONIC_ORDER, MAX_DH_POLYNOMIAL_DEGREE),
    )
    return frozenset(name for construction_ in constructions for name in construction_.parameter_names)


def construction_of_beam_origin(beam_origin: str) -> GeometricErrorModel:
    """Geometric error model by the origin of the beam that the set-up declares: head or `steering-mirror`."""
    return steering_mirror_construction() if beam_origin == "steering-mirror" else misalignment_construction()


def declared_construction(recording: Recording) -> GeometricErrorModel:
    """Geometric error model of a recording's instruments, by the origin of the beam that the set-up declares.

    Raises NetworkError if the recording has instruments of both designs, because their parameters differ.
    """
    designs = {name: recording.setup.instrument_of(name).construction for name in recording.stations}
    if len(set(designs.values())) > 1:
        mirror = ", ".join(name for name, design in designs.items() if design == "steering-mirror")
        message = f"stations {mirror} have a tracker with a steering mirror, other stations have the source in the head"
        raise NetworkError(f"{message}; calibrate them separately, or choose one construction for all")
    return construction_of_beam_origin(next(iter(designs.values()), ""))
