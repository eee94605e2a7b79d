"""What is hidden in a recording: an effect, its place, shape, sign and size, drawn over the whole catalogue."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Floats
from ltsim.effects import BASELINE, GROUPS
from ltsim.effects.air_layer import AirLayer
from ltsim.effects.drift import WARM_UP, Drift
from ltsim.effects.effect import Effect, NoiseEffect
from ltsim.effects.face_confusion import FaceConfusion
from ltsim.effects.heat_plume import HeatPlume
from ltsim.effects.noise_level import NoiseLevel
from ltsim.effects.outlier import Outlier
from ltsim.effects.places import gaps_near
from ltsim.effects.range_cyclic import LONGEST, RangeCyclic
from ltsim.effects.range_step import RangeStep
from ltsim.effects.smr_incidence import PAPER_TABLE, SmrIncidence
from ltsim.effects.station_bump import StationBump
from ltsim.effects.station_settling import StationSettling
from ltsim.effects.target_moved import TargetMoved
from ltsim.effects.target_swap import TargetSwap
from ltsim.effects.window import Window
from ltsim.effects.wrong_unit import WrongUnit
from ltsim.geometry.rotations import about_z
from ltsim.scene.sightings import Sightings

from .invented import draw_invented

ABSURD = 20.0
"""Sizes beyond so many prior sigmas are not drawn."""
INVISIBLE = 1e-5
"""Share of a signature's squared size left by the adjustment, below which it is not drawn."""
ALLOWED_TRIES = 400
UNITS = ("inch", "metre", "gon", "zenith")
"""Slips of the pen that are drawn."""
MISTAKES: tuple[type[Effect], ...] = (TargetSwap, WrongUnit, FaceConfusion)
LATER = ("range-mode",)
"""Effects that came after the samples were drawn."""
SYSTEMATIC: tuple[type[Effect], ...] = tuple(
    kind
    for kinds in GROUPS.values()
    for kind in kinds
    if kind not in {type(e) for e in BASELINE} and kind not in MISTAKES and kind.name not in LATER
)


@dataclass(frozen=True)
class Hidden:
    """An effect with the true values (q,) [SI] of its parameters."""

    effect: Effect
    values: Floats

    def shift(self, sightings: Sightings) -> Floats:
        """Exact change (n, 3) of the raw readings."""
        return self.effect.shift(sightings, self.values)

    def scaled(self, factor: float) -> Hidden:
        """The same with another size."""
        if isinstance(self.effect, SmrIncidence) and self.effect.table:
            table = tuple(factor * x for x in self.effect.table)
            return Hidden(replace(self.effect, table=table), factor * self.values)
        return Hidden(self.effect, factor * self.values)

    @property
    def size(self) -> float:
        """The largest parameter in units of its plausible size."""
        if isinstance(self.effect, SmrIncidence) and self.effect.table:
            return float(abs(self.effect.table[0] / PAPER_TABLE[0]))
        prior = np.array([p.prior_sigma for p in self.effect.parameters])
        return float(np.max(np.abs(self.values) / prior))


def draw_effect(sightings: Sightings, rng: np.random.Generator) -> Effect | None:
    """An effect of the catalogue at a random place, its shape between the points of any grid; None: not here."""
    kind = SYSTEMATIC[int(rng.integers(len(SYSTEMATIC)))]
    if kind is Window:
        return _pane(sightings, rng)
    tried = kind.candidates(sightings)
    if not tried:
        return None
    return _between(tried[int(rng.integers(len(tried)))], sightings, tried, rng)


def _between(effect: Effect, sightings: Sightings, tried: list[Effect], rng: np.random.Generator) -> Effect:
    """The effect with continuous constants off the grid and change times in any gap."""
    constants: dict[str, Any] = {}
    match effect:
        case AirLayer():
            heights = [e.height for e in tried if isinstance(e, AirLayer)]
            constants = {"height": rng.uniform(min(heights), max(heights)), "width": _geometric(rng, 0.1, 0.7)}
        case HeatPlume():
            constants = {"radius": _geometric(rng, 0.15, 0.6)}
            if effect.stations:
                way = rng.standard_normal(3) * [1.0, 1.0, 0.7]
                arm = rng.uniform(0.3, 0.8) * way / np.linalg.norm(way)
                constants["offset"] = tuple(arm.tolist())
        case RangeCyclic():
            shortest = min(e.wavelength for e in tried if isinstance(e, RangeCyclic))
            constants = {"wavelength": 1.0 / rng.uniform(1.0 / LONGEST, 1.0 / shortest)}
        case Drift() if effect.law == "exponential":
            constants = {"time_constant": _geometric(rng, WARM_UP.low, WARM_UP.high)}
        case StationSettling():
            bounds = effect.shape[0]
            constants = {"time_constant": _geometric(rng, bounds.low, bounds.high)}
        case RangeStep() | StationBump() | TargetMoved(kind="step"):
            constants = {"time": _any_gap(effect, sightings, rng)}
        case SmrIncidence() if rng.random() < 0.5:
            constants = {"table": PAPER_TABLE, "direction": float(rng.uniform(-np.pi, np.pi))}
    return effect.reshaped(**constants) if constants else effect


