"""Propagation of distributions by Monte Carlo, with as many trials as the figures need (JCGM 101, clauses 7 and 8).

Every source is drawn from its own distribution and its own stream; points move by its response, the tasks are then
evaluated exactly. Trials come in batches until averages over batches are stable to the digits told (clause 7.9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.geometry.expansion import Expansion
from ltsim.randomness import stream
from ltsim.tasks.inputs import Inputs
from ltsim.tasks.measurands import Measurand
from ltsim.tasks.propagation import Propagated, parts_of
from ltsim.tasks.spec import MonteCarlo

BATCH = 10_000
PIECE = 1_000
"""Trials evaluated at once: enough to be fast, few enough to stay small."""


@dataclass(frozen=True)
class Drawn:
    """The distribution of the results."""

    values: Floats
    """(trials, k)."""
    mean: Floats
    sigma: Floats
    """(k,) each."""
    symmetric: Floats
    shortest: Floats
    """(k, 2): coverage intervals with equal tails, and the shortest."""
    stable: Bools
    """(k,): whether the figures are stable to the digits asked for."""
    tolerance: Floats
    """(k,): half a unit of the last digit of the standard uncertainty (clause 7.9.2)."""

    @property
    def trials(self) -> int:
        """Number of trials."""
        return len(self.values)

    def agrees(self, linear: Propagated, coverage: float) -> Bools:
        """(k,): whether the linear interval's ends are those of the distribution within the tolerance (clause 8)."""
        expanded = linear.expanded(coverage)
        ends = np.stack([linear.values - expanded, linear.values + expanded], axis=1)
        return np.all(np.abs(ends - self.symmetric) <= self.tolerance[:, None], axis=1)


def draw(inputs: Inputs, measurands: Sequence[Measurand], stretch: Expansion, settings: MonteCarlo) -> Drawn:
    """Trials until every figure is stable, or the most that the settings allow."""
    batches: list[Floats] = []
    while True:
        batches.append(_batch(inputs, measurands, stretch, settings.seed, len(batches)))
        figures = np.stack([_figures(batch, settings.coverage) for batch in batches])
        values = np.concatenate(batches)
        sigma = values.std(axis=0, ddof=1)
        tolerance = tolerance_of(sigma, settings.digits)
        if len(batches) > 1:
            error = figures.std(axis=0, ddof=1) / np.sqrt(len(batches))
            stable = np.all(2.0 * error <= tolerance, axis=0)
            if stable.all() or (len(batches) + 1) * BATCH > settings.most_trials:
                break
        elif settings.most_trials < 2 * BATCH:
            stable = np.zeros(len(sigma), dtype=bool)
            break
    return Drawn(values, values.mean(axis=0), sigma, *intervals(values, settings.coverage), stable, tolerance)


def _batch(inputs: Inputs, measurands: Sequence[Measurand], stretch: Expansion, seed: int, number: int) -> Floats:
    """Results (BATCH, k) of one batch."""
    shift = np.zeros((BATCH, inputs.points.size))
    for i, source in enumerate(inputs.sources):
        shape = BATCH, source.response.shape[1]
        rng = stream(seed, "uncertainty", source.name, i, number)
        shift += variates(rng, source.distribution, shape) @ source.response.T
    factor = np.full(BATCH, stretch.factor)
    for name, sigma in parts_of(stretch):
        factor += sigma * stream(seed, "uncertainty", name, number).standard_normal(BATCH)
    points = inputs.points + shift.reshape(BATCH, *inputs.points.shape)
    pieces = [slice(at, at + PIECE) for at in range(0, BATCH, PIECE)]
    rows = [np.concatenate([m.values(points[p], factor[p]) for m in measurands], axis=1) for p in pieces]
    return np.concatenate(rows)


def variates(rng: np.random.Generator, distribution: str, shape: tuple[int, ...]) -> Floats:
    """Draws of zero mean and unit standard deviation."""
    if distribution == "rectangular":
        return rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), shape)
    if distribution == "triangular":
        return rng.triangular(-np.sqrt(6.0), 0.0, np.sqrt(6.0), shape)
    if distribution == "arcsine":
        return np.sqrt(2.0) * np.sin(rng.uniform(-np.pi, np.pi, shape))
    return rng.standard_normal(shape)


def _figures(values: Floats, coverage: float) -> Floats:
    """(4, k): mean, standard deviation and the ends of the symmetric interval of one batch."""
    tail = 50.0 * (1.0 - coverage)
    ends = np.percentile(values, [tail, 100.0 - tail], axis=0)
    return np.stack([values.mean(axis=0), values.std(axis=0, ddof=1), *ends])


def intervals(values: Floats, coverage: float) -> tuple[Floats, Floats]:
    """Symmetric and shortest coverage intervals (k, 2) of trials (n, k) (JCGM 101, 7.7)."""
    ordered = np.sort(values, axis=0)
    count = len(ordered)
    inside = int(np.clip(round(coverage * count), 1, count - 1))
    low = (count - inside) // 2
    symmetric = np.stack([ordered[low], ordered[low + inside]], axis=1)
    widths = ordered[inside:] - ordered[: count - inside]
    best = np.argmin(widths, axis=0)
    columns = np.arange(values.shape[1])
    shortest = np.stack([ordered[best, columns], ordered[best + inside, columns]], axis=1)
    return symmetric, shortest


def tolerance_of(sigma: Floats, digits: int) -> Floats:
    """Half a unit of the last of so many digits of each standard uncertainty (JCGM 101, 7.9.2)."""
    safe = np.where(sigma > 0, sigma, 1.0)
    power = np.floor(np.log10(safe)) - (digits - 1)
    return np.where(sigma > 0, 0.5 * 10.0**power, 0.0)
