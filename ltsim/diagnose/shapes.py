"""Posterior of an effect's parameters and shape constants over all its shapes and near places."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from ltsim.arrays import Floats
from ltsim.diagnose.evidence import wide_posterior
from ltsim.effects.signature import ShapeParameter, Tunable
from ltsim.units import FACTOR

if TYPE_CHECKING:
    from ltsim.diagnose.search import Searcher
    from ltsim.diagnose.sets import Found


def _fine(shape: ShapeParameter, now: float, sigma: float, count: int) -> tuple[Floats, Floats]:
    """Values of a shape constant over its bounds, denser within four `sigma` of the estimate, and widths of cells."""

    def even(x: Floats) -> Floats:
        return np.log(x) if shape.logarithmic else (1.0 / x if shape.reciprocal else x)

    low, high = min(shape.low, now), max(shape.high, now)
    grid = np.geomspace(low, high, count) if shape.logarithmic else np.linspace(low, high, count)
    if shape.reciprocal:
        grid = 1.0 / np.linspace(1.0 / low, 1.0 / high, count)
    near = np.clip(now + sigma * np.linspace(-4.0, 4.0, 13), low, high)
    values = np.unique(np.concatenate([grid, near, [now]]))
    edges = even(np.concatenate([values[:1], 0.5 * (values[1:] + values[:-1]), values[-1:]]))
    return values, np.maximum(np.abs(np.diff(edges)), 1e-300)


def shape_posterior(
    searcher: Searcher, effect: Tunable, base: Found, spread: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation, in the units a person reads, of parameters and constants over all shapes.

    Shapes on a grid, finer around the estimate (`spread`: standard deviations there), are weighed by their
    evidence and the room they stand for, neighbours in place (`Tunable.finer`) all alike; each brings the
    uncertainty it leaves the parameters. Unlike a curvature at the optimum this holds where a likelihood is flat,
    skew, cut off by bounds, or has two tops. Empty for effects without such constants.
    """
    shapes = [s for s in type(effect).shape if isinstance(vars(effect)[s.name], float) and s.steps > 1]
    near = effect.finer(searcher.space.sightings)
    if not (shapes or near) or len(shapes) > 2:
        return {}
    count = 33 if len(shapes) == 1 and not near else 15
    units = {p.name: p.factor for p in effect.parameters} | {s.name: FACTOR[s.unit] for s in shapes}
    axes = [_fine(s, float(vars(effect)[s.name]), spread.get(s.name, 0.0) * units[s.name], count) for s in shapes]
    sizes = np.array([p.prior_sigma for p in effect.parameters])
    changes = "time" in vars(effect)
    means, seconds, logs = [], [], []
    for one, *point in product([effect, *near], *(zip(*axis, strict=True) for axis in axes)):
        constants = np.array([value for value, _ in point])
        named = {s.name: float(c) for s, c in zip(shapes, constants, strict=True)}
        found, covariance, evidence = wide_posterior(*searcher.moments(one.reshaped(**named), base), sizes)
        logs.append(evidence + float(np.sum(np.log([width for _, width in point]))))
        when = [float(vars(one)["time"])] if changes else []
        means.append(np.concatenate([found, constants, when]))
        seconds.append(np.concatenate([np.diag(covariance) + found**2, constants**2, np.square(when)]))
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    mean = weight @ np.array(means)
    deviation = np.sqrt(np.maximum(weight @ np.array(seconds) - mean**2, 0.0))
    names = [p.name for p in effect.parameters] + [s.name for s in shapes] + (["time"] if changes else [])
    told = {n: (float(m), float(d)) for n, m, d in zip(names, mean, deviation, strict=True)}
    return {n: (m / units.get(n, 1.0), d / units.get(n, 1.0)) for n, (m, d) in told.items()}
