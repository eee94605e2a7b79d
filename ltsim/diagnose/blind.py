"""What a network cannot see: effects that leave no residual, and the smallest size of all others."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Floats
from ltsim.diagnose.diagnosis import Undetectable
from ltsim.effects.effect import Effect
from ltsim.effects.signature import Signature
from ltsim.geometry.rotations import cross_matrix
from ltsim.remedies.detectability import MinimalSize, examine
from ltsim.remedies.words import advice

OUT_OF_REACH = 10.0
"""An effect that would have to be so many times a bad but plausible size to be found is called invisible."""


def sight_of(
    space: ResidualSpace, laws: Iterable[Signature]
) -> tuple[tuple[MinimalSize, ...], tuple[Undetectable, ...]]:
    """Effects that can be found here, and those that cannot with the error of the targets that they would hide.

    Of an effect with several parameters the one that is found best for its plausible size is told, at a middling place.

    Parameters
    ----------
    laws : iterable of Signature
        All that the diagnosis looks for, at all places; those of the catalogue are told.
    """
    families: dict[str, list[Effect]] = {}
    for law in laws:
        if isinstance(law, Effect):
            families.setdefault(law.name, []).append(law)
    found, hidden = [], []
    for places in families.values():
        seen = examine(space, places, columns=False)
        if seen is None:
            continue
        best = min(seen.table(), key=lambda row: row.typical / row.prior_sigma)
        times = best.typical / best.prior_sigma
        if times < OUT_OF_REACH:
            found.append(best)
        else:
            hidden.append(_undetectable(space, places[(len(places) - 1) // 2], times))
    return tuple(found), tuple(hidden)


def _undetectable(space: ResidualSpace, effect: Effect, times: float) -> Undetectable:
    sizes = np.diag([p.prior_sigma for p in effect.parameters])
    hides = max(_hidden_error(space, effect, size) for size in sizes)
    share = f"only {times:.0f} times that size" if np.isfinite(times) else "nothing"
    reason = f"absorbed by poses, targets and instrument parameters: of a bad but plausible size {share} would show"
    return Undetectable(effect.name, reason, hides, advice("cause"))


def _hidden_error(space: ResidualSpace, effect: Effect, values: Floats) -> float:
    """Distortion [um] of the adjusted targets, rms after the best rigid fit, that values (q,) [SI] would cause."""
    adjustment = space.adjustment
    system, layout = adjustment.solution.system, adjustment.problem.layout
    shift = space.signature(effect) @ values
    change = adjustment.factor.covariance_columns((system.design.T @ shift)[:, None])[:, 0]
    moved = change[layout.target].ravel()
    points = adjustment.state.points - adjustment.state.points.mean(axis=0)
    rigid = np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), -cross_matrix(points)], axis=2)
    motion = rigid.reshape(-1, 6)
    rest = moved - motion @ np.linalg.lstsq(motion, moved, rcond=None)[0]
    return float(1e6 * np.sqrt(3 * np.mean(rest**2)))
