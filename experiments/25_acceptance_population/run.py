"""Whom do the acceptance tests let pass? A population of trackers, good and bad, against the errors of their points."""

from itertools import pairwise
from typing import Any

import numpy as np

from experiments.common import Made, Options, tell, write_figure, write_table
from ltsim.acceptance.prediction import Plan, harm_of
from ltsim.acceptance.tests import Standard, builtin, envelope
from ltsim.arrays import Bools, Floats
from ltsim.geometry.polar import to_polar
from ltsim.model.construction import misalignment
from ltsim.pages.figures.campaign import Swept, by_factor
from ltsim.randomness import stream
from ltsim.recording.specification import sheet

SHEET = "leica-at500"
TRIALS, SEED, BLOCK = 40_000, 25, 1000
SPREAD = 0.5, 8.0
"""Constants of an instrument over what its maker's limits imply: drawn evenly in the logarithm between these."""
STANDARDS: tuple[Standard, ...] = ("asme-b89.4.19-2006", "iso-10360-10-two-face")
EDGES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, np.inf)
"""Of the largest point error over its limit."""


def drawn(plans: dict[str, Plan], trials: int) -> tuple[Floats, dict[str, Bools]]:
    """Largest point error over its limit (trials,), and whether each instrument passes each plan (trials,)."""
    limits = sheet(SHEET)
    stated = limits.instrument()
    built = next(iter(plans.values())).construction
    prior = np.array([p.sigma_from(stated.prior) for p in built.parameters])
    points = envelope()
    harm = harm_of(built, points, prior)
    range_ = to_polar(points)[:, 0]
    limit = np.hypot(np.sqrt(2) * limits.across(range_), limits.along(range_))
    shares, passed = [], {name: [] for name in plans}  # type: ignore[var-annotated]
    for start in range(0, trials, BLOCK):
        rng = stream(SEED, "population", start)
        size = np.exp(rng.uniform(*np.log(SPREAD), BLOCK))
        units = rng.standard_normal((BLOCK, built.size)) * size[:, None]
        gaps = np.linalg.norm((units @ harm.T).reshape(BLOCK, -1, 3), axis=2)
        shares.append(np.max(gaps / limit, axis=1))
        for name, plan in plans.items():
            errors = np.einsum("kip,np->nki", plan.sensitivities * prior, units)
            noise = rng.standard_normal(errors.shape) * plan.scatter
            passed[name].append(plan.within(errors + noise).all(axis=1))
    return np.concatenate(shares)[:trials], {name: np.concatenate(p)[:trials] for name, p in passed.items()}


def run(options: Options) -> Made:
    """The table is population.csv, the picture population.svg."""
    limits = sheet(SHEET)
    noise = limits.instrument().noise
    plans = {
        name: Plan(tuple(builtin(name, 1.5, (2.0, 6.0, 12.0, 18.0, 24.0, 30.0))), misalignment(), limits, noise)
        for name in STANDARDS
    }
    trials = options.trials or TRIALS
    share, passed = drawn(plans, trials)
    passed["both"] = np.logical_and.reduce(list(passed.values()))
    rows: list[dict[str, Any]] = []
    curves = []
    for low, high in pairwise(EDGES):
        mine = (share >= low) & (share < high)
        count = int(mine.sum())
        words = f"to {high:g}" if np.isfinite(high) else f"over {low:g}"
        row: dict[str, Any] = {"error_over_limit": words, "instruments": count}
        for name, good in passed.items():
            rate = float(good[mine].mean()) if count else float("nan")
            error = float(np.sqrt(max(rate * (1 - rate), 1 / count) / count)) if count else float("nan")
            row |= {name: 100 * rate, f"{name}_uncertainty": 100 * error}
            ends = np.clip([rate, rate - 1.96 * error, rate + 1.96 * error], 0, 1) * 100
            curves.append(Swept(words, name, "", *ends, ends[0], ends[0]))
        rows.append(row)
    write_table(options.out / "population.csv", rows)
    axis = "largest point error over its limit, in steps"
    write_figure(options.out / "population.svg", by_factor(curves, label="pass every test [%]", axis=axis))
    bad = share > 1.0
    for name, good in passed.items():
        tell(
            f"{name}: {100 * good[~bad].mean():.1f} % of the {int((~bad).sum())} good instruments pass, "
            f"{100 * good[bad].mean():.1f} % of the {int(bad.sum())} whose points err by more than the limit"
        )
    return Made(seed=SEED, trials=trials, more={"specification": SHEET, "spread": list(SPREAD)})
