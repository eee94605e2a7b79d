"""Incidence errors of reflectors in fixed nests (range errors by the angle of incidence), estimated with a prior.

Without a bench test the prior is that of the effect `smr-incidence`, for which the reflector of Sensors 2021, 21, 7479
is typical. With a bench test the prior follows from the results of this test. The estimated parameters are independent
errors with a standard deviation of one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.effects.effect import design_from_front_face_corrections
from ltsim.physics.effects.linear_effect import LinearEffect, Parameter
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.recordings.recording import Recording
from ltsim.recordings.reflectors import smr_names
from ltsim.recordings.setup import BenchTest
from ltsim.scene.sightings import Sightings

SMR_INCIDENCE_EFFECT = SmrIncidence()
"""Catalogue effect with the range error as a function of the angle of incidence."""
MIN_BENCH_TEST_SIGMA = 1e-3 * MICROMETRE
"""Smallest standard deviation [m] of a range error from a bench test, a tenth of the resolution of interferometers.
It replaces smaller declared values."""


@dataclass(frozen=True)
class IncidenceErrors(LinearEffect):
    """Range error of one reflector as a function of the angle of incidence: a mean function plus k independent errors.

    The mean function follows from a bench test and is zero without one.
    """

    reflector: str
    """Name of the reflector; empty if the recording has no names of reflectors."""
    reflector_indicator: Floats
    """Indicator (n,) of the pointings to the reflector: 1 for these, 0 for the others of n pointings."""
    mean_parameters: Floats
    """Parameters (p,) [SI] of `smr-incidence` for the expected range error; zeros without a bench test."""
    covariance_root: Floats
    """Root (p, k) of the covariance [SI] of the p parameters of the effect `smr-incidence`: column i is their change
    by one standard deviation of the independent error i."""

    @property
    def name(self) -> str:
        """Name of the incidence errors in lists of nuisance errors."""
        return "incidence-errors"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The k independent errors as parameters, each with a prior standard deviation of one."""
        return (
            Parameter("incidence-error", "", "range error of a reflector as a function of the angle of incidence", 1.0),
        ) * self.covariance_root.shape[1]

    def smr_incidence_parameters(self, independent_errors: Floats) -> Floats:
        """Parameters (p, ...) [SI] of the effect `smr-incidence` for values (k, ...) of the k independent errors."""
        change: Floats = np.tensordot(self.covariance_root, independent_errors, 1)
        return change + self.mean_parameters.reshape(-1, *[1] * (change.ndim - 1))

    def _range_error_design(self, sightings: Sightings) -> Floats:
        """Derivatives (n, p) of the range corrections of n pointings by the p parameters of `smr-incidence`.

        The derivatives are zero for pointings to other reflectors.
        """
        return (
            SMR_INCIDENCE_EFFECT.range_correction_design(*SMR_INCIDENCE_EFFECT.incidence_angle_and_direction(sightings))
            * self.reflector_indicator[:, None]
        )

    def design(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, k) of the raw readings of n pointings with respect to the k independent errors."""
        return design_from_front_face_corrections(
            sightings, distance=self._range_error_design(sightings) @ self.covariance_root
        )

    def reading_change(self, sightings: Sightings, independent_errors: Floats) -> Floats:
        """Change (n, 3) of the readings of n pointings by the incidence error: mean plus k independent errors (k,)."""
        return design_from_front_face_corrections(
            sightings, distance=self._range_error_design(sightings) @ self.smr_incidence_parameters(independent_errors)
        )


def incidence_errors(recording: Recording) -> tuple[IncidenceErrors, ...]:
    """Incidence errors of a recording: one entry per reflector in a fixed nest with a known normal."""
    return tuple(_iterate_incidence_errors(recording))


def incidence_reading_change(
    recording: Recording, sightings: Sightings, parameters_by_reflector: Mapping[str, Floats]
) -> Floats:
    """Change (n, 3) of the readings of n pointings by the incidence errors of reflectors.

    `parameters_by_reflector` has the p parameters (p,) [SI] of the effect `smr-incidence` by the name of the reflector.
    A reflector without an entry has no incidence error.
    """
    names = np.array(smr_names(recording))
    by_law = SMR_INCIDENCE_EFFECT.design(sightings)
    change = np.zeros((len(recording), 3))
    for name, values in parameters_by_reflector.items():
        change += np.where((names == name)[:, None], by_law @ values, 0.0)
    return change


def _iterate_incidence_errors(recording: Recording) -> Iterator[IncidenceErrors]:
    """Iterator over the incidence errors of each reflector in a fixed nest with a known normal."""
    setups = [recording.target_setup(name) for name in recording.targets]
    nests = np.array([not setup.reaimed and setup.nest_normal is not None for setup in setups], dtype=bool)
    fixed = nests[recording.target]
    if not fixed.any():
        return
    names = np.array(smr_names(recording))
    tests = {test.reflector: test for test in recording.setup.bench}
    for name in dict.fromkeys(names[fixed].tolist()):
        law = incidence_prior_from_bench_test(tests.get(name, tests.get("")))
        yield IncidenceErrors(name, (fixed & (names == name)).astype(np.float64), *law)


def incidence_prior_from_bench_test(bench_test: BenchTest | None) -> tuple[Floats, Floats]:
    """Prior of the p parameters of `smr-incidence` from a bench test: mean (p,) [SI], root R (p, p) of the covariance.

    The covariance is R R'. Without a bench test (None) the mean is zero, and the covariance is the prior of the effect.
    """
    mean, root = np.zeros(len(SMR_INCIDENCE_EFFECT.parameters)), np.diag(SMR_INCIDENCE_EFFECT.plausible_sizes)
    if bench_test is None:
        return mean, root
    angle, error, sigma = (
        np.array(column) for column in (bench_test.angle_deg, bench_test.error_um, bench_test.sigma_um)
    )
    middle_index = int(np.argmin(np.abs(angle)))
    direction = np.where(angle < 0.0, np.pi, 0.0) + bench_test.direction_deg * DEGREE
    terms = -SmrIncidence.range_correction_design(np.abs(angle) * DEGREE, direction)
    is_used = np.arange(len(angle)) != middle_index
    spread = np.maximum(sigma[is_used, None] * MICROMETRE, MIN_BENCH_TEST_SIGMA)
    sensitivity = (terms - terms[middle_index])[is_used] @ root / spread
    whitened = ((error - error[middle_index]) * MICROMETRE)[is_used] / spread[:, 0]
    contraction = np.linalg.inv(np.linalg.cholesky(np.eye(len(mean)) + sensitivity.T @ sensitivity))
    return root @ (contraction.T @ (contraction @ (sensitivity.T @ whitened))), root @ contraction.T
