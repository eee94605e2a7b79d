"""Concealed physics: is the diagnosis right when nobody tells it what is wrong? Made, answered, unsealed and scored.

python -m experiments 20 [PLAN] [ENTRANT ...]    a plan of `plans/`, quick by default; ltsim by default
"""

import json
from pathlib import Path

from experiments.common import ROOT, Made, Options, commit, write_figure
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure

from . import entrants, make
from .__main__ import plan_file, score
from .report import QUESTIONS, Answer

WORK = ROOT / "build" / "concealed"  # recordings, truth and answers; a run that was broken off goes on from them
DRAWN = {"found": "found", "place": "place right", "observable": "observable", "covariates_or_outside": "covariates"}


def run(given: Options) -> Made:
    """Make the recordings of a plan, let the entrants answer, score them beside those that are in the table already."""
    name, *names = given.words or ("quick",)
    cases, work, folder = make.read_plan(plan_file(name)), WORK / name, given.out / name
    seal = make.make(cases, work, given.jobs)
    able = [entrant for entrant in names or ["ltsim"] if entrants.answer(work, entrant, jobs=given.jobs)]
    score(work, able, folder, name)
    draw(folder)
    file = folder / "manifest.json"
    earlier = json.loads(file.read_text(encoding="utf-8"))["answered_at"] if file.is_file() else {}
    answered = {entrant: one for entrant, one in earlier.items() if one["truth_sha256"] == seal}
    answered |= {entrant: {"commit": commit(), "truth_sha256": seal} for entrant in able}
    return Made(seed=cases[0].seed, folder=folder, more={"answered_at": answered})


def draw(folder: Path) -> None:
    """Laws in small halls over strength: what the first entrant told of them, and the targets of all entrants."""
    summaries = json.loads((folder / "scores.json").read_text(encoding="utf-8"))["entrants"]
    first = next(iter(summaries))
    told = [p for key, words in DRAWN.items() for p in points(summaries[first], QUESTIONS[key], words, first)]
    errors = [p for level in ("median", "95 %") for who, answers in summaries.items()
              for p in points(answers, f"error of targets over told, {level}", who, level)]  # fmt: skip
    axis = "strength: noncentrality left by least squares"
    if told:
        write_figure(
            folder / "told.svg", sweep_panels_figure(told, statistic_title="share of recordings [%]", x_title=axis)
        )
        figure = sweep_panels_figure(errors, statistic_title="targets' error over told", x_title=axis)
        figure.axes[0].set(yscale="log", yticks=(ticks := (1, 2, 5, 10, 20, 50)), yticklabels=ticks)
        write_figure(folder / "targets.svg", figure)


def points(answers: dict[str, Answer], question: str, line: str, panel: str) -> list[SweepPoint]:
    """A question by strength; shares in percent."""
    found = []
    for asked, a in answers.items():
        place, _, words = asked.partition(": ")
        if place.startswith("unknown hall") and words == question and a["of"]:
            middle, unit = ("value", 1.0) if "value" in a else ("share", 100.0)
            ends = (unit * a[key] for key in (middle, "low", "high", middle, middle))
            found.append(SweepPoint(place.split()[2], line, panel, *ends))
    return found
