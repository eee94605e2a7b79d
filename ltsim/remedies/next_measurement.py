"""What to measure next: the remedy that tells most about the instrument, or that decides between explanations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from ltsim.adjustment import adjust
from ltsim.adjustment.adjustment import Adjustment
from ltsim.effects.signature import Signature
from ltsim.model.construction import stated_construction
from ltsim.recording.exchange import RecordingSource, recording_of
from ltsim.remedies.deciding import DECISIVE, Explanation, Rivals, explanation, space_of
from ltsim.remedies.network import Network
from ltsim.remedies.remedy import (
    EFFORT,
    Remedy,
    further_pointings,
    further_stations,
    known_length,
    other_ways,
    returns,
)
from ltsim.remedies.words import advice, listed
from ltsim.results import Columns, Result

FINALISTS = 24
"""Further places whose evidence is computed in full: those that tell most about the instrument."""
MOVE = 1200.0
"""[s] to carry the instrument to another place and set it up, where nothing else is said."""

Progress = Callable[[str, float], None]
"""Told what is being done and which share of it is done."""


def quiet(*_told: object) -> None:
    """Nobody is told."""


@dataclass(frozen=True)
class Proposal:
    """A remedy and what it would bring."""

    remedy: Remedy
    sharper: float
    """Factor on the geometric mean of the parameters' standard deviations; below one is better."""
    serves: str
    """The parameter that profits most, and the factor on its standard deviation."""
    serves_factor: float
    evidence: dict[str, float] = field(default_factory=dict)
    """Expected difference of chi-square between the first explanation and each other, whichever of the two holds."""

    @classmethod
    def of(cls, remedy: Remedy, adjustment: Adjustment, evidence: dict[str, float] | None = None) -> Proposal:
        """What a remedy tells about the first instrument of a planned network; nothing of one without parameters."""
        if not adjustment.construction.size:
            return cls(remedy, 1.0, "", 1.0, evidence or {})
        before, after = adjustment.instrument_covariance, remedy.network.adjustment.instrument_covariance
        sharper = np.exp(0.5 / len(before) * (np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]))
        ratio = np.sqrt(np.diag(after) / np.diag(before))
        best = int(np.argmin(ratio))
        return cls(remedy, float(sharper), adjustment.construction.names[best], float(ratio[best]), evidence or {})

    @property
    def tells_apart(self) -> tuple[str, ...]:
        """Explanations that would be told from the first."""
        return tuple(name for name, value in self.evidence.items() if value >= DECISIVE)

    @property
    def decides(self) -> bool:
        """All would be told from the first."""
        return bool(self.evidence) and len(self.tells_apart) == len(self.evidence)

    @property
    def rank(self) -> tuple[int, int, float, float]:
        """The smaller, the better: how many are told apart, then with how little effort, then how nearly."""
        near = sum(min(value, DECISIVE) for value in self.evidence.values())
        if not self.tells_apart:
            return 0, 0, 0.0, -near
        return -len(self.tells_apart), EFFORT.index(self.remedy.kind), self.remedy.seconds, -near


@dataclass(frozen=True, repr=False)
class NextMeasurement(Result):
    """Proposals, the best first."""

    proposals: tuple[Proposal, ...]
    between: tuple[str, ...] = ()
    """The explanations to decide between; none where the instrument was asked about."""
    evidence_now: dict[str, float] = field(default_factory=dict)
    """Between the first and each other in the recording as it is."""

    @property
    def advice(self) -> str:
        """The answer to what would decide, as a sentence; without a question the best thing to do."""
        best = self.proposals[0]
        if not self.between:
            return best.remedy.words
        apart = best.tells_apart or self.between[1:]
        values = {"first": self.between[0], "others": listed(apart), "then": _numbers(best.evidence, apart)}
        if not best.tells_apart:
            return advice("undecided", needed=DECISIVE, **values)
        said = advice("decided", do=best.remedy.words, now=_numbers(self.evidence_now, apart), **values)
        left = [name for name in self.between[1:] if name not in apart]
        return said + (advice("left open", others=listed(left)) if left else "")

    def _lines(self) -> list[str]:
        question = f" between {listed(self.between)}" if self.between else ""
        return [f"Next measurement{question}: {self.proposals[0].remedy.words}, of {len(self.proposals)} proposals"]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        return {"proposals": self._proposals}

    def _proposals(self) -> Columns:
        return {
            "do": [p.remedy.words for p in self.proposals],
            "minutes": [p.remedy.seconds / 60 for p in self.proposals],
            "sharper": [p.sharper for p in self.proposals],
            "serves": [p.serves for p in self.proposals],
            "tells_apart": [" ".join(p.tells_apart) for p in self.proposals],
        }


