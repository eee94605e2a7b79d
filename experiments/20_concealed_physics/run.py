"""Concealed physics: diagnoses of recordings without any information about the error that they contain.

python -m experiments 20 [PLAN] [ENTRANT ...]    run the plan `plans/PLAN.toml`; default: plan quick, program ltsim
python -m experiments 20 PLAN tables             write tables and figures of the committed rows again
"""

import json
from pathlib import Path

from experiments.common import ROOT, Options, RunRecord, commit, write_figure
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure

from . import entrants, make
from .__main__ import plan_file, score
from .report import QUESTIONS, Answer, rewrite_report

WORK = ROOT / "build" / "concealed"  # recordings, truth and answers, from which an interrupted run continues
DRAWN_QUESTIONS = {
    "detected": "detected",
    "place": "place",
    "observable": "observable",
    "covariates_or_outside": "covariates",
}


def run(options: Options) -> RunRecord:
    """Make the recordings of a plan, run the programs, and add their scores to the table."""
    name, *names = options.arguments or ("quick",)
    cases, work, folder = make.read_plan(plan_file(name)), WORK / name, options.out / name
    file = folder / "manifest.json"
    earlier = json.loads(file.read_text(encoding="utf-8"))["answered_at"] if file.is_file() else {}
    if names == ["tables"]:
        rewrite_report(folder)
        draw(folder)
        return RunRecord(seed=cases[0].seed, folder=folder, entries={"answered_at": earlier})
    seal = make.make(cases, work, options.jobs)
    able = [entrant for entrant in names or ["ltsim"] if entrants.answer(work, entrant, jobs=options.jobs)]
    score(work, able, folder, name)
    draw(folder)
    answered = {entrant: answer for entrant, answer in earlier.items() if answer["truth_sha256"] == seal}
    answered |= {entrant: {"commit": commit(), "truth_sha256": seal} for entrant in able}
    return RunRecord(seed=cases[0].seed, folder=folder, entries={"answered_at": answered})


def draw(folder: Path) -> None:
    """Draw the scores of the first program and the target errors of all programs, for laws in small halls."""
    summaries = json.loads((folder / "scores.json").read_text(encoding="utf-8"))["entrants"]
    first = next(iter(summaries))
    reports = [
        p for key, label in DRAWN_QUESTIONS.items() for p in points(summaries[first], QUESTIONS[key], label, first)
    ]
    errors = [p for level in ("median", "95 %") for who, answers in summaries.items()
              for p in points(answers, f"error of targets over that given the law, {level}", who, level)]  # fmt: skip
    axis = "noncentrality after the adjustment"
    if reports:
        write_figure(
            folder / "reports.svg",
            sweep_panels_figure(reports, statistic_title="fraction of recordings [%]", x_title=axis),
        )
        figure = sweep_panels_figure(errors, statistic_title="target error over that given the law", x_title=axis)
        figure.axes[0].set(yscale="log", yticks=(ticks := (1, 2, 5, 10, 20, 50)), yticklabels=ticks)
        write_figure(folder / "targets.svg", figure)


def points(answers: dict[str, Answer], question: str, line: str, panel: str) -> list[SweepPoint]:
    """Points of a question as a function of the strength; proportions in percent."""
    points_of_question = []
    for title, a in answers.items():
        place, _, asked_question = title.partition(": ")
        if place.startswith("unknown hall") and asked_question == question and a["total"]:
            middle, unit = ("value", 1.0) if "value" in a else ("proportion", 100.0)
            ends = (unit * a[key] for key in (middle, "low", "high", middle, middle))
            points_of_question.append(SweepPoint(place.split()[2], line, panel, *ends))
    return points_of_question
