"""Concealed physics: is the diagnosis right when nobody tells it what is wrong? Made, answered, unsealed and scored.

python -m experiments 20 [PLAN] [ENTRANT ...]    a plan of `plans/`, quick by default; ltsim by default
"""

from experiments.common import ROOT, Made, Options

from . import entrants, make
from .__main__ import plan_file, score

WORK = ROOT / "build" / "concealed"
"""Recordings, truth and answers; a run that was broken off goes on from them."""


def run(given: Options) -> Made:
    """Make the recordings of a plan, let the entrants answer, score them."""
    name, *names = given.words or ("quick",)
    cases, work = make.read_plan(plan_file(name)), WORK / name
    seal = make.make(cases, work, given.jobs)
    for entrant in names or ["ltsim"]:
        entrants.answer(work, entrant, jobs=given.jobs)
    score(work, list(names) or ["ltsim"], given.out / name, name)
    return Made(seed=cases[0].seed, folder=given.out / name, more={"truth_sha256": seal})
