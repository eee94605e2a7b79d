"""Next measurement with most information on the instrument, or that decides between possible causes of a misfit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.candidates import (
    CANDIDATE_KINDS_BY_EFFORT,
    CandidateMeasurement,
    VisibilityFunction,
    advice_sentence,
    calibrated_length_candidates,
    list_text,
    pointing_candidates,
    procedure_candidates,
    repeated_setup_candidates,
    station_candidates,
)
from ltsim.adjustment.remedies.explanations import PossibleCause, RivalCauses, best_explanation, residual_space_of
from ltsim.adjustment.remedies.network import PlannedNetwork
from ltsim.core.equality import ValueEquality
from ltsim.physics.effects import effect_title
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.effects.verbs import effect_tuple

MIN_DECISIVE_CHI2 = 10.0
"""Smallest expected difference of chi-square between two possible causes that a measurement distinguishes."""
N_EVALUATED_CANDIDATE_STATIONS = 24
"""Number of candidate stations for which the expected difference of chi-square between causes is computed: the stations
that give most information on the instrument."""
DEFAULT_MOVE_TIME = 1200.0
"""Default time [s] to move the instrument and to set it up again."""

ProgressCallback = Callable[[str, float], None]
"""Function that is called with the name of the present step and its completed fraction, 0 to 1."""


def no_progress(*_arguments: object) -> None:
    """Progress callback that does nothing."""


@dataclass(frozen=True)
class MeasurementProposal(ValueEquality):
    """Proposed further measurement with its expected benefit."""

    candidate: CandidateMeasurement
    """Proposed measurement: instruction, duration and network with predicted readings."""
    remaining_sigma_fraction: float
    """Ratio of the standard deviation of the instrument parameters with the measurement to that without it; geometric
    mean over the principal axes of their covariance."""
    most_improved_parameter: str
    """Name of the instrument parameter whose standard deviation decreases most."""
    most_improved_sigma_fraction: float
    """Standard deviation of `most_improved_parameter` with the measurement, divided by that without it."""
    expected_chi2_differences: dict[str, float] = field(default_factory=dict)
    """Expected difference of chi-square between the first possible cause and each other cause, by name of the other
    cause."""

    @classmethod
    def from_candidate(
        cls,
        candidate: CandidateMeasurement,
        present_adjustment: Adjustment,
        adjustment: Adjustment,
        expected_chi2_differences: dict[str, float] | None = None,
    ) -> MeasurementProposal:
        """Proposal of a measurement, from the present adjustment and the adjustment with the measurement.

        `expected_chi2_differences` contains the expected difference of chi-square between the first possible cause and
        each other cause, by name of the other cause. For an instrument without parameters the ratios of standard
        deviations are 1.
        """
        if not adjustment.construction.n_parameters:
            return cls(candidate, 1.0, "", 1.0, expected_chi2_differences or {})
        before, after = present_adjustment.first_instrument_covariance, adjustment.first_instrument_covariance
        sigma_gain = np.exp(0.5 / len(before) * (np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]))
        ratio = np.sqrt(np.diag(after) / np.diag(before))
        best_index = int(np.argmin(ratio))
        return cls(
            candidate,
            float(sigma_gain),
            adjustment.construction.parameter_names[best_index],
            float(ratio[best_index]),
            expected_chi2_differences or {},
        )

    @property
    def distinguished_explanations(self) -> tuple[str, ...]:
        """Names of the possible causes that the measurement would distinguish from the first possible cause."""
        return tuple(name for name, value in self.expected_chi2_differences.items() if value >= MIN_DECISIVE_CHI2)

    @property
    def distinguishes_all(self) -> bool:
        """True if the measurement would distinguish every other possible cause from the first possible cause."""
        return bool(self.expected_chi2_differences) and len(self.distinguished_explanations) == len(
            self.expected_chi2_differences
        )

    @property
    def sort_key(self) -> tuple[int, int, float, float]:
        """Sort key, smaller for better proposals: by number of distinguished causes, then effort, then evidence."""
        decisive_chi2 = sum(min(value, MIN_DECISIVE_CHI2) for value in self.expected_chi2_differences.values())
        if not self.distinguished_explanations:
            return 0, 0, 0.0, -decisive_chi2
        return (
            -len(self.distinguished_explanations),
            CANDIDATE_KINDS_BY_EFFORT.index(self.candidate.kind),
            self.candidate.duration,
            -decisive_chi2,
        )


@dataclass(frozen=True)
class RankedProposals(ValueEquality):
    """Proposals of further measurements, the best first."""

    proposals: tuple[MeasurementProposal, ...]
    """Proposals, ordered by evidence between possible causes, or by information on the instrument."""
    compared_explanations: tuple[str, ...] = ()
    """Names of the possible causes to distinguish; empty for a ranking by information on the instrument."""
    compared_places: tuple[str, ...] = ()
    """Names of the stations and targets at which the possible causes act; empty if they act on the whole recording."""
    present_chi2_differences: dict[str, float] = field(default_factory=dict)
    """Difference of chi-square between the first and each other possible cause in the present recording, by name of the
    other cause."""

    @property
    def advice_sentence(self) -> str:
        """Sentence with the best proposal, and what it decides between possible causes."""
        best_proposal = self.proposals[0]
        if not self.compared_explanations:
            return best_proposal.candidate.instruction
        distinguished = best_proposal.distinguished_explanations or self.compared_explanations[1:]
        now, then = (
            list_text([f"{template_values[name]:.0f}" for name in distinguished])
            for template_values in (self.present_chi2_differences, best_proposal.expected_chi2_differences)
        )
        titles = {name: effect_title(name) for name in self.compared_explanations}
        other_titles = list_text([titles[name] for name in distinguished])
        template_values = {"first": titles[self.compared_explanations[0]], "others": other_titles, "then": then}
        if not best_proposal.distinguished_explanations:
            return advice_sentence("undecided", needed=MIN_DECISIVE_CHI2, **template_values)
        sentence = advice_sentence("decided", do=best_proposal.candidate.instruction, now=now, **template_values)
        remaining = [titles[name] for name in self.compared_explanations[1:] if name not in distinguished]
        return sentence + (advice_sentence("left open", others=list_text(remaining)) if remaining else "")


def rank_measurements_between(
    adjustment: Adjustment,
    explanations: Sequence[str],
    with_effects: str | LinearEffect | Sequence[str | LinearEffect] = (),
    **options: Any,
) -> RankedProposals:
    """Proposals of further measurements, ranked by their evidence between effects that are given by name.

    The effects act at the stations or targets where they fit the residuals of `adjustment` best. `with_effects` are
    further effects of the model, and `options` those of `rank_deciding_measurements`.
    """
    plain = residual_space_of(adjustment)
    extra_effects = [best_explanation(plain, e).effect if isinstance(e, str) else e for e in effect_tuple(with_effects)]
    space = residual_space_of(adjustment, extra_effects)
    asked = [best_explanation(space, name) for name in explanations]
    return rank_deciding_measurements(adjustment, asked, extra_effects, **options)


def rank_informative_measurements(
    network: PlannedNetwork,
    *,
    seconds_per_move: float = DEFAULT_MOVE_TIME,
    visibility_function: VisibilityFunction | None = None,
    progress: ProgressCallback = no_progress,
) -> RankedProposals:
    """Proposals of further measurements of a network, ranked by their information on the instrument.

    `visibility_function` restricts the positions of additional stations and the targets that they measure.
    """
    stations = station_candidates(network, seconds_per_move, visibility_function)
    pointings = pointing_candidates(network, visibility_function=visibility_function)
    candidates = *pointings, *repeated_setup_candidates(network, seconds_per_move), *stations
    proposals = []
    for done, proposal in enumerate(_proposals_for(candidates, network.make_adjustment()), 1):
        proposals.append(proposal)
        progress("trying further measurements", done / len(candidates))
    return RankedProposals(tuple(sorted(proposals, key=lambda p: p.remaining_sigma_fraction)))


def rank_deciding_measurements(
    adjustment: Adjustment,
    explanations: Sequence[PossibleCause],
    extra_effects: Sequence[LinearEffect] = (),
    *,
    seconds_per_move: float = DEFAULT_MOVE_TIME,
    visibility_function: VisibilityFunction | None = None,
    stops_at_first: bool = False,
    progress: ProgressCallback = no_progress,
) -> RankedProposals:
    """Proposals of further measurements, ranked by their evidence between two or more possible causes of a misfit.

    Every cause is compared with the first cause; causes that the recording already distinguishes are ignored. The
    parameters of `extra_effects` are estimated too. `visibility_function` restricts the positions of additional
    stations. With `stops_at_first` the search ends at the first measurement that distinguishes all causes.
    """
    network, (first, *others) = PlannedNetwork.from_adjustment(adjustment), explanations
    planned_adjustment = network.make_adjustment()
    space = residual_space_of(planned_adjustment, extra_effects)
    rivals = {other.effect.name: RivalCauses.from_explanations(space, first, other) for other in others}
    decided_names = [name for name, pair in rivals.items() if pair.present_chi2_difference >= MIN_DECISIVE_CHI2]
    if len(decided_names) < len(rivals):
        rivals = {name: pair for name, pair in rivals.items() if name not in decided_names}
    suspects = [target for e in explanations for target in e.effect.targets]
    nearby_candidates = sorted(pointing_candidates(network, suspects, visibility_function), key=_effort_rank)
    repeat_remedies = sorted(repeated_setup_candidates(network, seconds_per_move), key=_effort_rank)
    lengths = calibrated_length_candidates(network, suspects)
    costly_remedies = sorted([*procedure_candidates(network), *lengths], key=_effort_rank)
    n_proposals = len(nearby_candidates) + len(repeat_remedies) + N_EVALUATED_CANDIDATE_STATIONS + len(costly_remedies)
    proposals: list[MeasurementProposal] = []
    stations = _most_informative_stations(network, seconds_per_move, visibility_function)
    every = chain(nearby_candidates, repeat_remedies, stations, costly_remedies)
    for candidate in every:
        longer_adjustment = candidate.make_adjustment()
        if longer_adjustment is None:
            continue
        longer = residual_space_of(longer_adjustment, extra_effects)
        evidence = {name: pair.expected_chi2_difference(longer) for name, pair in rivals.items()}
        proposals.append(MeasurementProposal.from_candidate(candidate, planned_adjustment, longer_adjustment, evidence))
        progress("comparing the possible causes", min(len(proposals) / n_proposals, 1.0))
        if stops_at_first and proposals[-1].distinguishes_all:
            break
    ranked_proposals = tuple(sorted(proposals, key=lambda p: p.sort_key))
    return RankedProposals(
        ranked_proposals,
        (first.effect.name, *rivals),
        tuple(dict.fromkeys(name for e in explanations for name in (*e.effect.stations, *e.effect.targets))),
        {name: pair.present_chi2_difference for name, pair in rivals.items()},
    )


def _proposals_for(
    candidates: Iterable[CandidateMeasurement], present_adjustment: Adjustment
) -> Iterator[MeasurementProposal]:
    """Proposals for those candidate measurements that do not leave a pose undetermined."""
    for candidate in candidates:
        adjustment = candidate.make_adjustment()
        if adjustment is not None:
            yield MeasurementProposal.from_candidate(candidate, present_adjustment, adjustment)


def _effort_rank(candidate: CandidateMeasurement) -> tuple[int, float]:
    """Effort of a measurement as a sort key: rank of its kind by effort, then its duration [s]."""
    return CANDIDATE_KINDS_BY_EFFORT.index(candidate.kind), candidate.duration


def _most_informative_stations(
    network: PlannedNetwork, seconds_per_move: float, visibility_function: VisibilityFunction | None
) -> Iterator[CandidateMeasurement]:
    """Candidate stations that give most information on the instrument, the station with the shortest duration first."""
    remedies = station_candidates(network, seconds_per_move, visibility_function)
    proposals = _proposals_for(remedies, network.make_adjustment())
    best_proposals = sorted(proposals, key=lambda p: p.remaining_sigma_fraction)[:N_EVALUATED_CANDIDATE_STATIONS]
    yield from sorted((p.candidate for p in best_proposals), key=_effort_rank)
