"""`plan.json` as the report reads it: what it needs is checked, the rest is ignored."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from ltsim.report.files import CombinationEntry, Table, Vector


class PlannedStation(Table):
    """Where a tripod goes."""

    name: str
    position_mm: Vector
    yaw_deg: float
    sigma_position_um: tuple[float, ...] = ()
    reflectors_seen: int = 0


class PlannedReflector(Table):
    """A reflector and how well it becomes known."""

    name: str
    position_mm: Vector
    sigma_um: float
    stations_seeing: int = 0


class PlannedParameter(Table):
    """How well an instrument parameter becomes known."""

    name: str
    unit: str = ""
    sigma: float
    prior_sigma: float


class ImprovementEntry(Table):
    """One of the paper's criteria, expected."""

    before_um: float
    after_um: float
    improvement_percent: float


class LayoutEntry(Table):
    """A layout with what is known of it before measuring."""

    allowed: bool = True
    hours: float
    pointings: int = 0
    quality: dict[str, float | None] = Field(default_factory=dict)
    stations: tuple[PlannedStation, ...]
    reflectors: tuple[PlannedReflector, ...] = ()
    parameters: tuple[PlannedParameter, ...] = ()
    undetermined: tuple[CombinationEntry, ...] = ()
    expected_improvement: dict[str, ImprovementEntry] | None = None


class OptionEntry(Table):
    """One way of working and the best layout found for it."""

    stations: int
    faces: int
    repeats: int
    pointings: int
    hours: float
    value: float | None = None
    quality: dict[str, float | None] = Field(default_factory=dict)
    efficient: bool = False


class DetectableSize(Table):
    """Smallest size of an effect that a layout would show, at its best and its worst place."""

    effect: str
    parameter: str = ""
    unit: str = ""
    best: float | None = None
    typical: float | None = None
    worst: float | None = None
    worst_at: str | None = None
    plausible: float = 0.0


class AlikeEntry(Table):
    """Two effects that a layout can hardly tell apart."""

    effect: str
    taken_for: str
    share: float


class PlanResult(LayoutEntry):
    """`plan.json`."""

    format: str
    title: str = ""
    summary: str
    reasons: tuple[str, ...] = ()
    frame: str = ""
    reference: LayoutEntry | None = None
    tradeoff: tuple[OptionEntry, ...] = ()
    detectable: tuple[DetectableSize, ...] = ()
    alike: tuple[AlikeEntry, ...] = ()
    silent: tuple[str, ...] = ()
    settings: dict[str, Any] = Field(default_factory=dict)
    seed: int | None = None
