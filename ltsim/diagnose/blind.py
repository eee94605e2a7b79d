"""What a network cannot see: effects that leave no residual, and the smallest size of all others."""

from __future__ import annotations

import numpy as np

from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Floats
from ltsim.diagnose.bank import Bank, Hypothesis
from ltsim.diagnose.diagnosis import Detectable, Undetectable
from ltsim.geometry.rotations import cross_matrix

NONCENTRALITY = 17.07
"""Noncentrality found with power 80 % at level 0.1 % in one degree of freedom (Baarda's lambda_0)."""
OUT_OF_REACH = 10.0
"""An effect that would have to be so many times a bad but plausible size to be found is called invisible."""


def _smallest(space: ResidualSpace, hypothesis: Hypothesis) -> Floats:
    """Smallest size (q,) [SI] found of each parameter alone; infinite where nothing is left of it."""
    whole = space.signature(hypothesis.effect)
    left = np.einsum("mq,mq->q", *(2 * [space.project(whole)]))
    full = np.einsum("mq,mq->q", whole, whole)
    seen = left > 1e-9 * np.maximum(full, 1e-300)
    sizes: Floats = np.where(seen, np.sqrt(NONCENTRALITY / np.where(seen, left, 1.0)), np.inf)
    return sizes


def _representatives(space: ResidualSpace, bank: Bank) -> dict[str, tuple[Hypothesis, Floats]]:
    """For each family of the catalogue its hypothesis of middling visibility, and its smallest sizes over prior."""
    families: dict[str, list[tuple[float, int]]] = {}
    for i, hypothesis in enumerate(bank.hypotheses):
        if hypothesis.known:
            families.setdefault(hypothesis.family, []).append((float(bank.visible[i]), i))
    chosen = {}
    for family, members in families.items():
        hypothesis = bank.hypotheses[sorted(members)[(len(members) - 1) // 2][1]]
        prior = np.array([p.prior_sigma for p in hypothesis.effect.parameters])
        chosen[family] = (hypothesis, _smallest(space, hypothesis) / prior)
    return chosen


def detectable_sizes(space: ResidualSpace, bank: Bank) -> tuple[Detectable, ...]:
    """Minimal detectable size of every effect that can be found here, at a place of middling visibility."""
    rows = []
    for family, (hypothesis, relative) in _representatives(space, bank).items():
        parameters = hypothesis.effect.parameters
        best = int(np.argmin(relative))
        if relative[best] < OUT_OF_REACH:
            p = parameters[best]
            rows.append(Detectable(family, p.name, float(relative[best] * p.prior_sigma / p.factor), p.unit))
    return tuple(rows)


def undetectable_effects(space: ResidualSpace, bank: Bank) -> tuple[Undetectable, ...]:
    """Effects that leave no usable residual, with the error of the targets that a bad but plausible size hides."""
    rows = []
    for family, (hypothesis, relative) in _representatives(space, bank).items():
        prior = np.array([p.prior_sigma for p in hypothesis.effect.parameters])
        if float(relative.min()) < OUT_OF_REACH:
            continue
        hidden = max(_hidden_error(space, hypothesis, np.eye(len(prior))[i] * prior) for i in range(len(prior)))
        share = "nothing" if not np.isfinite(relative).any() else f"only {relative.min():.0f} times that size"
        reason = f"absorbed by poses, targets and instrument parameters: of a bad but plausible size {share} would show"
        cure = str(getattr(type(hypothesis.effect), "cure", "")) or "an independent measurement of its cause"
        rows.append(Undetectable(family, reason, hidden, cure))
    return tuple(rows)


def _hidden_error(space: ResidualSpace, hypothesis: Hypothesis, values: Floats) -> float:
    """Distortion [um] of the adjusted targets, rms after the best rigid fit, that values (q,) [SI] would cause."""
    adjustment = space.adjustment
    system, layout = adjustment.solution.system, adjustment.problem.layout
    shift = space.signature(hypothesis.effect) @ values
    change = adjustment.factor.covariance_columns((system.design.T @ shift)[:, None])[:, 0]
    moved = change[layout.target].ravel()
    points = adjustment.state.points - adjustment.state.points.mean(axis=0)
    rigid = np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), -cross_matrix(points)], axis=2)
    motion = rigid.reshape(-1, 6)
    rest = moved - motion @ np.linalg.lstsq(motion, moved, rcond=None)[0]
    return float(1e6 * np.sqrt(3 * np.mean(rest**2)))
