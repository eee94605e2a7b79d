"""What to measure next: the addition that tells most about the instrument, or that decides between explanations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ltsim.adjust import adjust
from ltsim.adjust.adjustment import Adjustment
from ltsim.arrays import Floats
from ltsim.effects import find_effect
from ltsim.effects.effect import Effect, NoiseEffect
from ltsim.errors import ModelError
from ltsim.model.construction import Construction, stated_construction
from ltsim.notebook import Columns, Shown
from ltsim.plan.criteria import d_criterion
from ltsim.plan.detectability import ResidualRoom, thinned
from ltsim.plan.extensions import Extension, further_pointings, further_stations
from ltsim.plan.site import Progress, quiet
from ltsim.recording.recording import Recording

DECISIVE = 10.0
"""Expected difference of chi-square from which two explanations count as told apart."""
FINALISTS = 24
"""Further stations whose evidence is computed in full."""


@dataclass(frozen=True)
class Proposal:
    """A further measurement and what it would bring.

    Attributes
    ----------
    extension : Extension
    sharper : float
        Factor on the geometric mean of the parameters' standard deviations; below one is a gain.
    serves : str
        The parameter that gains most, and its factor.
    evidence : dict of str to float
        Expected difference of chi-square between the first explanation and each other, whichever of the two holds.
    """

    extension: Extension
    sharper: float
    serves: str
    serves_factor: float
    evidence: dict[str, float] = field(default_factory=dict)

    @property
    def tells_apart(self) -> tuple[str, ...]:
        """Explanations that would be told from the first."""
        return tuple(name for name, value in self.evidence.items() if value >= DECISIVE)

    @property
    def decides(self) -> bool:
        """All would be told from the first."""
        return bool(self.evidence) and len(self.tells_apart) == len(self.evidence)

    @property
    def rank(self) -> tuple[int, float, float]:
        """The smaller, the better: how many are told apart, then how quickly, then how nearly."""
        near = sum(min(value, DECISIVE) for value in self.evidence.values())
        return -len(self.tells_apart), self.extension.seconds if self.tells_apart else 0.0, -near


@dataclass(frozen=True, repr=False)
class NextMeasurement(Shown):
    """Proposals, the best first.

    Attributes
    ----------
    between : tuple of str
        The explanations to decide between; none where the instrument was asked about.
    evidence_now : dict of str to float
        Between the first and each other in the recording as it is.
    """

    proposals: tuple[Proposal, ...]
    between: tuple[str, ...] = ()
    evidence_now: dict[str, float] = field(default_factory=dict)

    def _lines(self) -> list[str]:
        question = f" between {' and '.join(self.between)}" if self.between else ""
        return [f"Next measurement{question}: {self.proposals[0].extension.words}, of {len(self.proposals)} proposals"]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        return {"proposals": self._proposals}

    def _proposals(self) -> Columns:
        return {
            "do": [p.extension.words for p in self.proposals],
            "minutes": [p.extension.seconds / 60 for p in self.proposals],
            "sharper": [p.sharper for p in self.proposals],
            "serves": [p.serves for p in self.proposals],
            "tells_apart": [" ".join(p.tells_apart) for p in self.proposals],
        }


@dataclass(frozen=True)
class Explanation:
    """An effect at the place and with the shape that fit a recording best, and its size (q,)."""

    effect: Effect
    values: Floats


def next_measurement(
    recording: Recording,
    *,
    between: tuple[str, ...] = (),
    construction: Construction | None = None,
    minutes_per_move: float = 20.0,
    progress: Progress = quiet,
) -> NextMeasurement:
    """Rank further pointings and further stations.

    Parameters
    ----------
    between : tuple of str
        Names of two or more effects: rank by how many are told from the first, of these the quickest first, then by
        the evidence between them; none: rank by the gain on the instrument's parameters.

    Raises
    ------
    ModelError
        When an effect does not exist, is a noise effect, or cannot be fitted to this recording.
    """
    adjustment = solved(recording, construction or stated_construction(recording))
    room = ResidualRoom.of(adjustment)
    explanations = [explanation(room, name) for name in between]
    suspects = [target for found in explanations for target in found.effect.targets]
    extensions = [
        *further_pointings(adjustment, suspects), *further_stations(adjustment, 60.0 * minutes_per_move)
    ]  # fmt: skip
    proposals = []
    for done, extension in enumerate(extensions, 1):
        proposals.append(_informed(adjustment, extension))
        progress("trying further measurements", done / len(extensions))
    proposals.sort(key=lambda p: p.sharper)
    if len(between) < 2:
        return NextMeasurement(tuple(proposals))
    first, *rivals = explanations
    now = {name: evidence(room, first, rival) for name, rival in zip(between[1:], rivals, strict=True)}
    judged = []
    finalists = _finalists(proposals)
    for done, proposal in enumerate(finalists, 1):
        extended = ResidualRoom.of(proposal.extension.adjustment(adjustment))
        found = {name: evidence(extended, first, rival) for name, rival in zip(between[1:], rivals, strict=True)}
        judged.append(replace(proposal, evidence=found))
        progress("weighing the explanations", done / len(finalists))
    judged.sort(key=lambda p: p.rank)
    return NextMeasurement(tuple(judged), between, now)


def solved(recording: Recording, construction: Construction) -> Adjustment:
    """The recording adjusted, without pointings that are gross errors or to targets that they do not determine."""
    found = adjust(recording, construction)
    found.solution.require_success()
    used = np.asarray(found.problem.use.any(axis=1))
    return found if used.all() else adjust(recording.select(used), construction)


def _finalists(proposals: list[Proposal]) -> list[Proposal]:
    """All further pointings, and the stations that tell most, returns among them."""
    stations = [p for p in proposals if p.extension.kind == "station"]
    again = [p for p in stations if "once more" in p.extension.words]
    new = [p for p in stations if "once more" not in p.extension.words]
    return [p for p in proposals if p.extension.kind == "pointings"] + again + new[:FINALISTS]


def _informed(adjustment: Adjustment, extension: Extension) -> Proposal:
    """What an extension tells about the first instrument."""
    scale = adjustment.problem.prior_sigma[0]
    before = adjustment.instrument_covariance / np.outer(scale, scale)
    after = extension.adjustment(adjustment).instrument_covariance / np.outer(scale, scale)
    sharper = float(d_criterion(after) / d_criterion(before))
    ratio = np.sqrt(np.diag(after) / np.diag(before))
    best = int(np.argmin(ratio))
    return Proposal(extension, sharper, adjustment.construction.names[best], float(ratio[best]))


def explanation(room: ResidualRoom, name: str) -> Explanation:
    """The effect called `name` where, and with the shape with which, it fits the residuals best.

    Raises
    ------
    ModelError
        When there is no such effect, or it leaves no trace in this recording.
    """
    kind = find_effect(name)
    if issubclass(kind, NoiseEffect):
        raise ModelError(f"{name} is a change of the noise; only effects that shift readings can be told apart here")
    residual = room.residual
    best: Explanation | None = None
    most = 0.0
    for effect in kind.candidates(room.adjustment.sightings):
        left = room.project(room.signature(effect))
        if not np.isfinite(left).all() or not left.any():
            continue
        values = np.linalg.lstsq(left, residual, rcond=1e-6)[0]
        drop = float(residual @ residual - np.sum((residual - left @ values) ** 2))
        if drop > most:
            most, best = drop, Explanation(effect, np.asarray(values, dtype=np.float64))
    if best is None:
        raise ModelError(f"{name} leaves no trace in this recording; no size of it can be taken from it")
    return best


def evidence(room: ResidualRoom, first: Explanation, second: Explanation) -> float:
    """Expected difference of chi-square, for whichever explanation holds with the size found (the smaller of both)."""
    return min(_one_sided(room, first, second.effect), _one_sided(room, second, first.effect))


def _one_sided(room: ResidualRoom, truth: Explanation, rival: Effect) -> float:
    """What the best instance of the rival leaves of the true signature."""
    signature = room.project(room.signature(truth.effect) @ truth.values)
    smallest = float(signature @ signature)
    for effect in [rival, *thinned(type(rival).candidates(room.adjustment.sightings))]:
        left = room.project(room.signature(effect))
        if not np.isfinite(left).all():
            continue
        values = np.linalg.lstsq(left, signature, rcond=1e-6)[0]
        smallest = min(smallest, float(np.sum((signature - left @ values) ** 2)))
    return smallest
