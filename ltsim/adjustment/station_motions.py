"""Stations that move while they measure: what a motion explains, no pointing is blamed for.

A tripod that sinks, or that somebody touched, bends all that is measured from it, and a test of single readings then
names many of them. Where it does so, a motion of their station is tried in their place, an even one and one at once; it
is believed where it costs less.
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
"""Targets that a motion of the station needs: what fewer show may be their own."""


@dataclass(frozen=True)
class EvenMotion(StationMotion):
    """An even motion of a station during its visit, by its end; no cause of the catalogue, for many make it.

    A target that is watched without a break counts at one time: what changes meanwhile may be the target's own, and
    only who comes back to it learns of the station.
    """

    name = "station-motion"
    stage = Stage.STATION
    covariates = ("time",)
    scope = "station"
    parameters = StationBump.parameters

    def motion(self, sightings: Sightings) -> Floats:
        """Share of the whole motion at each pointing, for each component."""
        longest = np.full(len(sightings.station_names), 1e-9)
        np.maximum.at(longest, sightings.station, sightings.station_time)
        share = by_runs(sightings).station_time / longest[sightings.station]
        return (self.mask(sightings) * share)[:, None, None] * np.eye(6)


@dataclass(frozen=True)
class SuddenMotion(StationBump):
    """A motion of a station at once, in one gap between its pointings, whoever made it."""

    name = EvenMotion.name


Motion = EvenMotion | SuddenMotion


def by_runs(sightings: Sightings) -> Sightings:
    """The sightings, those of a target that is watched without a break at one time."""
    _, run = np.unique(np.stack([sightings.station, sightings.seating]), axis=1, return_inverse=True)
    return replace(sightings, time=(np.bincount(run, sightings.time) / np.bincount(run))[run])


def moving_stations(adjustment: Adjustment) -> tuple[Motion, ...]:
    """The stations whose motion makes all but a few readings fit that do not fit otherwise, and costs less.

    Its price is that of its test, and that of a reading which does not belong the same (as in `reference_tests`).
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
    """An even motion of a station, and that at once which explains most of all its readings; each with its looks."""
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
    """Each motion of a station among an adjustment's effects that no cause has, and a sentence on it."""
    first = 0
    for effect in adjustment.effects:
        columns = slice(first, first := first + len(effect.parameters))
        if isinstance(effect, Motion):
            values, spread = adjustment.state.extra[columns], adjustment.extra_covariance[columns, columns]
            sizes = (("um", MICROMETRE, slice(0, 3)), ("urad", MICRORADIAN, slice(3, 6)))
            parts = " and ".join(
                _length(values[at] / factor, spread[at, at] / factor**2, unit) for unit, factor, at in sizes
            )
            moved = f"moves while it measures, by {parts} in all"
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
    """The length of a vector (3,) with its standard deviation, in words."""
    length = float(np.linalg.norm(vector))
    return with_sigma(length, float(np.sqrt(vector @ covariance @ vector)) / max(length, 1e-30), unit)


def _suspects(problem: NetworkProblem, accepted: NetworkProblem) -> list[int]:
    """Stations of which readings to several targets do not fit, that of most readings first."""
    recording, out = problem.model.recording, problem.use & ~accepted.use
    rows = out.any(axis=1)
    pairs = np.unique(np.stack([recording.station[rows], recording.target[rows]]), axis=1)
    targets = np.bincount(pairs[0], minlength=len(recording.stations))
    return sorted(np.flatnonzero(targets >= WITNESSES).tolist(), key=lambda s: -targets[s])


def _with_motion(problem: NetworkProblem, state: State, motion: Motion) -> tuple[NetworkProblem, State]:
    """The problem with a further effect, and a state of it."""
    effects = problem.model.effects
    model = replace(problem.model, effects=(*effects, motion))
    before = sum(len(effect.parameters) for effect in effects)
    extra = np.insert(state.extra, before, np.zeros(len(motion.parameters)))
    wider = NetworkProblem.of(model, sigma=problem.sigma, use=problem.use, prior=problem.prior)
    return wider, replace(state, extra=extra)
