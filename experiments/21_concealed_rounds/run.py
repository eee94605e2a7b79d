"""Diagnoses of concealed recordings of another simulator: the sealed ones, and those of the present version.

python -m experiments 21 [round-1] [round-2] [round-3]    diagnosed today, all against the truth
python -m experiments 21 round-4                          once its truth is open
"""

import json
import shutil
import sys
from pathlib import Path

from experiments.common import ROOT, Made, Options
from ltsim.core.parallel import run_parallel
from ltsim.diagnosis.diagnose import diagnose
from ltsim.recordings import read
from ltsim.recordings.files import write_text, write_texts

from .score import answers_of, markdown, scored

SHARED = ROOT.parent / "shared" / "concealed"
COMMITTED = ROOT / "results" / "concealed"
"""Diagnoses from the time when the truth was sealed; they are never written again."""
TODAY = ROOT / "build" / "concealed-rounds"
ROUNDS = ("round-1", "round-2", "round-3", "round-4")


def examine(folder: Path, out: Path) -> None:
    """Diagnose one recording with default settings, and write it down."""
    diagnosis = diagnose(read(folder))
    text = json.dumps(diagnosis.content(), allow_nan=False) + "\n"
    write_texts(out / folder.name, {"diagnosis.json": text, "targets.csv": diagnosis.table("targets").csv_text()})


def recordings_of(name: str) -> list[Path]:
    """The recordings of a round, which are no part of the project."""
    folder = SHARED if name == "round-1" else SHARED / name
    return sorted(f for f in folder.glob("[A-Z][0-9][0-9]") if (f / "observations.csv").is_file())


def run(given: Options) -> Made:
    """Diagnose rounds with an open truth today, and score both."""
    for name in given.words or ROUNDS[:3]:
        if name not in ROUNDS:
            sys.exit(f"there is no round '{name}'; there are {', '.join(ROUNDS)}")
        folders = recordings_of(name)
        if not (SHARED / f"{name}-truth.json").is_file():
            sys.exit(f"the truth of {name} is sealed; it was diagnosed once, into {COMMITTED / name}")
        shutil.rmtree(TODAY / name, ignore_errors=True)
        list(run_parallel(examine, [(folder, TODAY / name) for folder in folders], given.jobs))
        score_round(name, given.out)
    return Made(seed=0)


def score_round(name: str, out: Path) -> None:
    """A table of one round: as committed, and of today."""
    truth = json.loads((SHARED / f"{name}-truth.json").read_text(encoding="utf-8"))
    sets = {"as committed, sealed": answers_of(COMMITTED / name), "today, truth open": answers_of(TODAY / name)}
    rows = {title: [scored(n, truth[n], answers[n]) for n in sorted(truth)] for title, answers in sets.items()}
    head = f"# Concealed recordings, {name}, against their truth\n\n    python -m experiments 21 {name}\n\n"
    write_text(out / f"{name}.md", head + markdown(rows))
