"""Stations that move while they measure: motions in place of outliers.

A sinking or touched tripod affects all its readings, so that a test of single readings rejects many of them. In that
case a uniform and a sudden motion of the station are tried in their place, and accepted if their penalised chi-square
is smaller.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reliability import FAMILY_LEVEL, critical_w
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.snooping import drop_undetermined, snoop_readings
from ltsim.core.arrays import Floats
from ltsim.core.notation import with_sigma
from ltsim.core.units import MICROMETRE, MICRORADIAN
from ltsim.physics.effects.effect import Stage
from ltsim.physics.effects.motions import StationMotion
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.model.measurement import State
from ltsim.scene.sightings import Sightings
from ltsim.solve.gauss_newton import Solution, solve

WITNESSES = 3
"""Smallest number of targets that must support a motion of the station; with fewer the targets may have moved."""


@dataclass(frozen=True)
class EvenMotion(StationMotion):
    """Uniform motion of a station during its visit, parametrised by the final displacement.

    It is no effect of the catalogue, because many causes produce it.

    Consecutive pointings to one target count at one time: changes during them may be motions of the target, and only
    later repeats show the station's motion.
    """

    name = "station-motion"
    stage = Stage.STATION
    covariates = ("time",)
    scope = "station"
    parameters = StationBump.parameters

    def motion(self, sightings: Sightings) -> Floats:
        """Fraction of the complete motion at each pointing, for each component."""
        longest = np.full(len(sightings.station_names), 1e-9)
        np.maximum.at(longest, sightings.station, sightings.station_time)
        share = by_runs(sightings).station_time / longest[sightings.station]
        return (self.mask(sightings) * share)[:, None, None] * np.eye(6)


@dataclass(frozen=True)
class SuddenMotion(StationBump):
    """Sudden motion of a station in one gap between its pointings, of any cause."""

    name = EvenMotion.name


Motion = EvenMotion | SuddenMotion


def by_runs(sightings: Sightings) -> Sightings:
    """Sightings in which consecutive pointings to one target have equal times."""
    _, run = np.unique(np.stack([sightings.station, sightings.seating]), axis=1, return_inverse=True)
    return replace(sightings, time=(np.bincount(run, sightings.time) / np.bincount(run))[run])


def moving_stations(adjustment: Adjustment) -> tuple[Motion, ...]:
    """Stations with a motion that makes most poorly fitting readings fit, with a smaller penalised chi-square.

    The penalty of a motion is the limit of its test, and so is that of an outlier (as in `reference_tests`).
    """
    recording, problem, motions = adjustment.recording, adjustment.problem, list[Motion]()
    blamed = adjustment.rejected.any() or adjustment.outliers(estimated=True)
    if not (adjustment.solution.converged and blamed):
        return ()
    placed = ~problem.structure.unseen[recording.target]
    problem = replace(problem, use=recording.usable & placed[:, None])
    each = critical_w(int(problem.use.sum())) ** 2
    accepted, ended = snoop_readings(problem, adjustment.state)
    for station in _suspects(problem, accepted):
        best: tuple[float, Motion | None, NetworkProblem, NetworkProblem, Solution[State]]
        best = 0.0, None, problem, accepted, ended
        for motion, looks in _motions_of(replace(adjustment, problem=problem), ended.x, station):
            tried, start = _with_motion(problem, ended.x, motion)
            with_motion, solution = snoop_readings(tried, start)
            gain = (ended.cost - solution.cost) / max(1.0, solution.cost / max(with_motion.dof, 1))
            gain += each * (int(with_motion.use.sum()) - int(accepted.use.sum()))
            gain -= float(special.chdtri(len(motion.parameters), FAMILY_LEVEL / (looks * len(recording.stations))))
            if gain > best[0] and station not in _suspects(tried, with_motion):
                best = gain, motion, tried, with_motion, solution
        _, chosen, problem, accepted, ended = best
        motions += [chosen] if chosen else []
    return tuple(motions)


def _motions_of(adjustment: Adjustment, state: State, station: int) -> Iterator[tuple[Motion, int]]:
    """Uniform motion of a station, and the most significant sudden one, each with the number of tests."""
    name = adjustment.recording.stations[station]
    yield EvenMotion((name,)), 1
    use = adjustment.problem.use & ~(adjustment.gross & (adjustment.recording.station != station))[:, None]
    problem = drop_undetermined(replace(adjustment.problem, use=use), state)
    plain = replace(adjustment, problem=problem, solution=solve(problem, state))
    gaps = [motion for motion in SuddenMotion.candidates(plain.sightings) if motion.stations == (name,)]
    if gaps and plain.solution.converged:
        space = ResidualSpace.of(plain)
        falls = [space.chi2_drop(space.signature(motion))[0] for motion in gaps]
        yield gaps[int(np.argmax(falls))], len(gaps)


def motion_sentences(adjustment: Adjustment) -> Iterator[tuple[Motion, str]]:
    """Motions of stations in an adjustment that no identified cause explains, and a sentence on each."""
    first = 0
    for effect in adjustment.effects:
        columns = slice(first, first := first + len(effect.parameters))
        if isinstance(effect, Motion):
            values, spread = adjustment.state.extra[columns], adjustment.extra_covariance[columns, columns]
            sizes = (("um", MICROMETRE, slice(0, 3)), ("urad", MICRORADIAN, slice(3, 6)))
            parts = " and ".join(
                _length(values[at] / factor, spread[at, at] / factor**2, unit) for unit, factor, at in sizes
            )
            moved = f"moves during its measurement, by {parts} in total"
            if isinstance(effect, SuddenMotion):
                sightings = adjustment.sightings
                order = sightings.order[effect.mask(sightings)[sightings.order] > 0]
                at = int(np.searchsorted(sightings.time[order], effect.time))
                moved = f"moved between rows {order[at - 1] + 1} and {order[at] + 1}, by {parts}"
            yield (
                effect,
                f"station {', '.join(effect.stations)} {moved}: the motion is estimated, and its pointings stay in use",
            )


def _length(vector: Floats, covariance: Floats, unit: str) -> str:
    """Text of the length of a vector (3,) with its standard deviation."""
    length = float(np.linalg.norm(vector))
    return with_sigma(length, float(np.sqrt(vector @ covariance @ vector)) / max(length, 1e-30), unit)


def _suspects(problem: NetworkProblem, accepted: NetworkProblem) -> list[int]:
    """Stations with poorly fitting readings to several targets, those with most readings first."""
    recording, out = problem.model.recording, problem.use & ~accepted.use
    rows = out.any(axis=1)
    pairs = np.unique(np.stack([recording.station[rows], recording.target[rows]]), axis=1)
    targets = np.bincount(pairs[0], minlength=len(recording.stations))
    return sorted(np.flatnonzero(targets >= WITNESSES).tolist(), key=lambda s: -targets[s])


def _with_motion(problem: NetworkProblem, state: State, motion: Motion) -> tuple[NetworkProblem, State]:
    """Problem with an additional effect, and its state."""
    effects = problem.model.effects
    model = replace(problem.model, effects=(*effects, motion))
    before = sum(len(effect.parameters) for effect in effects)
    extra = np.insert(state.extra, before, np.zeros(len(motion.parameters)))
    wider = NetworkProblem.of(model, sigma=problem.sigma, use=problem.use, prior=problem.prior)
    return wider, replace(state, extra=extra)
