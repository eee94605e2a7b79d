"""Diagnose a folder of concealed recordings with default settings and keep the diagnoses.

python experiments/21_concealed_round_1/run.py ../shared/concealed --out results/concealed/round-1
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from joblib import Parallel, delayed

from ltsim.diagnose import diagnose
from ltsim.diagnose.files import adjusted_targets_csv
from ltsim.recording import read
from ltsim.recording.files import write_text, write_texts

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
        "targets.csv": adjusted_targets_csv(found.adjusted, found.baseline),
    }
    write_texts(out / folder.name, texts)
    before, after = found.before, found.after
    fit = f"{before.chi2 / before.dof:.3f} to {after.chi2 / after.dof:.3f}"
    held_out = f"{before.held_out_rms:.3f} to {after.held_out_rms:.3f}"
    head = f"| {folder.name} | {found.verdict} | {found.search_p_value:.2g} |"
    if not found.findings:
        return f"{head} | | | | {fit} | {held_out} |\n"
    rows = []
    for finding in found.findings:
        where = finding.where
        place = ", ".join((*where.stations, *where.targets, *where.observables)) or "everywhere"
        others = ", ".join(name for name, _ in finding.equivalents)
        name, probability = finding.effect, finding.evidence.probability
        rows.append(f"{head} {name} | {place} | {probability:.2f} | {others} | {fit} | {held_out} |\n")
        head, fit, held_out = "| | | |", "", ""
    return "".join(rows)


def main() -> None:
    """Read the arguments, diagnose, write the table."""
    parser = argparse.ArgumentParser(description="Diagnose a folder of concealed recordings.")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    chosen = parser.parse_args()
    folders = sorted(f for f in chosen.recordings.iterdir() if (f / "observations.csv").is_file())
    rows = Parallel(n_jobs=chosen.jobs)(delayed(examine)(folder, chosen.out) for folder in folders)
    command = "python experiments/21_concealed_round_1/run.py ../shared/concealed --out results/concealed/round-1"
    title = f"# Verdicts on concealed recordings, default settings\n\n    {command}\n\n"
    write_text(chosen.out / "verdicts.md", title + HEADER + RULE + "".join(rows))


if __name__ == "__main__":
    main()
