"""Centring errors: an instrument or target was set up over a mark again on another day, but at a displaced point.

All set-ups over a mark, and all targets on it, count as one point of the network. An occupation is a set-up of an
instrument, or of a target, at a mark on one day. Shifts of occupations are added to the model one by one, always the
shift that reduces chi-square most, as long as the reduction is significant. Readings to noisy targets are weighted by
their estimated noise.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.blunders import IdentifiedBlunder
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import GLOBAL_TEST_LEVEL, SINGLE_TEST_LEVEL
from ltsim.core.arrays import Floats
from ltsim.core.notation import with_sigma
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.occupations import days_of_pointings
from ltsim.recordings.recording import Recording
from ltsim.solve.gauss_newton import solve

MAX_CENTRING_ERRORS = 6
"""Largest number of centring errors that are estimated in one network; a network with more must be measured again."""
CENTRING_EFFECT_NAME = "target-moved"
"""Name of a centring error in the list of physical effects: the equipment on a mark was displaced."""


@dataclass(frozen=True)
class MarkOccupation:
    """Occupation of a mark: an instrument or target that was set up over the mark on one day."""

    mark: str
    """Name of the mark."""
    role: str
    """Equipment on the mark: `instrument` or `target`."""
    day: str
    """Day on which the equipment stood over the mark, as text."""
    shift_signs: Floats
    """Signs (n,) with which a shift of the equipment acts on n pointings: +1 for pointings to the target, -1 for
    pointings from the instrument, 0 for pointings that do not involve this equipment on this day."""


@dataclass(frozen=True)
class CentringErrorEstimates:
    """Estimated centring errors of k occupations (set-ups over marks), and chi-square with and without these errors."""

    adjustment_without_centring: Adjustment
    """Adjustment without centring errors in the model."""
    occupations: tuple[MarkOccupation, ...]
    """The k occupations (equipment over a mark on one day) with a centring error."""
    shifts: Floats
    """Centring errors of the k occupations [m], (k, 3); horizontal components only, (k, 2), if the model contains
    errors of instrument heights."""
    shift_covariances: Floats
    """Covariance of the components of each of the k `shifts` [m^2], (k, 3, 3), or (k, 2, 2) for horizontal ones."""
    chi2_with_centring: float
    """Chi-square of the adjustment with the centring errors."""
    dof_with_centring: int
    """Degrees of freedom of the adjustment with the centring errors."""
    noisy_targets: tuple[str, ...]
    """Names of the targets whose readings are weighted by their estimated noise."""

    @property
    def shift_lengths_and_sigmas(self) -> list[tuple[float, float]]:
        """Length of each of the k `shifts` and its standard deviation, both in metres."""
        lengths = np.linalg.norm(self.shifts, axis=1)
        sigma = np.sqrt(np.einsum("ki,kij,kj->k", self.shifts, self.shift_covariances, self.shifts)) / lengths
        return list(zip(lengths.tolist(), sigma.tolist(), strict=True))

    @property
    def descriptions(self) -> list[str]:
        """Texts, one for each centring error, with its mark, equipment, day, size and components."""
        names = []
        for occupation, value, (size, sigma) in zip(
            self.occupations, self.shifts, self.shift_lengths_and_sigmas, strict=True
        ):
            parts = ", ".join(f"{axis} {v / MILLIMETRE:+.1f}" for axis, v in zip("xyz", value, strict=False))
            size_text = with_sigma(size / MILLIMETRE, sigma / MILLIMETRE, "mm")
            names.append(f"{occupation.mark} as {occupation.role} on {occupation.day} by {size_text} ({parts})")
        return names

    @property
    def sentence(self) -> str:
        """Sentence for the user on all centring errors and the resulting decrease of chi-square."""
        weighting_text = (
            f" (readings to {', '.join(self.noisy_targets)} weighted by their observed noise)"
            if self.noisy_targets
            else ""
        )
        before, after = (
            f"{self.adjustment_without_centring.chi2:.1f}/{self.adjustment_without_centring.dof}",
            f"{self.chi2_with_centring:.1f}/{self.dof_with_centring}",
        )
        return (
            f"centring errors (tripod not re-occupied at the same point): {'; '.join(self.descriptions)}; "
            f"with these errors in the model chi2/dof falls from {before} to {after}{weighting_text}"
        )


def repeated_occupations(recording: Recording, station_mark_names: tuple[str, ...]) -> list[MarkOccupation]:
    """Occupations (set-ups of an instrument or target over a mark on one day) of all marks occupied on several days.

    `station_mark_names` (S,) are the names of the marks under the S stations, '' for a station without a mark.
    """
    days = np.array(days_of_pointings(recording))
    if len(set(days.tolist())) < 2:
        return []
    all_occupations = []
    from_mark, to_mark = np.array(station_mark_names)[recording.station], np.array(recording.targets)[recording.target]
    for mark in dict.fromkeys(name for name in station_mark_names if name):
        roles = (("instrument", from_mark == mark, -1.0), ("target", to_mark == mark, 1.0))
        mark_occupations = [
            MarkOccupation(mark, role, day, sign * (rows & (days == day)))
            for role, rows, sign in roles
            for day in dict.fromkeys(days[rows].tolist())
        ]
        if len({occupation.day for occupation in mark_occupations}) > 1:
            all_occupations += mark_occupations
    return all_occupations


def estimate_centring_errors(adjustment: Adjustment) -> CentringErrorEstimates | None:
    """Estimated centring errors over marks; None if none is significant, or if the global test passes without them."""
    if not adjustment.solution.has_converged or adjustment.dof < 1 or adjustment.p_value > GLOBAL_TEST_LEVEL:
        return None
    candidates = repeated_occupations(adjustment.recording, adjustment.problem.marks.mark_names)
    if not candidates:
        return None
    noisy = tuple(adjustment.recording.targets[t] for t in adjustment.noisy_targets_and_scatter[0])
    adjustment = _with_noise_by_target(adjustment)
    chi2, dof = adjustment.chi2, adjustment.dof
    space = whole = ResidualSpace.from_adjustment(adjustment)
    model = adjustment.problem.model
    axes = 2 if model.height_errors else 3  # with estimated instrument heights, heights show no centring error
    height_sigma = max((heads.height_sigma for heads in model.height_errors), default=0.0)
    axis_derivatives = model.linearise(adjustment.state).target_derivatives[:, :, :axes]
    shifts = {
        i: whole.whiten(axis_derivatives * occupation.shift_signs[:, None, None])
        for i, occupation in enumerate(candidates)
    }
    occupations: list[int] = []
    while len(occupations) < min(MAX_CENTRING_ERRORS, len(candidates)):
        chi2_drops = {i: space.chi2_drop(shift) for i, shift in shifts.items() if i not in occupations}
        best = max(chi2_drops, key=lambda i: chi2_drops[i])
        drop, rank = chi2_drops[best]
        ratio = (drop / max(rank, 1)) / max((chi2 - drop) / max(dof - rank, 1), 1e-30)
        if (
            rank < axes
            or dof <= rank
            or not special.fdtrc(rank, dof - rank, ratio) * len(candidates) < SINGLE_TEST_LEVEL
        ):
            break
        if np.linalg.norm(np.linalg.lstsq(space.project(shifts[best]), space.whitened_residuals)[0]) < height_sigma:
            break
        space, chi2, dof = space.with_design_columns(shifts[best]), chi2 - drop, dof - rank
        occupations.append(best)
    if not occupations:
        return None
    columns = whole.project(np.hstack([shifts[i] for i in occupations]))
    cofactor = np.linalg.pinv(columns.T @ columns)
    displacements = (cofactor @ (columns.T @ whole.whitened_residuals)).reshape(-1, axes)
    occupation_indices = range(len(occupations))
    spread = (
        cofactor.reshape(len(occupation_indices), axes, len(occupation_indices), axes)[
            occupation_indices, :, occupation_indices
        ]
        * chi2
        / dof
    )
    return CentringErrorEstimates(
        adjustment, tuple(candidates[i] for i in occupations), displacements, spread, chi2, dof, noisy
    )


def correct_centring(adjustment: Adjustment) -> tuple[Recording, list[IdentifiedBlunder]]:
    """Recording with readings corrected for estimated centring errors, and one blunder for each centring error."""
    centring_errors, recording = estimate_centring_errors(adjustment), adjustment.recording
    if centring_errors is None:
        return recording, []
    by_target, readings, findings = (
        adjustment.problem.model.linearise(adjustment.state).target_derivatives,
        recording.readings,
        [],
    )
    for occupation, value, (size, sigma), named in zip(
        centring_errors.occupations,
        centring_errors.shifts,
        centring_errors.shift_lengths_and_sigmas,
        centring_errors.descriptions,
        strict=True,
    ):
        readings = readings - occupation.shift_signs[:, None] * (by_target[:, :, : len(value)] @ value)
        sentence = f"Centring error (tripod not re-occupied at the same point): {named}."
        findings.append(
            IdentifiedBlunder(
                CENTRING_EFFECT_NAME,
                np.flatnonzero(occupation.shift_signs),
                (),
                (occupation.mark,),
                (),
                size,
                sentence,
                sigma,
            )
        )
    return recording.with_readings(readings), findings


def _with_noise_by_target(adjustment: Adjustment) -> Adjustment:
    """New adjustment in which the readings to noisy targets are weighted by their observed noise."""
    named, noisy_scatter, rest = adjustment.noisy_targets_and_scatter
    if not len(named):
        return adjustment
    factors = np.where(np.isin(adjustment.recording.target, named), noisy_scatter / rest, 1.0)
    problem = replace(adjustment.problem, reading_sigmas=adjustment.problem.reading_sigmas * factors[:, None])
    return replace(adjustment, problem=problem, solution=solve(problem, adjustment.state))
