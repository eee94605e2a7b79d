"""Diagnoses of concealed recordings of another simulator: the sealed ones, and those of the present version.

python -m experiments 21 [round-1] [round-2] [round-3]    diagnose with the present version, and score both versions
python -m experiments 21 round-4                          the same, after the truth of round 4 has been published
"""

import json
import shutil
import sys
from pathlib import Path

from experiments.common import ROOT, Options, RunRecord
from ltsim.core.parallel import run_parallel
from ltsim.diagnosis.diagnose import diagnose
from ltsim.recordings import read
from ltsim.recordings.files import write_text, write_texts

from .score import answers_of, markdown, score_recording

SHARED_FOLDER = ROOT.parent / "shared" / "concealed"
COMMITTED_FOLDER = ROOT / "results" / "concealed"
"""Diagnoses that were made while the truth was sealed; they are never written again."""
TODAY = ROOT / "build" / "concealed-rounds"
ROUNDS = ("round-1", "round-2", "round-3", "round-4")


def examine(folder: Path, out: Path) -> None:
    """Diagnose one recording with default settings, and write the diagnosis."""
    diagnosis = diagnose(read(folder))
    content = json.dumps(diagnosis.content(), allow_nan=False) + "\n"
    write_texts(out / folder.name, {"diagnosis.json": content, "targets.csv": diagnosis.table("targets").csv_text()})


def recordings_of(name: str) -> list[Path]:
    """Folders of the recordings of a round, which the repository does not contain."""
    folder = SHARED_FOLDER if name == "round-1" else SHARED_FOLDER / name
    return sorted(f for f in folder.glob("[A-Z][0-9][0-9]") if (f / "observations.csv").is_file())


def run(options: Options) -> RunRecord:
    """Diagnose rounds with public truth with the present version, and score these and the committed diagnoses."""
    for name in options.arguments or ROUNDS[:3]:
        if name not in ROUNDS:
            sys.exit(f"round '{name}' does not exist; choose from {', '.join(ROUNDS)}")
        folders = recordings_of(name)
        if not (SHARED_FOLDER / f"{name}-truth.json").is_file():
            sys.exit(f"the truth of {name} is sealed; the committed diagnoses are in {COMMITTED_FOLDER / name}")
        shutil.rmtree(TODAY / name, ignore_errors=True)
        list(run_parallel(examine, [(folder, TODAY / name) for folder in folders], options.jobs))
        score_round(name, options.out)
    return RunRecord(seed=0)


def score_round(name: str, out: Path) -> None:
    """Write the table of one round: committed diagnoses, and diagnoses of the present version."""
    truth = json.loads((SHARED_FOLDER / f"{name}-truth.json").read_text(encoding="utf-8"))
    sets = {"as committed, sealed": answers_of(COMMITTED_FOLDER / name), "today, truth open": answers_of(TODAY / name)}
    rows = {title: [score_recording(n, truth[n], answers[n]) for n in sorted(truth)] for title, answers in sets.items()}
    head = f"# Concealed recordings, {name}, against their truth\n\n    python -m experiments 21 {name}\n\n"
    write_text(out / f"{name}.md", head + markdown(rows))
