"""Kinematic chain of a tracker as arrays for the compiled functions, linearised at the nominal readings of a network.

The amount of each motion (angle of a rotation, length of a translation) is its nominal amount plus a small deviation,
so that trigonometric functions of large angles are computed only once. A parameter changes the amount of a motion by
the parameter times a basis function of the readings. The basis function is expanded to first order in the deviations of
the readings from nominal. The neglected term is half the second derivative times the squared deviation times the
parameter: 2e-16 rad for deviations and parameters of 10 urad, 1e-12 m at 5 m for 100 um and 100 urad.
"""

from typing import NamedTuple, Self

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.geometry.kinematics import ElementaryMotion, RotationStep
from ltsim.physics.model.construction import GeometricErrorModel

BASIS_DERIVATIVE_STEP = 1e-4
"""Step [m, rad] of the central difference for the derivative of a basis function; the derivative has a relative error
of 1e-9."""


class ChainArrays(NamedTuple):
    """Kinematic chain as arrays: motions (rotations and translations) from the tracker's base to the target.

    The amount of a motion is the angle [rad] of a rotation or the length [m] of a translation. Parameters change the
    amounts.
    """

    is_rotation: Ints
    """Kind of each motion, (motions,): 1 for a rotation, 0 for a translation."""
    axis_indices: Ints
    """Coordinate axis of each motion, (motions,): 0 for x, 1 for y, 2 for z."""
    reading_signs: Floats
    """Sign (1 or -1) with which a reading enters the amount of each motion, (motions,)."""
    reading_indices: Ints
    """Index of the reading that determines the amount of each motion, (motions,): 0 range, 1 azimuth, 2 elevation, -1
    none."""
    nominal_amounts: Floats
    """Amount of each motion at the nominal readings, (motions, pointings, 2): length [m] of a translation in the first
    entry, or cosine and sine of a rotation."""
    parameter_offsets: Ints
    """Offsets (motions + 1,) into `parameter_indices`: the parameters that act on motion m are
    ``parameter_indices[parameter_offsets[m] : parameter_offsets[m + 1]]``."""
    parameter_indices: Ints
    """Indices of the parameters that act on each motion, listed motion by motion, shape (pairs of motion and
    parameter,)."""
    depends_on_readings: Ints
    """Mask (parameters,), 1 for a parameter whose basis function depends on the readings."""
    basis_values: Floats
    """Value of each parameter's basis function at the nominal readings, (parameters, pointings)."""
    basis_derivatives: Floats
    """Derivative of each basis function with respect to the three readings, (parameters, pointings, 3)."""

    @classmethod
    def from_construction(cls, construction: GeometricErrorModel, readings: Floats) -> Self:
        """Chain of an error model, linearised at `readings` (pointings, 3), without motions that are always zero."""
        error_keys = [term.chain_error_key for term in construction.terms]
        parameters_by_error_key = {
            m.error_key: [k for k, key in enumerate(error_keys) if key == m.error_key]
            for m in construction.kinematic_chain
            if m.error_key
        }
        motions = [
            m
            for m in construction.kinematic_chain
            if m.motion_amount_function is not None or parameters_by_error_key.get(m.error_key)
        ]
        feeds = [parameters_by_error_key.get(m.error_key, []) for m in motions]
        slope = _basis_derivatives(construction, readings)
        return cls(
            is_rotation=np.array([isinstance(m, RotationStep) for m in motions], dtype=np.int64),
            axis_indices=np.array([m.axis for m in motions], dtype=np.int64),
            reading_signs=np.array([m.amount_factor for m in motions]),
            reading_indices=np.array([_reading_index(m) for m in motions], dtype=np.int64),
            nominal_amounts=np.array([_nominal_amount(m, readings) for m in motions]),
            parameter_offsets=np.concatenate([[0], np.cumsum([len(f) for f in feeds])]).astype(np.int64),
            parameter_indices=np.array([k for f in feeds for k in f], dtype=np.int64),
            depends_on_readings=np.any(slope != 0, axis=(1, 2)).astype(np.int64),
            basis_values=np.ascontiguousarray(construction.basis_values(readings).T),
            basis_derivatives=slope,
        )

    def with_trial_axis(self, n_trials: int) -> Self:
        """Chain in which the arrays by pointing have an additional last axis for `n_trials` trials.

        In the arrays of this chain, the entries of all trials of a pointing follow each other along the axis of
        pointings.
        """

        def per_trial(array_rows: Floats) -> Floats:
            by_trial = array_rows.reshape(
                array_rows.shape[0], array_rows.shape[1] // n_trials, n_trials, *array_rows.shape[2:]
            )
            return np.ascontiguousarray(np.moveaxis(by_trial, 2, -1))

        return self._replace(
            nominal_amounts=per_trial(self.nominal_amounts),
            basis_values=per_trial(self.basis_values),
            basis_derivatives=per_trial(self.basis_derivatives),
        )


def _reading_index(motion: ElementaryMotion) -> int:
    """Index of the reading that determines the amount of a motion: 0 range, 1 azimuth, 2 elevation, -1 none."""
    if motion.motion_amount_function is None:
        return -1
    probe = np.vstack([np.zeros(3), np.eye(3)])
    probed_amounts = np.asarray(motion.motion_amount_function(probe))
    return next((c for c in range(3) if probed_amounts[c + 1] != probed_amounts[0]), -1)


def _nominal_amount(motion: ElementaryMotion, readings: Floats) -> Floats:
    """Amount of a motion, (pointings, 2): length [m] and 0 of a translation, or cosine and sine of a rotation."""
    nominal_amounts = (
        np.zeros(len(readings))
        if motion.motion_amount_function is None
        else motion.amount_factor * motion.motion_amount_function(readings)
    )
    if isinstance(motion, RotationStep):
        return np.stack([np.cos(nominal_amounts), np.sin(nominal_amounts)], axis=1)
    return np.stack([nominal_amounts, np.zeros_like(nominal_amounts)], axis=1)


def _basis_derivatives(construction: GeometricErrorModel, readings: Floats) -> Floats:
    """Derivative (parameters, pointings, 3) of each parameter's basis function by the readings, by differences."""
    step = BASIS_DERIVATIVE_STEP * np.eye(3)[:, None, :]
    shifted_readings = np.concatenate([readings + step, readings - step]).reshape(-1, 3)
    ahead, behind = (
        construction.basis_values(shifted_readings)
        .T.reshape(construction.n_parameters, 2, 3, len(readings))
        .swapaxes(0, 1)
    )
    return np.ascontiguousarray(np.swapaxes((ahead - behind) / (2 * BASIS_DERIVATIVE_STEP), 1, 2))
