"""What a layout would tell, without any data: standard deviations, undetermined combinations, redundancy.

The calibrator's own problem is linearised at the nominal state, a perfect instrument at the planned places; a
covariance does not depend on readings.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.arrays import Floats
from ltsim.errors import NetworkError
from ltsim.geometry.rigid import rigid_motion
from ltsim.model.construction import Construction, misalignment
from ltsim.planning.schema import PlannedParameterEntry
from ltsim.planning.survey import Survey
from ltsim.remedies.undetermined import Direction, determining, undetermined
from ltsim.solve.design import as_dense


@dataclass(frozen=True)
class LayoutInformation:
    """Information of a survey that has not been made."""

    survey: Survey
    adjustment: Adjustment
    """At the nominal state; everything that an adjustment knows of precision holds here too."""

    @classmethod
    def of(cls, survey: Survey, construction: Construction | None = None) -> LayoutInformation:
        """The information of a survey, by default for the 16 misalignment parameters; NetworkError for an open one."""
        built = construction or misalignment()
        unseen = np.flatnonzero(~survey.seen.any(axis=0))
        if len(unseen):
            raise NetworkError(f"target {survey.target_names[unseen[0]]} is seen from no station")
        adjustment = Adjustment.planned(survey.recording(built), survey.state(built), built)
        if adjustment.lost_targets:
            raise NetworkError(f"the ranges from its stations do not place target {adjustment.lost_targets[0]}")
        return cls(survey, adjustment)

    @property
    def construction(self) -> Construction:
        """The construction whose parameters are meant."""
        return self.adjustment.construction

    @property
    def prior_sigma(self) -> Floats:
        """(p,) of the first instrument [SI]."""
        return self.adjustment.problem.prior.sigma[0]

    @property
    def instrument_covariance(self) -> Floats:
        """(p, p) [SI], priors included."""
        return self.adjustment.instrument_covariance

    @property
    def scaled_covariance(self) -> Floats:
        """(p, p) in units of the prior sigmas: the identity before any reading."""
        return self.instrument_covariance / np.outer(self.prior_sigma, self.prior_sigma)

    @cached_property
    def instrument_sigma(self) -> Floats:
        """(p,) standard deviation of each instrument parameter [SI]."""
        return np.sqrt(np.diag(self.instrument_covariance))

    @cached_property
    def undetermined(self) -> list[Direction]:
        """Combinations with a gain under one half, the least known first."""
        return undetermined(self.instrument_covariance, self.prior_sigma)

    def cures(self) -> list[str]:
        """A sentence for each undetermined combination: what would determine it."""
        return determining(self.adjustment, self.construction, [self.undetermined])[0]

    @cached_property
    def _inner(self) -> Adjustment:
        """The adjustment with inner constraints over all targets."""
        return self.adjustment.in_inner_datum()

    @property
    def pose_covariance(self) -> Floats:
        """(S, 6, 6): translation [m] and rotation [rad] of each station, datum the mean of all targets."""
        return self._inner.pose_covariance

    @property
    def target_covariance(self) -> Floats:
        """(T, 3, 3) [m^2] of each target, datum the mean of all targets (inner constraints); with the survey's air."""
        return self._inner.target_covariance + self._by_air

    @cached_property
    def _by_air(self) -> Floats | float:
        """(T, 3, 3) [m^2] that the air adds: errors that the adjustment neither knows nor estimates, carried on.

        Targets move by the gain on the whitened readings, less the rigid motion of all of them.
        """
        air, adjustment, problem = self.survey.air, self.adjustment, self.adjustment.problem
        if air is None:
            return 0.0
        used = np.flatnonzero(problem.use.ravel())
        errors, variance = air.errors(adjustment.sightings), air.variance(adjustment.sightings)
        sigma, carry = problem.sigma.ravel()[used], as_dense(adjustment.solution.system.design[: len(used)]).T
        common = errors.reshape(-1, errors.shape[2])[used] / sigma[:, None]
        inside = np.hstack([carry @ common, carry * (np.sqrt(variance.ravel()[used]) / sigma)])
        moved = adjustment.factor.covariance_columns(inside)[problem.unknowns.target].reshape(-1, inside.shape[1])
        motion = rigid_motion(self.survey.points) @ problem.free
        moved -= motion @ (np.linalg.pinv(motion) @ moved)
        errors_of = moved.reshape(-1, 3, inside.shape[1])
        return np.asarray(errors_of @ np.swapaxes(errors_of, 1, 2))

    @cached_property
    def target_sigma(self) -> Floats:
        """(T,) [m]: root of the trace of each target's covariance, its point error."""
        return np.sqrt(np.einsum("tii->t", self.target_covariance))

    @property
    def target_rms(self) -> float:
        """[m] root mean square point error over all targets, weighted as the survey says."""
        return float(np.sqrt(np.mean(self.survey.weight * self.target_sigma**2)))

    def parameters(self) -> list[PlannedParameterEntry]:
        """One row a parameter, in the unit a person reads it in."""
        return [
            PlannedParameterEntry(
                name=p.name,
                unit=p.unit,
                sigma=float(sigma / p.factor),
                prior_sigma=float(prior / p.factor),
                gain=float(1.0 - (sigma / prior) ** 2),
            )
            for p, sigma, prior in zip(
                self.construction.parameters, self.instrument_sigma, self.prior_sigma, strict=True
            )
        ]
