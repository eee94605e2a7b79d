"""uncertainty.json, uncertainty.csv and budget.csv: what the tasks of a file are worth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from ltsim.calibration.result import frame_of
from ltsim.recording.result_file import Entry, Known, ResultFile, SourceEntry, write_result
from ltsim.tasks.evaluation import BUDGET as BUDGET, RESULTS as RESULTS, Evaluation, worst_first
from ltsim.tasks.verdict import Judgement, normalised_error


class MonteCarloTold(Entry):
    """The distribution of a result: mean, standard uncertainty and coverage intervals in its unit (JCGM 101)."""

    mean: float
    """Of the draws."""
    standard_uncertainty: float
    """Of the draws."""
    symmetric: tuple[float, float]
    """Probabilistically symmetric interval."""
    shortest: tuple[float, float]
    """Shortest interval."""
    stable: bool
    """whether the figures are stable to the digits asked for"""
    agrees: bool
    """whether the linear interval is that of the distribution (JCGM 101, clause 8)"""


class Part(Entry):
    """One source of a result's uncertainty: its type, its share of the variance, its standard uncertainty."""

    source: str
    """Where it comes from."""
    type: Literal["A", "B"]
    """Of the evaluation, by the GUM."""
    share: float
    """Of the variance."""
    standard_uncertainty: float
    """In the result's unit."""


class ConformityTold(Entry):
    """A result against its tolerance (JCGM 106), limits and guard band in its unit."""

    lower: float | None
    """Limit of the tolerance."""
    upper: float | None
    """Limit of the tolerance."""
    rule: Literal["guarded", "simple"]
    """As the task file says."""
    guard_band: float
    """Between tolerance and acceptance."""
    probability: float
    """that the true value lies within the tolerance"""
    judgement: Judgement
    """`accepted`, `rejected` or `undecided`."""
    wrong: float
    """probability that the judgement is wrong"""


class Result(Entry):
    """One number of a task with its uncertainty, in its unit."""

    task: str
    """Name of the task."""
    kind: str
    """Its kind."""
    name: str
    """Which of its numbers."""
    unit: str
    """Of all figures."""
    value: float
    """The estimate."""
    standard_uncertainty: float
    """By the GUM's law of propagation."""
    coverage_factor: float
    """Of the expanded uncertainty."""
    expanded_uncertainty: float
    """For the coverage."""
    monte_carlo: MonteCarloTold
    """By distributions."""
    curvature: float
    """gap of the linear adjustment, in standard uncertainties"""
    budget: tuple[Part, ...]
    """Sources, the largest first."""
    conformity: ConformityTold | None = None
    """Against its tolerance."""


class UncertaintyFile(ResultFile):
    """`uncertainty.json`: from `uncertainty`."""

    FILE: ClassVar[str] = "uncertainty.json"
    format: Literal["ltsim-uncertainty/1"] = "ltsim-uncertainty/1"
    """Which format and version this file is in."""
    title: str
    """Free text."""
    source: str
    """The recording or scenario."""
    coverage: float
    """Of all intervals."""
    trials: int
    """Of the propagation of distributions."""
    frame: str
    """Of all coordinates."""
    sigma0: Known
    """of the adjustment that the points come from"""
    results: tuple[Result, ...]
    """One a number."""
    correlation: tuple[tuple[Known, ...], ...]
    """of the results, in their order"""
    warnings: tuple[str, ...] = ()
    """What to know before the numbers are used."""


def told(evaluation: Evaluation) -> UncertaintyFile:
    """An evaluation as the contents of its file."""
    tasks, linear = evaluation.tasks, evaluation.linear
    coverage = tasks.monte_carlo.coverage
    conforms = dict(evaluation.conformities())
    results = []
    for i, (task, output) in enumerate(evaluation.results):
        unit, drawn = output.factor, evaluation.drawn
        sigma = float(linear.sigma[i])
        expanded = float(linear.expanded(coverage)[i])
        verdict = conforms.get(i)
        limits = task.tolerances.get(output.name)
        results.append(
            Result(
                task=task.name,
                kind=task.kind,
                name=output.name,
                unit=output.unit,
                value=float(linear.values[i]) / unit,
                standard_uncertainty=sigma / unit,
                coverage_factor=expanded / sigma if sigma > 0 else 0.0,
                expanded_uncertainty=expanded / unit,
                monte_carlo=MonteCarloTold(
                    mean=float(drawn.mean[i]) / unit,
                    standard_uncertainty=float(drawn.sigma[i]) / unit,
                    symmetric=_pair(drawn.symmetric[i] / unit),
                    shortest=_pair(drawn.shortest[i] / unit),
                    stable=bool(drawn.stable[i]),
                    agrees=bool(evaluation.agrees[i]),
                ),
                curvature=float(evaluation.curved[i]),
                budget=tuple(
                    Part(
                        source=name,
                        type="B" if linear.kinds[name] == "B" else "A",
                        share=share,
                        standard_uncertainty=float(np.sqrt(share)) * sigma / unit,
                    )
                    for name, share in worst_first(linear.shares, i)
                ),
                conformity=None
                if verdict is None or limits is None
                else ConformityTold(
                    lower=limits.lower,
                    upper=limits.upper,
                    rule=tasks.decision.rule,
                    guard_band=verdict.guard,
                    probability=verdict.probability,
                    judgement=verdict.judgement,
                    wrong=verdict.wrong,
                ),
            )
        )
    found = evaluation.inputs.adjustment
    return UncertaintyFile(
        recording=SourceEntry.of(found.recording),
        title=tasks.title,
        source=tasks.source,
        coverage=coverage,
        trials=evaluation.drawn.trials,
        frame=frame_of(found),
        sigma0=found.sigma0,
        results=tuple(results),
        correlation=tuple(tuple(row) for row in linear.correlation.tolist()),
        warnings=tuple(evaluation.warnings),
    )


def _pair(ends: Sequence[float]) -> tuple[float, float]:
    return float(ends[0]), float(ends[1])


def write_uncertainty(evaluation: Evaluation, folder: Path) -> UncertaintyFile:
    """Write uncertainty.json, uncertainty.csv (a row a result) and budget.csv (a row a source); give what was written.

    Raises
    ------
    RecordError
        When the folder cannot be written; nothing half-written stays behind.
    """
    tables = [evaluation.table(name) for name in ("results", "budget")]
    return write_result(folder, told(evaluation), {table.file: table.csv() for table in tables})


def compared(first: UncertaintyFile, second: UncertaintyFile) -> list[tuple[str, float]]:
    """``task, result`` and E_n of every result that both files have in the same unit.

    E_n compares independent results: two recordings, or two instruments.
    """
    others = {(r.task, r.name, r.unit): r for r in second.results}
    found = []
    for r in first.results:
        other = others.get((r.task, r.name, r.unit))
        if other is not None:
            known = r.value, r.expanded_uncertainty, other.value, other.expanded_uncertainty
            found.append((f"{r.task}, {r.name}", normalised_error(*known)))
    return found
