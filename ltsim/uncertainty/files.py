"""uncertainty.json, uncertainty.csv and budget.csv: what the tasks of a file are worth."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ltsim.errors import RecordError
from ltsim.recording.files import read_text, write_texts
from ltsim.recording.settings import sentence
from ltsim.uncertainty.evaluation import Evaluation, worst_first
from ltsim.uncertainty.verdict import Judgement, normalised_error

FORMAT = "ltsim-uncertainty/1"
JSON, RESULTS, BUDGET = "uncertainty.json", "uncertainty.csv", "budget.csv"


class Table(BaseModel):
    """Base of the file's tables."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class MonteCarloTold(Table):
    """The distribution of a result: mean, standard uncertainty and coverage intervals in its unit (JCGM 101)."""

    mean: float
    standard_uncertainty: float
    symmetric: tuple[float, float]
    shortest: tuple[float, float]
    stable: bool = Field(description="whether the figures are stable to the digits asked for")
    agrees: bool = Field(description="whether the linear interval is that of the distribution (JCGM 101, clause 8)")


class Part(Table):
    """One source of a result's uncertainty: its type, its share of the variance, its standard uncertainty."""

    source: str
    type: Literal["A", "B"]
    share: float
    standard_uncertainty: float


class ConformityTold(Table):
    """A result against its tolerance (JCGM 106), limits and guard band in its unit."""

    lower: float | None
    upper: float | None
    rule: Literal["guarded", "simple"]
    guard_band: float
    probability: float = Field(description="that the true value lies within the tolerance")
    judgement: Judgement
    wrong: float = Field(description="probability that the judgement is wrong")


class Result(Table):
    """One number of a task with its uncertainty, in its unit."""

    task: str
    kind: str
    name: str
    unit: str
    value: float
    standard_uncertainty: float
    coverage_factor: float
    expanded_uncertainty: float
    monte_carlo: MonteCarloTold
    curvature: float = Field(description="gap of the linear adjustment, in standard uncertainties")
    budget: tuple[Part, ...]
    conformity: ConformityTold | None = None


class UncertaintyFile(Table):
    """The whole file."""

    format: Literal["ltsim-uncertainty/1"] = "ltsim-uncertainty/1"
    title: str
    source: str
    coverage: float
    trials: int
    frame: str
    sigma0: float | None = Field(description="of the adjustment that the points come from")
    results: tuple[Result, ...]
    correlation: tuple[tuple[float | None, ...], ...] = Field(description="of the results, in their order")
    warnings: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """``task, result`` of each result."""
        return [f"{r.task}, {r.name}" for r in self.results]


def told(evaluation: Evaluation, frame: str) -> UncertaintyFile:
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
    sigma0 = evaluation.inputs.adjustment.sigma0
    return UncertaintyFile(
        title=tasks.title,
        source=tasks.source,
        coverage=coverage,
        trials=evaluation.drawn.trials,
        frame=frame,
        sigma0=sigma0 if np.isfinite(sigma0) else None,
        results=tuple(results),
        correlation=tuple(
            tuple(float(x) if np.isfinite(x) else None for x in row) for row in np.atleast_2d(linear.correlation)
        ),
        warnings=tuple(evaluation.warnings),
    )


def _pair(ends: Sequence[float]) -> tuple[float, float]:
    return float(ends[0]), float(ends[1])


def write_uncertainty(content: UncertaintyFile, folder: Path) -> None:
    """Write uncertainty.json, uncertainty.csv (a row a result) and budget.csv (a row a result and source).

    Raises
    ------
    RecordError
        When the folder cannot be written; nothing half-written stays behind.
    """
    results: list[list[Any]] = [
        ["task", "result", "unit", "value", "u", "U", "mc_u", "mc_low", "mc_high", "agrees", "judgement"]
    ]
    parts: list[list[Any]] = [["task", "result", "source", "type", "share", "u", "unit"]]
    for r in content.results:
        mc = r.monte_carlo
        figures = (r.value, r.standard_uncertainty, r.expanded_uncertainty, mc.standard_uncertainty, *mc.symmetric)
        judged = r.conformity.judgement if r.conformity else ""
        results.append([r.task, r.name, r.unit, *(f"{x:.9g}" for x in figures), mc.agrees, judged])
        parts += [
            [r.task, r.name, p.source, p.type, f"{p.share:.6f}", f"{p.standard_uncertainty:.6g}", r.unit]
            for p in r.budget
        ]
    text = json.dumps(content.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"
    write_texts(folder, {JSON: text, RESULTS: _csv(results), BUDGET: _csv(parts)})


def _csv(rows: Sequence[Sequence[Any]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue()


def read_uncertainty(path: Path) -> UncertaintyFile:
    """The contents of an uncertainty.json, or of the one in a folder.

    Raises
    ------
    RecordError
        One sentence for whatever is wrong.
    """
    file = path / JSON if path.is_dir() else path
    try:
        return UncertaintyFile.model_validate_json(read_text(file))
    except ValidationError as problem:
        raise RecordError(sentence(problem.errors()[0], UncertaintyFile), file=file) from None


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
