"""What a network cannot see: effects that leave no residual, and the smallest size of all others."""

from collections.abc import Sequence

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Floats
from ltsim.diagnosis.cards import Cards
from ltsim.diagnosis.schema import Undetectable
from ltsim.effects.effect import Effect
from ltsim.geometry.rigid import rigid_motion
from ltsim.remedies.detectability import MinimalSize, information_left, seen_from, thinned
from ltsim.remedies.remedy import advice

OUT_OF_REACH = 10.0
"""An effect that would have to be so many times a bad but plausible size to be found is called invisible."""
SINGLE = 1e-5
"""Share of a squared length that single precision loses."""
Sight = tuple[tuple[MinimalSize, ...], tuple[Undetectable, ...]]


def sight_of(space: ResidualSpace, cards: Cards) -> Sight:
    """Effects that can be found here, and those that cannot, with the error of the targets they hide, worst first.

    Of several parameters that one is told that needs the smallest multiple of its plausible size, at a middling place.

    Parameters
    ----------
    cards : Cards
        All that was looked for, scored: what the adjustment leaves of each is known.
    """
    found, hidden = [], []
    for places in cards.left():
        best = min(seen_from(_seen(places), len(places)).table(), key=lambda row: row.typical / row.prior_sigma)
        times = best.typical / best.prior_sigma
        if times < OUT_OF_REACH:
            found.append(best)
        else:
            hidden.append(_undetectable(space, places[(len(places) - 1) // 2][0], times))
    return tuple(found), tuple(sorted(hidden, key=lambda one: -(one.hides_um or 0.0)))


def _seen(places: Sequence[tuple[Effect, Floats, Floats]]) -> list[tuple[Effect, Floats, float, int, Floats]]:
    """Information, visible share and rank at some of the places."""
    found = []
    for effect, own, gram in thinned(places):
        norm = np.sqrt(np.diag(own))
        unit = np.where(norm > 0, norm, 1.0)
        told = information_left(gram / np.outer(unit, unit), norm / effect.spread, SINGLE)
        found.append((effect, *told, np.zeros((0, 0))))
    return found


def _undetectable(space: ResidualSpace, effect: Effect, times: float) -> Undetectable:
    sizes = np.diag([p.prior_sigma for p in effect.parameters])
    hides = max(distortion(space, space.signature(effect) @ size) for size in sizes)
    size = f"only at {times:.0f} times a bad but plausible size" if np.isfinite(times) else "at no size"
    reason = f"absorbed by poses, targets and instrument parameters: it would show {size}"
    seen = times if np.isfinite(times) else None
    return Undetectable(effect=effect.name, reason=reason, hides_um=hides, shows_at=seen, cure=advice("cause"))


def distortion(space: ResidualSpace, shift: Floats) -> float:
    """What a whitened shift (m,) of the readings does to the adjusted targets: rms [um] after the best rigid fit."""
    moved = space.moved_targets(shift).ravel()
    points = space.adjustment.state.points
    motion = rigid_motion(points, points.mean(axis=0))
    rest = moved - motion @ np.linalg.lstsq(motion, moved, rcond=None)[0]
    return float(1e6 * np.sqrt(3 * np.mean(rest**2)))
