"""Concealed recordings of another simulator, diagnosed with default settings.

python -m experiments 21 [FOLDER]     diagnose a folder of recordings
python -m experiments 21 score        score round 1 as it was committed, and as it is diagnosed today
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from experiments.common import ROOT, Made, Options, spread_out
from ltsim.diagnosis import diagnose
from ltsim.diagnosis.files import targets_csv
from ltsim.notation import number
from ltsim.recording import read
from ltsim.recording.files import write_text, write_texts

from .score import write_score

SHARED = ROOT.parent / "shared" / "concealed"
COLUMNS = (".", "again")
"""Folders of the diagnoses that are scored: as they were committed before the truth was open, and made again."""
HEADER = (
    "| recording | verdict | p of the search | finding | where | probability | not excluded | chi2 / dof | held-out |\n"
)
RULE = "|---|---|---|---|---|---|---|---|---|\n"


def examine(folder: Path, out: Path) -> str:
    """Diagnose one recording, write it down; its rows of the table."""
    found = diagnose(read(folder))
    content = found.to_json()
    texts = {
        "diagnosis.json": json.dumps(content, indent=1, allow_nan=False) + "\n",
        "targets.csv": targets_csv(found),
    }
    write_texts(out / folder.name, texts)
    before, after = found.before, found.after
    fit = f"{before.chi2 / before.dof:.3f} to {after.chi2 / after.dof:.3f}"
    held_out = f"{number(before.held_out_rms)} to {number(after.held_out_rms)}"
    head = f"| {folder.name} | {found.verdict} | {found.search_p_value:.2g} |"
    if not found.findings:
        return f"{head} | | | | {fit} | {held_out} |\n"
    rows = []
    for finding in found.findings:
        where = finding.where
        place = ", ".join((*where.stations, *where.targets, *where.observables)) or "everywhere"
        others = ", ".join(other.effect for other in finding.equivalents)
        name, probability = finding.effect, finding.evidence.probability
        rows.append(f"{head} {name} | {place} | {probability:.2f} | {others} | {fit} | {held_out} |\n")
        head, fit, held_out = "| | | |", "", ""
    return "".join(rows)


def run(given: Options) -> Made:
    """Diagnose every recording, write the table."""
    if "score" in given.words:
        write_score(SHARED / "round-1-truth.json", [given.out / name for name in COLUMNS], given.out / "score.md")
        return Made(seed=0, folder=given.out)
    recordings = Path(given.words[0]) if given.words else SHARED
    if not recordings.is_dir():
        sys.exit(f"{recordings} is not there: these recordings are no part of the project")
    folders = sorted(f for f in recordings.iterdir() if (f / "observations.csv").is_file())
    rows = spread_out(examine, [(folder, given.out) for folder in folders], given.jobs)
    title = "# Verdicts on concealed recordings, default settings\n\n    python -m experiments 21\n\n"
    write_text(given.out / "verdicts.md", title + HEADER + RULE + "".join(rows))
    return Made(seed=0, folder=given.out)