def _geometric(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _any_gap(effect: Effect, sightings: Sightings, rng: np.random.Generator) -> float:
    """The middle of any gap with enough pointings on either side."""
    times = np.sort(sightings.time[effect.mask(sightings) > 0])
    least = {RangeStep: 2, StationBump: 4}.get(type(effect), 1)
    middles = gaps_near(times, float(times[0]), reach=len(times))[least - 1 : len(times) - least]
    return float(rng.choice(middles)) if len(middles) else float(getattr(effect, "time", 0.0))


def _pane(sightings: Sightings, rng: np.random.Generator) -> Effect:
    """A pane of glass before some neighbouring targets of a station, not quite square to them."""
    s = int(rng.integers(len(sightings.station_names)))
    arm = sightings.points - sightings.position[s]
    seen = np.unique(sightings.target[sightings.station == s])
    seen = np.roll(seen[np.argsort(np.arctan2(arm[seen, 1], arm[seen, 0]))], int(rng.integers(len(seen))))
    block = seen[: int(rng.integers(3, 10))]
    across = arm[block].sum(axis=0) * [1.0, 1.0, 0.0]
    normal = about_z(float(rng.normal(0.0, 0.1))) @ across / np.linalg.norm(across)
    names = tuple(sightings.target_names[t] for t in sorted(block))
    return Window((sightings.station_names[s],), names, tuple(normal.tolist()))


def draw_mistake(sightings: Sightings, rng: np.random.Generator) -> Hidden:
    """A blunder: two reflectors exchanged, a wrong unit, a confused face, a reading off by millimetres."""
    kind = (*MISTAKES, Outlier)[int(rng.integers(4))]
    if kind is Outlier:
        tried: list[Effect] = list(Outlier.candidates(sightings))
        effect = tried[int(rng.integers(len(tried)))]
        return Hidden(effect, np.array([rng.choice([-1.0, 1.0]) * _geometric(rng, 2e-3, 3e-2)]))
    options = [e for e in kind.possible(sightings) if np.any(e.design(sightings))]  # type: ignore[attr-defined]
    if kind is WrongUnit:
        options = [e for e in options if e.mistake in UNITS]
    return Hidden(options[int(rng.integers(len(options)))], np.ones(1))


def left_by_adjustment(space: ResidualSpace, hidden: Hidden) -> tuple[Floats, Floats]:
    """Whitened signature (m,) and what the ordinary adjustment leaves of it."""
    gauge = space.adjustment.problem.gauge
    lengths = hidden.effect.gauge_design(gauge.first, gauge.second, space.adjustment.state.points)
    whole = space.whiten(hidden.shift(space.sightings)[:, :, None], lengths @ hidden.values[:, None])
    return whole[:, 0], space.project(whole)[:, 0]


def _expected_drop(space: ResidualSpace, hidden: Hidden) -> Floats:
    """Expected drop (r,) of minus twice the restricted log likelihood of a change of the noise, reading by reading."""
    effect = hidden.effect
    assert isinstance(effect, NoiseEffect)
    used = space.use
    factor = (effect.variance(space.sightings, space.sigma, hidden.values) / space.sigma**2)[used]
    share = space.redundancy[: len(factor)]
    drop: Floats = share * (factor - 1.0 - np.log(factor))
    return drop


def strength(space: ResidualSpace, hidden: Hidden) -> float:
    """Noncentrality left after the ordinary adjustment, or the expected drop for a change of the noise; 0: unseen."""
    if isinstance(hidden.effect, NoiseEffect):
        return float(_expected_drop(space, hidden).sum())
    whole, left = left_by_adjustment(space, hidden)
    square = float(left @ left)
    return square if square > INVISIBLE * float(whole @ whole) else 0.0


def strengths(space: ResidualSpace, hidden: Hidden) -> Floats:
    """(3,) What distance, azimuth and elevation have in the strength: their changes times what is left of these."""
    if isinstance(hidden.effect, NoiseEffect):
        each = _expected_drop(space, hidden)
    else:
        each = np.multiply(*left_by_adjustment(space, hidden))
    used = np.flatnonzero(space.use)
    return np.bincount(used % 3, each[: len(used)], minlength=3)


def _direction(effect: Effect, rng: np.random.Generator) -> Floats:
    """Values (q,) [SI] of plausible proportions."""
    values = rng.standard_normal(len(effect.parameters))
    if isinstance(effect, SmrIncidence) and effect.table:
        values[:] = 0.0
    if isinstance(effect, NoiseEffect):
        values = np.abs(values)
    if isinstance(effect, NoiseLevel):
        chosen = rng.random(3) < 0.5
        values = np.where(chosen if chosen.any() else True, values, 0.0)
    values = np.where([p.positive for p in effect.parameters], np.abs(values), values)
    return values * np.array([p.prior_sigma for p in effect.parameters])


def _sized(space: ResidualSpace, hidden: Hidden, wanted: float) -> Hidden | None:
    """The effect at the wanted strength, or None where it would be invisible or absurd."""
    for _ in range(12):
        found = strength(space, hidden)
        if not found > 0.0 or hidden.size > 1e6:
            return None
        if abs(found / wanted - 1.0) < 1e-3:
            break
        hidden = hidden.scaled(float(np.clip(np.sqrt(wanted / found), 1e-3, 1e3)))
    else:
        return None
    return hidden if hidden.size <= ABSURD else None


def draw_hidden(
    space: ResidualSpace, rng: np.random.Generator, wanted: float, *, known: bool = True, laws: str = "all"
) -> Hidden:
    """An effect drawn at random, of the catalogue or (not `known`) of a set of laws, with the wanted strength."""
    for _ in range(ALLOWED_TRIES):
        effect = draw_effect(space.sightings, rng) if known else draw_invented(space.sightings, rng, laws)
        if effect is None:
            continue
        hidden = _sized(space, Hidden(effect, _direction(effect, rng)), wanted)
        if hidden is not None:
            return hidden
    raise RuntimeError("no effect of a sensible size was found for this network")


__all__ = ["MISTAKES", "Hidden", "draw_hidden", "draw_mistake", "left_by_adjustment", "strength", "strengths"]
