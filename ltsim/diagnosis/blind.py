"""Detectability of effects in a network: those that leave no residual, and the smallest size of all others."""

from collections.abc import Sequence

import numpy as np

from ltsim.adjustment.remedies.detectability import MinimalSize, Seen, information_left, seen_from, thinned
from ltsim.adjustment.remedies.remedy import advice
from ltsim.adjustment.residual_space import VISIBLE, ResidualSpace
from ltsim.core.arrays import Floats
from ltsim.diagnosis.cards import Cards
from ltsim.diagnosis.schema import Undetectable
from ltsim.geometry.rigid import rigid_motion
from ltsim.physics.effects.effect import Effect

OUT_OF_REACH = 10.0
"""An effect that would have to be so many times a bad but plausible size to be found is called invisible."""
TIE = 1e-6
"""Relative difference of two sizes below which the first is taken: rounding must not choose what is reported."""
DIGITS = 6
"""Decimals of a micrometre: what is less is rounding."""
AT_ONCE = 1_000_000
"""Numbers of signatures that are held at once."""
Sight = tuple[tuple[MinimalSize, ...], tuple[Undetectable, ...]]


def sight_of(space: ResidualSpace, cards: Cards) -> Sight:
    """Effects that can be found here, and those that cannot, with the error of the targets they hide, worst first.

    Of several parameters that one is told that needs the smallest multiple of its plausible size, at a middling place.

    Parameters
    ----------
    cards : Cards
        All that was looked for.
    """
    found, hidden = [], []
    for effects in cards.by_family():
        rows = _seen(space, effects).table()
        times = np.array([row.typical / row.prior_sigma for row in rows])
        best = int(np.flatnonzero(times <= times.min() * (1.0 + TIE))[0])
        if times[best] < OUT_OF_REACH:
            found.append(rows[best])
        else:
            hidden.append(_undetectable(space, effects[(len(effects) - 1) // 2], float(times[best])))
    return tuple(found), tuple(sorted(hidden, key=lambda one: -(one.hides_um or 0.0)))


def _seen(space: ResidualSpace, effects: Sequence[Effect]) -> Seen:
    """Detectability of an effect at a sample of its places, in double precision, as it is reported."""
    some, found = thinned(effects), []
    step = max(1, AT_ONCE // (space.size * len(some[0].parameters)))
    for batch in (some[i : i + step] for i in range(0, len(some), step)):
        signatures = [space.signature(effect) for effect in batch]
        edges = np.cumsum([0, *(signature.shape[1] for signature in signatures)])
        left = space.projection.grams(np.hstack(signatures), edges, slice(None))
        for effect, signature, gram in zip(batch, signatures, left, strict=True):
            norm = np.linalg.norm(signature, axis=0)
            unit = np.where(norm > 0, norm, 1.0)
            told = information_left(gram / np.outer(unit, unit), norm, VISIBLE)
            found.append((effect, *told, np.zeros((0, 0))))
    return seen_from(found, len(effects))


def _undetectable(space: ResidualSpace, effect: Effect, times: float) -> Undetectable:
    sizes = np.diag([p.prior_sigma for p in effect.parameters])
    hides = round(max(distortion(space, space.signature(effect) @ size) for size in sizes), DIGITS)
    size = f"only at {times:.0f} times a bad but plausible size" if np.isfinite(times) else "at no size"
    reason = f"absorbed by poses, targets and instrument parameters: it would show {size}"
    seen = times if np.isfinite(times) else None
    return Undetectable(effect=effect.name, reason=reason, hides_um=hides, shows_at=seen, cure=advice("cause"))


def distortion(space: ResidualSpace, shift: Floats) -> float:
    """Distortion of the adjusted targets by a whitened shift (m,) of readings: rms [um] after the best rigid fit."""
    moved = space.moved_targets(shift).ravel()
    points = space.adjustment.state.points
    motion = rigid_motion(points, points.mean(axis=0))
    rest = moved - motion @ np.linalg.lstsq(motion, moved, rcond=None)[0]
    return float(1e6 * np.sqrt(3 * np.mean(rest**2)))
