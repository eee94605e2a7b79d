"""Noise that is larger in intervals of time (time windows), such as while a machine runs: a hidden Markov chain.

Each step of the chain is a pointing, or several pointings in a large recording. The two states are quiet and noisy. The
evidence is the sum over all sequences of states, by the forward recursion. The time windows are the noisy intervals of
the most probable sequence (Rabiner 1989, Proceedings of the IEEE 77, 257). Sizes of arrays below: m observation
equations, s sets of observables, f variance factors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Bools, Floats
from ltsim.diagnosis.evidence import (
    index_of_most_evidence,
    log_restricted_likelihood_ratio,
    normalised_probabilities,
)
from ltsim.diagnosis.noise_groups import MIN_READINGS_FOR_HEAVY_TAIL, NOISY_OBSERVABLE_SETS, GroupNoiseHypothesis
from ltsim.physics.laws.places import target_clusters
from ltsim.physics.laws.variance import VarianceFunction
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.regions import candidate_regions

NOISY_WINDOW_VARIANCE_FACTORS = np.geomspace(2.0, 100.0, 7)
"""Factors on the variance in noisy time windows, over which the evidence is averaged."""
NOISY_STATE_VARIANCE_FACTOR_GRID = np.geomspace(1.5, 150.0, 33)
"""Factors on the variance in noisy time windows, in steps of 15 %, over which the posterior mean of the factor is
computed."""
EXPECTED_NOISY_WINDOW_COUNTS = np.array([1.5, 6.0])
"""Expected numbers of noisy time windows in a recording, over which the evidence is averaged."""
MAX_CHAIN_STEP_LOG_LIKELIHOOD_RATIO = float(np.log(np.sqrt(np.finfo(np.float64).max)))
"""Limit, 355, to which the log likelihood ratio of a step of the Markov chain (quiet or noisy in each step of time) is
clipped. The product of two likelihood ratios is then a finite floating-point number."""
MAX_CHAIN_STEPS = 200
"""Largest number of steps of the Markov chain of states in time (quiet or noisy); in a recording with more pointings a
step contains several pointings."""
NOISY_WINDOW_REGION_SHAPES = ("x", "y", "z", "xy")
"""Shapes of the regions of the hall in which noise may be larger for a time, given by the axes along which a region is
bounded."""
NOISY_OBSERVABLE_SET_INDICATORS = np.array(
    [[name in acts for name in OBSERVABLES] for acts in NOISY_OBSERVABLE_SETS], dtype=np.float64
)
"""Flags (s, 3) of the observables in each of s sets of observables that may have larger noise at the same time."""


@dataclass(frozen=True)
class NoiseWindows(GroupNoiseHypothesis):
    """Larger noise in time windows, with a separate size for each observable in each step of a Markov chain.

    The chain is quiet or noisy in each step of time.
    """

    step_edge_times: Floats
    """Start [s] of each step of the Markov chain (quiet or noisy in each step), and end of the last step, (steps +
    1,)."""
    residual_space: ResidualSpace
    """Residual space of the adjustment: whitened observations without the part that the unknowns absorb."""
    n_tried_places: int = 1
    """Number of places (groups of targets, set-ups, regions) from which the place of this noise was selected; 1 for
    noise in the whole network."""

    @classmethod
    def from_residual_space(cls, space: ResidualSpace) -> tuple[NoiseWindows, ...]:
        """Hypothesis of larger noise in time windows; empty for few readings, and for a recording without times."""
        time, (pointing, kind) = space.sightings.time, np.nonzero(space.is_used_reading)
        distinct = np.unique(time)
        if space.n_equations < MIN_READINGS_FOR_HEAVY_TAIL or len(distinct) < 2:
            return ()
        steps = min(len(distinct), MAX_CHAIN_STEPS)
        starts = distinct[np.linspace(0, len(distinct), steps, endpoint=False).round().astype(int)]
        before = distinct[np.searchsorted(distinct, starts[1:]) - 1]
        step_edge_times = np.concatenate([[distinct[0]], 0.5 * (starts[1:] + before), [distinct[-1]]])
        step = np.searchsorted(starts, time[pointing], side="right") - 1
        reading_indices = step * len(OBSERVABLES) + kind
        group_indicators = sp.csr_array(
            (np.ones(len(reading_indices)), (reading_indices, np.arange(len(reading_indices)))),
            (steps * len(OBSERVABLES), space.n_equations),
        )
        return (
            cls(
                VarianceFunction(covariates=("time",), covariate_band=(step_edge_times[0], step_edge_times[-1])),
                group_indicators,
                NOISY_WINDOW_VARIANCE_FACTORS,
                step_edge_times,
                space,
            ),
        )

    @property
    def name(self) -> str:
        """Name of this kind of hypothesis of changed noise."""
        return "unknown:noise:windows"

    def _log_likelihood_ratios(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log likelihood ratios (steps, s, f, trials) of the noisy to the quiet state in each step of time.

        There are s sets of observables and f variance factors. `residual` (m, trials) are m whitened residuals of each
        recording (trial), and `redundancy` (m,) the redundancy numbers.
        """
        shape = len(self.step_edge_times) - 1, len(OBSERVABLES), -1
        squares = NOISY_OBSERVABLE_SET_INDICATORS @ (self.group_indicators @ residual**2).reshape(shape)
        share = NOISY_OBSERVABLE_SET_INDICATORS @ (self.group_indicators @ redundancy).reshape(shape)
        ratios = log_restricted_likelihood_ratio(
            squares[:, :, None], share[:, :, None], self.variance_factor_grid[:, None]
        )
        return np.clip(ratios, -MAX_CHAIN_STEP_LOG_LIKELIHOOD_RATIO, MAX_CHAIN_STEP_LOG_LIKELIHOOD_RATIO)

    @property
    def _state_change_probabilities(self) -> Floats:
        """Probabilities of a change between quiet and noisy in a step of time, one per expected number of windows.

        The expected numbers of noisy windows are `EXPECTED_NOISY_WINDOW_COUNTS`.
        """
        return np.minimum(2.0 * EXPECTED_NOISY_WINDOW_COUNTS / len(self.step_edge_times), 0.5)

    def log_evidence(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log evidence (trials,) for each recording (trial), from m residuals (m, trials) with redundancy numbers (m,).

        The evidence is averaged over sets of observables, variance factors, and expected numbers of time windows.
        """
        gains = np.exp(self._log_likelihood_ratios(residual, redundancy))
        p_change = self._state_change_probabilities[:, None, None, None]
        quiet = noisy = np.full((len(p_change), *gains.shape[1:]), 0.5)
        log_totals = np.zeros(quiet.shape)
        for gain in gains:
            quiet, noisy = quiet + p_change * (noisy - quiet), (noisy + p_change * (quiet - noisy)) * gain
            scale = quiet + noisy
            log_totals += np.log(scale)
            quiet, noisy = quiet / scale, noisy / scale
        flattened = log_totals.reshape(-1, log_totals.shape[-1])
        return log_sum_exp(flattened) - np.log(len(flattened) * self.n_tried_places)

    def _expected_added_variance(self, residual: Floats, redundancy: Floats) -> Floats:
        """Posterior mean (g,) of the added variance of each of g groups of readings, divided by the declared variance.

        It is an average over all sequences of states (quiet and noisy), by forward and backward recursion.
        """
        dense = replace(self, variance_factor_grid=NOISY_STATE_VARIANCE_FACTOR_GRID)
        logs, p_change = (
            dense._log_likelihood_ratios(residual[:, None], redundancy)[..., 0],
            self._state_change_probabilities[:, None, None],
        )
        quiet = noisy = np.full((len(p_change), *logs.shape[1:]), 0.5)
        total, forward_probabilities = np.zeros(quiet.shape), np.empty((len(logs), 2, *quiet.shape))
        for here, gain in zip(forward_probabilities, np.exp(logs), strict=True):
            quiet, noisy = quiet + p_change * (noisy - quiet), (noisy + p_change * (quiet - noisy)) * gain
            total += np.log(quiet + noisy)
            here[:] = np.stack([quiet, noisy]) / (quiet + noisy)
            quiet, noisy = here
        weight = normalised_probabilities(total.ravel()).reshape(total.shape) * (NOISY_STATE_VARIANCE_FACTOR_GRID - 1.0)
        added = np.empty((len(logs), len(OBSERVABLES)))
        quiet = noisy = np.ones(total.shape)
        for step in reversed(range(len(logs))):
            p_noisy = (
                forward_probabilities[step, 1]
                * noisy
                / (forward_probabilities[step, 0] * quiet + forward_probabilities[step, 1] * noisy)
            )
            added[step] = (weight * p_noisy).sum(axis=(0, 2)) @ NOISY_OBSERVABLE_SET_INDICATORS
            noisy = noisy * np.exp(logs[step])
            quiet, noisy = quiet + p_change * (noisy - quiet), noisy + p_change * (quiet - noisy)
            quiet, noisy = quiet / (quiet + noisy), noisy / (quiet + noisy)
        return added.ravel()

    def most_likely_effect(self, residual: Floats, redundancy: Floats) -> VarianceFunction:
        """Effect on the noise with observables and time windows of the most probable sequence of states (noisy, quiet).

        The sequence is computed by Viterbi's algorithm.
        """
        ratios = self._log_likelihood_ratios(residual[:, None], redundancy)[..., 0].reshape(
            len(self.step_edge_times) - 1, -1
        )
        best, states = _most_probable_states(ratios, self._state_change_probabilities[0])
        acts = NOISY_OBSERVABLE_SETS[best // len(self.variance_factor_grid)]
        assert isinstance(self.effect, VarianceFunction)
        return replace(self.effect, observables=acts, covariate_band=self._window_edge_times(states))

    def limited_to_most_probable_place(self, residual: Floats, redundancy: Floats) -> tuple[NoiseWindows, ...]:
        """Time windows of larger noise limited to the group of targets, set-up or region with the largest evidence."""
        s, windows = self.residual_space.sightings, self.most_likely_effect(residual, redundancy)
        places = [
            replace(windows, targets=tuple(s.target_names[t] for t in group)) for group in sorted(target_clusters(s))
        ]
        places += [replace(windows, stations=(name,)) for name in s.station_names if len(s.station_names) > 1]
        places += [
            replace(windows, region=region, covariates=("time", *region.bounded_axes))
            for region in candidate_regions(s, NOISY_WINDOW_REGION_SHAPES)
        ]
        if not places:
            return ()
        place = places[
            index_of_most_evidence(
                np.array([self._log_evidence_of_effect(effect, residual, redundancy) for effect in places])
            )
        ]
        whole = replace(
            place, observables=OBSERVABLES, covariate_band=(self.step_edge_times[0], self.step_edge_times[-1])
        )
        is_noisy = (
            whole.variance(s, self.residual_space.reading_sigmas, np.ones(1)) > self.residual_space.reading_sigmas**2
        )[self.residual_space.is_used_reading]
        noisy_rows = np.pad(is_noisy, (0, len(residual) - len(is_noisy))).astype(np.float64)
        group_indicators = sp.csr_array(self.group_indicators @ sp.diags_array(noisy_rows))
        return (replace(self, effect=whole, group_indicators=group_indicators, n_tried_places=len(places)),)

    def _log_evidence_of_effect(self, effect: VarianceFunction, residual: Floats, redundancy: Floats) -> float:
        """Log evidence of changed noise in given time windows and at a given place, averaged over variance factors."""
        space = self.residual_space
        added = (effect.variance(space.sightings, space.reading_sigmas, np.ones(1)) / space.reading_sigmas**2)[
            space.is_used_reading
        ] - 1.0
        noisy_rows = np.flatnonzero(added)
        factors = 1.0 + (self.variance_factor_grid[:, None] - 1.0) * added[noisy_rows]
        log_likelihood_ratios = log_restricted_likelihood_ratio(
            residual[noisy_rows] ** 2, redundancy[noisy_rows], factors
        ).sum(axis=1)
        return float(log_sum_exp(log_likelihood_ratios) - np.log(len(log_likelihood_ratios)))

    def _window_edge_times(self, states: Bools) -> tuple[float, ...]:
        """Times [s] at which the noise becomes larger and smaller, alternately.

        `states` (steps,) flag the steps of time with larger noise.
        """
        edges = np.flatnonzero(np.diff(np.concatenate([[False], states, [False]]).astype(int)))
        return tuple(self.step_edge_times[edges].tolist())


def _most_probable_states(log_likelihood_ratios: Floats, change_probability: float) -> tuple[int, Bools]:
    """Index of the most probable of c Markov chains, and flags (steps,) of its steps of time with larger noise.

    At least one step is noisy. `log_likelihood_ratios` (steps, c) are the log likelihood ratios of the noisy to the
    quiet state of the readings in c chains. `change_probability` is the probability of a change of state from a step to
    the next.
    """
    score, stays = np.zeros((log_likelihood_ratios.shape[1], 2)), []
    for ratio in log_likelihood_ratios:
        same, changed = score + np.log1p(-change_probability), score[:, ::-1] + np.log(change_probability)
        stays.append(same >= changed)
        score = np.maximum(same, changed)
        score[:, 1] += ratio
    best_index = int(np.argmax(score.max(axis=1)))
    state, states = int(np.argmax(score[best_index])), np.zeros(len(log_likelihood_ratios), dtype=bool)
    for i in reversed(range(len(log_likelihood_ratios))):
        states[i] = bool(state)
        state = state if stays[i][best_index, state] else 1 - state
    if not states.any():
        states[int(np.argmax(log_likelihood_ratios[:, best_index]))] = True
    return best_index, states