def _numbers(evidence: dict[str, float], names: Sequence[str]) -> str:
    return listed([f"{evidence[name]:.0f}" for name in names])


def next_measurement(
    recording: RecordingSource,
    *,
    between: Sequence[str] = (),
    beside: Sequence[Signature] = (),
    minutes_per_move: float = 20.0,
    progress: Progress = quiet,
) -> NextMeasurement:
    """Rank further measurements after a recording.

    Parameters
    ----------
    recording : Recording, str or Path
    between : sequence of str
        Names of two or more effects: rank by how many are told from the first, of these what asks least of a person
        and is done first, then by the evidence between them; none: rank what can be pointed at from here or from a
        further station by what it tells about the instrument's parameters.
    beside : sequence of Signature
        What has been found already beside the question.
    minutes_per_move : float
        What it costs to move the tripod.
    progress : callable
        Told what is done and the share of it.

    Raises
    ------
    ModelError
        When an effect does not exist, is a noise effect, or cannot be fitted to this recording.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> proposals = lt.next_measurement(recording)
    >>> proposals.proposals[0].sharper < 1
    True
    """
    seen = recording_of(recording)
    adjustment = adjust(seen, stated_construction(seen))
    adjustment.solution.require_success()
    if len(between) > 1:
        space = space_of(adjustment, beside)
        asked = [explanation(space, name) for name in between]
        return deciding(adjustment, asked, beside, seconds_per_move=60.0 * minutes_per_move, progress=progress)
    network, move = Network.of(adjustment), 60.0 * minutes_per_move
    found = [*further_pointings(network), *returns(network, move), *further_stations(network, move)]
    proposals = []
    for done, remedy in enumerate(found, 1):
        proposals.append(Proposal.of(remedy, network.adjustment))
        progress("trying further measurements", done / len(found))
    return NextMeasurement(tuple(sorted(proposals, key=lambda p: p.sharper)))


def deciding(
    adjustment: Adjustment,
    explanations: Sequence[Explanation],
    beside: Sequence[Signature] = (),
    *,
    seconds_per_move: float = MOVE,
    first_is_enough: bool = False,
    progress: Progress = quiet,
) -> NextMeasurement:
    """Rank remedies by the evidence that they bring between explanations of an adjusted recording.

    Parameters
    ----------
    adjustment : Adjustment
    explanations : sequence of Explanation
        Two or more; each is to be told from the first. Those that the recording tells from it already are left aside.
    beside : sequence of Signature
        What has been found already beside them.
    first_is_enough : bool
        Look no further than the first remedy that decides; it is the best of all.
    """
    network, (first, *others) = Network.of(adjustment), explanations
    space = space_of(network.adjustment, beside)
    rivals = {other.effect.name: Rivals.of(space, first, other) for other in others}
    told = [name for name, pair in rivals.items() if pair.now >= DECISIVE]
    if len(told) < len(rivals):
        rivals = {name: pair for name, pair in rivals.items() if name not in told}
    suspects = [target for e in explanations for target in e.effect.targets]
    near = sorted(further_pointings(network, suspects), key=_effort)
    again = sorted(returns(network, seconds_per_move), key=_effort)
    late = sorted([*other_ways(network), *known_length(network)], key=_effort)
    total = len(near) + len(again) + FINALISTS + len(late)
    judged: list[Proposal] = []
    for remedy in chain(near, again, _finalists(network, seconds_per_move), late):
        longer = space_of(remedy.network.adjustment, beside)
        evidence = {name: pair.evidence(longer) for name, pair in rivals.items()}
        judged.append(Proposal.of(remedy, network.adjustment, evidence))
        progress("weighing the explanations", min(len(judged) / total, 1.0))
        if first_is_enough and judged[-1].decides:
            break
    ranked = tuple(sorted(judged, key=lambda p: p.rank))
    return NextMeasurement(ranked, (first.effect.name, *rivals), {name: pair.now for name, pair in rivals.items()})


def _effort(remedy: Remedy) -> tuple[int, float]:
    return EFFORT.index(remedy.kind), remedy.seconds


def _finalists(network: Network, seconds_per_move: float) -> Iterator[Remedy]:
    """The further places that tell most about the instrument, the quickest first."""
    told = [Proposal.of(r, network.adjustment) for r in further_stations(network, seconds_per_move)]
    best = sorted(told, key=lambda p: p.sharper)[:FINALISTS]
    yield from sorted((p.remedy for p in best), key=_effort)
