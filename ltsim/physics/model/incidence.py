"""Incidence errors of reflectors in fixed nests: how large they may be is known, so each is estimated with the network.

Without a bench test the prior of the effect `smr-incidence` holds: the paper's reflector is a typical one. A test
conditions that prior. Parameters are independent standard deviations of what is left.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.effects.effect import on_readings
from ltsim.physics.effects.signature import Parameter, Signature
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.recordings.recording import Recording
from ltsim.recordings.reflectors import smrs_of
from ltsim.recordings.setup import BenchTest
from ltsim.scene.sightings import Sightings

LAW = SmrIncidence()
EXACT = 1e-3 * MICROMETRE
"""Smallest standard deviation of a bench test's error: a tenth of what interferometers resolve."""


@dataclass(frozen=True)
class IncidenceErrors(Signature):
    """The incidence error of one reflector as a sum of k independent errors around what a bench test says of it."""

    reflector: str
    """Name of the reflector; empty where the recording names none."""
    acts: Floats
    """(n,): 1 for pointings to the reflector, else 0."""
    mean: Floats
    """Expected parameters of `smr-incidence`, (p,) [SI]."""
    root: Floats
    """Change of these by one standard deviation of each error, (p, k) [SI]."""

    @property
    def name(self) -> str:
        """Name of the law."""
        return "incidence-errors"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Errors, one per unknown, each with a prior of one standard deviation."""
        return (Parameter("incidence-error", "", "error of a reflector against incidence", 1.0),) * self.root.shape[1]

    def law_values(self, values: Floats) -> Floats:
        """Parameters (p, ...) [SI] of `smr-incidence` at errors (k, ...)."""
        change: Floats = np.tensordot(self.root, values, 1)
        return change + self.mean.reshape(-1, *[1] * (change.ndim - 1))

    def _by_law(self, sightings: Sightings) -> Floats:
        """Range error (n, p) per unit of each parameter of the law."""
        return LAW.terms(*LAW.incidence(sightings)) * self.acts[:, None]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, k) of the raw readings by each error."""
        return on_readings(sightings, distance=self._by_law(sightings) @ self.root)

    def shift(self, sightings: Sightings, values: Floats) -> Floats:
        """Change (n, 3) of the raw readings by errors (k,) around the mean."""
        return on_readings(sightings, distance=self._by_law(sightings) @ self.law_values(values))


def incidence_errors(recording: Recording) -> tuple[IncidenceErrors, ...]:
    """The incidence error of every reflector that stood in a fixed nest of known direction."""
    return tuple(_incidence_errors(recording))


def incidence_shift(recording: Recording, sightings: Sightings, reflectors: Mapping[str, Floats]) -> Floats:
    """Change (n, 3) of the readings by the incidence errors of reflectors.

    `reflectors` gives the parameters (p,) [SI] of `smr-incidence` by the reflector's name; those that it lacks have no
    error.
    """
    names = np.array(smrs_of(recording))
    by_law = LAW.design(sightings)
    change = np.zeros((len(recording), 3))
    for name, values in reflectors.items():
        change += np.where((names == name)[:, None], by_law @ values, 0.0)
    return change


def _incidence_errors(recording: Recording) -> Iterator[IncidenceErrors]:
    setups = [recording.target_setup(name) for name in recording.targets]
    nests = np.array([not setup.reaimed and setup.nest_normal is not None for setup in setups], dtype=bool)
    fixed = nests[recording.target]
    if not fixed.any():
        return
    names = np.array(smrs_of(recording))
    tests = {test.reflector: test for test in recording.setup.bench}
    for name in dict.fromkeys(names[fixed].tolist()):
        law = conditioned(tests.get(name, tests.get("")))
        yield IncidenceErrors(name, (fixed & (names == name)).astype(np.float64), *law)


def conditioned(test: BenchTest | None) -> tuple[Floats, Floats]:
    """Mean (p,) and root (p, p) of the covariance of the parameters of `smr-incidence`, given a bench test."""
    mean, root = np.zeros(len(LAW.parameters)), np.diag(LAW.spread)
    if test is None:
        return mean, root
    angle, error, sigma = (np.array(column) for column in (test.angle_deg, test.error_um, test.sigma_um))
    middle = int(np.argmin(np.abs(angle)))
    positive = np.where(angle < 0.0, np.pi, 0.0) + test.direction_deg * DEGREE
    terms = -SmrIncidence.terms(np.abs(angle) * DEGREE, positive)
    used = np.arange(len(angle)) != middle
    spread = np.maximum(sigma[used, None] * MICROMETRE, EXACT)
    sensitivity = (terms - terms[middle])[used] @ root / spread
    whitened = ((error - error[middle]) * MICROMETRE)[used] / spread[:, 0]
    contraction = np.linalg.inv(np.linalg.cholesky(np.eye(len(mean)) + sensitivity.T @ sensitivity))
    return root @ (contraction.T @ (contraction @ (sensitivity.T @ whitened))), root @ contraction.T
