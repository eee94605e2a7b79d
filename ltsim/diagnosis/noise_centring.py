"""Centring errors of all targets as noise hypotheses, in recordings that distinguish occupations of a target.

An occupation of a target is one placement of the reflector on it. Occupations are declared in a column of the
recording, or they are the days. They are the set-ups if pointings repeat in one face: an error that these repeats share
is then a displacement for each set-up.

The log evidence of centring errors is the restricted likelihood ratio of the variance component of the displacements
(`adjustment.identification.centring_errors`), with the Occam factor of its uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment.identification.centring_errors import best_centring_sigma
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import MIN_MEAN_REPEATS
from ltsim.core.arrays import Ints
from ltsim.core.units import MILLIMETRE
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.physics.laws.variance import CentringVariance
from ltsim.recordings.centring_errors import CentringUncertainty, OccupationGrouping
from ltsim.recordings.occupations import days_of_pointings, target_occupations
from ltsim.recordings.recording import Recording

MAX_CENTRING_OCCUPATIONS = 200
"""Largest number of occupations (placements of a reflector) in a recording for which centring errors are a hypothesis,
to limit the computing time. 200 occupations have 600 columns in the design matrix."""


def log_evidence_and_centring_hypotheses(space: ResidualSpace) -> list[tuple[float, NoiseHypothesis]]:
    """Log evidence, without prior, and hypothesis of centring errors: a pair for each kind of occupation.

    An occupation is one placement of a reflector on its target: by set-up, by a column of the recording, or by day.
    `space` is the residual space of the adjustment (whitened observations without the part that the unknowns absorb).
    """
    recording, used = space.adjustment.recording, np.asarray(space.is_used_reading.any(axis=1))
    hypotheses = []
    for kind in _distinguished_occupation_kinds(recording):
        effect = CentringVariance(occupation_grouping=kind)
        occupation = np.where(used, target_occupations(recording, effect.as_declared_uncertainty(MILLIMETRE)), -1)
        if _determines_centring(recording, occupation, requires_repeats_in_face=kind == "station"):
            estimate = best_centring_sigma(space, occupation)
            hypotheses.append(
                (estimate.log_evidence_gain, NoiseHypothesis("unknown:noise:centring", effect, (estimate.sigma,)))
            )
    return hypotheses


def with_estimated_centring(space: ResidualSpace, hypothesis: NoiseHypothesis) -> NoiseHypothesis:
    """Hypothesis of centring errors with the estimated standard deviation of the displacements, and its uncertainty.

    `space` is the residual space of an adjustment without these centring errors (whitened observations without the part
    that the unknowns absorb). `chi2_drop` of the result is twice the increase of the log evidence.
    """
    effect = hypothesis.effect
    assert isinstance(effect, CentringVariance)
    occupation = target_occupations(space.adjustment.recording, effect.as_declared_uncertainty(MILLIMETRE))
    gain, sigma, n_determined = best_centring_sigma(space, occupation)
    sigma_of_estimate = float(sigma / np.sqrt(2.0 * max(n_determined, 1.0)))
    return replace(hypothesis, sizes=(sigma,), size_sigmas=(sigma_of_estimate,), chi2_drop=2.0 * gain)


def with_declared_centring(recording: Recording, selected_noise_hypotheses: Sequence[NoiseHypothesis]) -> Recording:
    """Recording whose set-up declares the centring errors among the given noise hypotheses."""
    further: list[CentringUncertainty] = [
        change.effect.as_declared_uncertainty(change.sizes[0])
        for change in selected_noise_hypotheses
        if isinstance(change.effect, CentringVariance)
    ]
    if not further:
        return recording
    centring = (*recording.setup.centring, *further)
    return recording.replace(setup=recording.setup.model_copy(update={"centring": centring}))


def _distinguished_occupation_kinds(recording: Recording) -> list[OccupationGrouping]:
    """Kinds of occupations (placements of a reflector) that a recording distinguishes: by set-up, column, or day."""
    declared = {c.occupation for c in recording.setup.centring if not c.stations and not c.targets}
    columns: tuple[OccupationGrouping, ...] = ("instrument_setup", "target_setup")
    kinds: list[OccupationGrouping] = ["station", *(column for column in columns if column in recording.labels)]
    kinds += ["day"] if len(set(days_of_pointings(recording))) > 1 else []
    return [kind for kind in kinds if kind not in declared]


def _determines_centring(recording: Recording, occupation_indices: Ints, *, requires_repeats_in_face: bool) -> bool:
    """True if a recording determines centring errors: occupations are few, recur at targets, and have repetitions.

    `occupation_indices` (n,) are the occupations (placements of a reflector) of n pointings. With
    `requires_repeats_in_face` the pointings must repeat in one face. Displacements for each set-up would otherwise fit
    any error that recurs in both faces.
    """
    occupied_rows = np.flatnonzero(occupation_indices >= 0)
    count, targets = len(np.unique(occupation_indices[occupied_rows])), len(np.unique(recording.target[occupied_rows]))
    n_occupations_per_face = len(
        np.unique(
            np.stack([occupation_indices[occupied_rows], recording.face[occupied_rows] * requires_repeats_in_face]),
            axis=1,
        ).T
    )
    return (
        count <= MAX_CENTRING_OCCUPATIONS
        and count >= MIN_MEAN_REPEATS * targets
        and len(occupied_rows) >= MIN_MEAN_REPEATS * n_occupations_per_face
    )
