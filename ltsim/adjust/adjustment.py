"""Network adjustment of a recording: the call, and everything that is known afterwards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import stats

from ltsim.adjust.inner import InnerDatum, moved_to_datum, stated_datum
from ltsim.adjust.problem import NetworkProblem
from ltsim.adjust.screening import screened
from ltsim.adjust.start import start_network
from ltsim.arrays import Bools, Floats, Ints
from ltsim.effects.effect import Effect
from ltsim.model.construction import Construction, ideal
from ltsim.model.measurement import MeasurementModel, State
from ltsim.recording.recording import OBSERVABLES, Recording
from ltsim.scene.sightings import Sightings
from ltsim.solve.blocks import Factor
from ltsim.solve.gauss_newton import Solution, solve

FAMILY_LEVEL = 0.01
"""Chance that a clean recording shows any outlier at all (Sidak over all readings)."""
TURNED = 1e-7
"""[rad] A network turned by more is linearised anew."""


@dataclass(frozen=True)
class Outlier:
    """One reading that does not belong, by the w-test (Baarda 1968)."""

    row: int
    observable: int
    size: float
    w: float


@dataclass(frozen=True)
class Adjustment:
    """An adjusted network.

    Attributes
    ----------
    problem : NetworkProblem
    solution : Solution
    gross : (n,) bool
        Pointings that were left out because they miss their target by far.
    datum : InnerDatum, optional
        Datum of the covariances where it is not that of the factor (the pose of the first station).
    """

    problem: NetworkProblem
    solution: Solution[State]
    gross: Bools
    datum: InnerDatum | None = None

    @property
    def recording(self) -> Recording:
        """The recording that was adjusted."""
        return self.problem.model.recording

    @property
    def construction(self) -> Construction:
        """The construction whose parameters were estimated."""
        return self.problem.model.construction

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The further effects that were estimated."""
        return self.problem.model.effects

    @property
    def state(self) -> State:
        """Adjusted poses, targets and parameters."""
        return self.solution.x

    @property
    def chi2(self) -> float:
        """Weighted sum of squares of readings, known lengths and priors."""
        return self.solution.cost

    @property
    def dof(self) -> int:
        """Degrees of freedom."""
        return self.problem.dof

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight; NaN without redundancy."""
        return float(np.sqrt(self.chi2 / self.dof)) if self.dof > 0 else float("nan")

    @property
    def p_value(self) -> float:
        """Chance of a larger chi2 if model and stated noise hold."""
        return float(stats.chi2.sf(self.chi2, self.dof)) if self.dof > 0 else float("nan")

    @property
    def factor(self) -> Factor:
        """Factorised normal equations at the optimum."""
        self.solution.require_success()
        assert self.solution.factor is not None
        return self.solution.factor

    @cached_property
    def sightings(self) -> Sightings:
        """Geometry of the pointings at the adjusted network."""
        return self.problem.model.sightings(self.state)

    @cached_property
    def residuals(self) -> Floats:
        """Observed minus adjusted readings (n, 3) [m, rad, rad]; NaN where not measured."""
        return self.problem.residuals(self.problem.model.predict(self.state))

    @cached_property
    def redundancy(self) -> Floats:
        """Redundancy numbers (n, 3): share of an error of a reading that shows in its residual; NaN where unused."""
        share = np.full(self.residuals.shape, np.nan)
        used = self.problem.use
        share[used] = 1.0 - self.factor.leverage()[: int(used.sum())]
        return share

    @cached_property
    def w(self) -> Floats:
        """Normalised residuals (n, 3), standard normal where the model holds (Baarda 1968)."""
        spread = self.problem.sigma * np.sqrt(np.maximum(self.redundancy, 1e-12))
        w: Floats = np.where(self.redundancy > 1e-9, self.residuals / spread, 0.0)
        return np.where(self.problem.use, w, np.nan)

    def outliers(self, level: float = FAMILY_LEVEL) -> list[Outlier]:
        """Readings whose |w| is too large for chance over the whole recording, largest first."""
        count = int(self.problem.use.sum())
        limit = stats.norm.isf(0.5 * (1.0 - (1.0 - level) ** (1.0 / max(count, 1))))
        rows, columns = np.nonzero(np.nan_to_num(np.abs(self.w)) > limit)
        found = [
            Outlier(
                int(i),
                int(j),
                float(self.residuals[i, j] / self.redundancy[i, j]),
                float(self.w[i, j]),
            )
            for i, j in zip(rows, columns, strict=True)
        ]
        return sorted(found, key=lambda outlier: -abs(outlier.w))

    def covariance_of(self, columns: Ints) -> Floats:
        """Covariance (c, k, k) of sets (c, k) of unknowns other than eliminated targets (columns of the layout)."""
        covariance = self.factor.kept_sets(columns)
        return covariance if self.datum is None else self.datum.transformed(covariance, columns)

    @cached_property
    def kept_covariance(self) -> Floats:
        """Covariance (K, K) of poses, kept targets, instrument parameters and further effects."""
        covariance = self.factor.kept_covariance()
        if self.datum is None:
            return covariance
        return self.datum.transformed(covariance[None], np.arange(len(covariance))[None])[0]

    @property
    def instrument_covariance(self) -> Floats:
        """Covariance (p, p) of the first instrument's parameters [SI]."""
        return self.instrument_covariance_of(0)

    def instrument_covariance_of(self, instrument: int) -> Floats:
        """Covariance (p, p) of one instrument's parameters [SI]."""
        covariance: Floats = self.covariance_of(self.problem.layout.instrument[[instrument]])[0]
        return covariance

    @property
    def extra_covariance(self) -> Floats:
        """Covariance (q, q) of the further effects' parameters [SI]."""
        covariance: Floats = self.covariance_of(self.problem.layout.extra[None])[0]
        return covariance

    @property
    def pose_covariance(self) -> Floats:
        """Covariance (S, 6, 6) of each station's translation [m] and rotation [rad], network frame."""
        return self.covariance_of(self.problem.layout.pose)

    @cached_property
    def target_covariance(self) -> Floats:
        """Covariance (T, 3, 3) [m^2] of each target; NaN where none of its readings was used."""
        layout = self.problem.layout
        covariance = np.empty((len(layout.target), 3, 3))
        kept = layout.target[:, 0] < layout.kept
        covariance[kept] = self.factor.kept_sets(layout.target[kept])
        blocks = self.factor.block_covariance()
        covariance[~kept] = blocks[(layout.target[~kept][:, 0] - layout.kept) // 3]
        if self.datum is not None:
            covariance = self.datum.transformed(covariance, layout.target)
        covariance[self.problem.unseen_targets] = np.nan
        return covariance


def adjust(
    recording: Recording,
    construction: Construction | None = None,
    *,
    effects: Sequence[Effect] = (),
    sigma: Floats | None = None,
    use: Bools | None = None,
    start: State | None = None,
    datum: Sequence[str] | None = None,
) -> Adjustment:
    """Adjust a network: targets, poses, and the parameters of `construction` and `effects`.

    Parameters
    ----------
    recording : Recording
    construction : Construction, optional
        Default: an ideal tracker without parameters.
    effects : sequence of Effect
        Further effects to estimate, without priors.
    sigma : (n, 3) float, optional, [m, rad, rad]
        Standard deviations of the readings; default the stated noise.
    use : (n, 3) bool, optional
        Readings to use; default all.
    start : State, optional
        Where to start; default from the recording alone. With a start no pointing is screened out.
    datum : sequence of str, optional
        Targets that define the datum by inner constraints; default those that the set-up chose.

    Returns
    -------
    Adjustment
        In the frame of the first station unless control points, levels or a datum define another. Its solution
        carries a status; an adjustment that did not converge is returned, not raised.

    Raises
    ------
    NetworkError
        When the readings do not tie a station or a target to the rest.
    ModelError
        When `datum` names a target that does not exist, or too few.
    """
    built = construction or ideal()
    model = MeasurementModel(recording, built, tuple(effects))
    gross = np.zeros(len(recording), dtype=bool)
    if start is None:
        (position, rotation, points), gross = screened(recording, *start_network(recording))
        parameters = np.zeros((len(recording.instruments), built.size))
        start = State(position, rotation, points, parameters, np.zeros(model.extra_size))
    elif len(start.extra) != model.extra_size:
        start = State(start.position, start.rotation, start.points, start.instrument, np.zeros(model.extra_size))
    keep = np.broadcast_to(~gross[:, None], recording.readings.shape)
    chosen = keep if use is None else keep & use
    problem = NetworkProblem.of(model, sigma=sigma, use=chosen)
    solution = solve(problem, start)
    names = stated_datum(problem) if datum is None else tuple(datum)
    if not names or solution.factor is None or not problem.free.shape[1]:
        return Adjustment(problem, solution, gross)
    return _in_datum(Adjustment(problem, solution, gross), names)


def _in_datum(adjustment: Adjustment, names: Sequence[str]) -> Adjustment:
    """The adjustment with state and covariances in the datum of these targets."""
    problem, solution = adjustment.problem, adjustment.solution
    state, turned = moved_to_datum(problem, solution.x, names)
    solution = replace(solution, x=state)
    if turned > TURNED:  # The factor belongs to the frame it was computed in.
        again = solve(problem, state)
        solution = replace(again, iterations=solution.iterations, status=solution.status)
    if solution.factor is None:
        return replace(adjustment, solution=solution)
    return replace(adjustment, solution=solution, datum=InnerDatum.of(problem, state, solution.factor, names))


def observable_name(column: int) -> str:
    """Name of a column of the readings."""
    return OBSERVABLES[column]
