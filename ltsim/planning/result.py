"""The results of planning, declared once: Python object, JSON, terminal and page."""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field

from ltsim.core.results import Result, Table
from ltsim.planning import tables
from ltsim.planning.schema import (
    ConfusablePair,
    DetectableSize,
    LayoutEntry,
    LossEntry,
    OptionEntry,
    PlanChange,
    ProposalEntry,
)
from ltsim.planning.tolerances import percent
from ltsim.recordings.result_file import Finite, OptionalFloat, ResultFile


class PlanResult(ResultFile, LayoutEntry, Result):
    """`plan.json`: from `plan`."""

    FILE: ClassVar[str] = "plan.json"
    format: Literal["ltsim-plan-result/1"] = "ltsim-plan-result/1"
    """Format and version of this file."""
    title: str = ""
    """Free text."""
    summary: str
    """The plan in one sentence."""
    reasons: tuple[str, ...] = ()
    """Reasons for the layout, a sentence each."""
    frame: str = ""
    """Coordinate system of all coordinates, in words."""
    reference: LayoutEntry | None = None
    """The scenario's own layout."""
    fewest_stations: OptionEntry | None = None
    """The fewest that match the scenario's own layout."""
    tradeoff: tuple[OptionEntry, ...] = ()
    """All ways of working that were tried, the cheapest first."""
    starts: tuple[OptionalFloat, ...] = ()
    """Value of the objective of each independent search, the best first; smaller is better."""
    reflector_changes: tuple[PlanChange, ...] = ()
    """Changes of one reflector that help, the best first, then reflectors that can be left out."""
    changes_tried: str = ""
    """Numbers of reflector changes tried and of those that help, as a sentence."""
    bodies: tuple[str, ...] = ()
    """Bodies in the hall, a sentence each: type of the file, size and place."""
    reached: bool | None = None
    """The goal is reached: no rule is broken and tolerances are kept, after any one loss too where that is asked for;
    null without any."""
    tolerances_met: bool | None = None
    """All points keep their tolerances while nothing is lost; null without any."""
    losses: tuple[LossEntry, ...] = ()
    """Tolerances after the loss of each station, and of each sight of a point with a tolerance."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Content of the plan file."""
    seed: int | None = None
    """Root of the search."""
    detectable: tuple[DetectableSize, ...] = ()
    """Minimal detectable sizes of effects."""
    confusable: tuple[ConfusablePair, ...] = ()
    """Pairs of effects that the layout cannot distinguish."""
    silent: tuple[str, ...] = ()
    """Effects that leave no trace in the residuals."""

    __repr__ = __str__ = Result.__repr__

    def _lines(self) -> list[str]:
        return [self.summary, *self.reasons[:1]]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        return {
            "stations": self._stations,
            "reflectors": self._reflectors,
            "tolerances": self._tolerances,
            "losses": self._losses,
            "tradeoff": lambda: tables.TRADEOFF.filled(self.tradeoff),
            "parameters": self._parameters,
            "expected": self._expected,
            "changes": self._changes,
            "effects": lambda: tables.EFFECTS.filled(self.detectable),
            "confusable": lambda: tables.CONFUSABLE.filled(self.confusable),
            "nominals": lambda: tables.NOMINALS.filled([r.name, *r.position_mm] for r in self.reflectors),
        }

    def _stations(self) -> Table:
        return tables.STATIONS.filled(
            [s.name, *s.position_mm, s.yaw_deg, *(s.sigma_position_um or 3 * (None,)), s.visible_reflectors]
            for s in self.stations
        )

    def _reflectors(self) -> Table:
        return tables.REFLECTORS.filled(
            [r.name, *r.position_mm, r.sigma_um, *(r.u_um or 3 * (None,)), r.within_mm, r.tolerance_mm,
             " ".join(r.visible_from)]
            for r in self.reflectors
        )  # fmt: skip

    def _tolerances(self) -> Table:
        return tables.TOLERANCES.filled(
            [r.name, r.within_mm, r.tolerance_mm, percent(r.used), r.met] for r in self.reflectors if r.used is not None
        )

    def _losses(self) -> Table:
        return tables.LOSSES.filled(
            [loss.lost, loss.met, loss.worst, "" if loss.ratio is None else percent(loss.ratio), " ".join(loss.unseen)]
            for loss in sorted(self.losses, key=lambda loss: loss.met)
        )

    def _parameters(self) -> Table:
        reference = {p.name: p.sigma for p in self.reference.parameters} if self.reference else {}
        return tables.PARAMETERS.filled(
            [p.name, p.unit, p.sigma, reference.get(p.name), p.prior_sigma, p.gain] for p in self.parameters
        )

    def _expected(self) -> Table:
        layouts: list[tuple[str, LayoutEntry | None]] = [("this plan", self), ("reference layout", self.reference)]
        return tables.EXPECTED.filled(
            [layout, name, e.before_um, e.after_um, e.improvement_percent]
            for layout, entry in layouts
            if entry is not None and entry.expected_improvement
            for name, e in entry.expected_improvement.items()
        )

    def _changes(self) -> Table:
        return tables.CHANGES.filled(
            [i, c.deed, c.gain_um, 100 * (1 - c.quality), c.serves, 100 * (c.serves_factor - 1)]
            for i, c in enumerate(self.reflector_changes, 1)
        )


class NextFile(ResultFile):
    """`next.json`: from `plan --after`."""

    FILE: ClassVar[str] = "next.json"
    format: Literal["ltsim-next/1"] = "ltsim-next/1"
    """Format and version of this file."""
    diagnosis: str = ""
    """Result of the diagnosis, as a sentence."""
    between: tuple[str, ...] = ()
    """The explanations to decide between."""
    evidence_now: dict[str, Finite] = Field(default_factory=dict)
    """Difference of chi-square between the first explanation and each other one, in the recording as it is."""
    advice: str = ""
    """First action to take, as a sentence."""
    proposals: tuple[ProposalEntry, ...] = Field(min_length=1)
    """Proposals of further measurements, the best first."""
