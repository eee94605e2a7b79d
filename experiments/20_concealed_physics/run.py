"""Concealed physics: recordings with something hidden are made, diagnosed by another process, unsealed and scored.

python -m experiments 20 quick            into results/20_concealed_physics/quick, work in build/concealed/quick
python -m experiments 20 eighth score     score what was diagnosed so far
python -m experiments 20 fleet            three trackers on 100 set-ups, one of them off: three cases, or those named
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.common import ROOT, Made, Options, spread_out

from .concealed.conceal import conceal
from .concealed.fleet import CASES, SEED, examine_fleet
from .concealed.pictures import draw
from .concealed.plan import Case, read_plan
from .concealed.score import Row, score
from .concealed.tables import markdown, summarise

HERE = Path(__file__).resolve().parent
WORK = ROOT / "build" / "concealed"
"""Recordings, truth and diagnoses; a run that was broken off goes on from them."""


def examine_all(names: Sequence[str], work: Path, jobs: int) -> None:
    """Diagnose recordings in processes that are given nothing but their folder."""
    worker = HERE / "concealed" / "examine.py"
    command = [sys.executable, str(worker), str(work / "recordings"), str(work / "diagnoses")]
    shares = [list(names[k::jobs]) for k in range(jobs)]
    processes = [subprocess.Popen([*command, *share]) for share in shares if share]
    statuses = [process.wait() for process in processes]
    if any(statuses):
        raise SystemExit("a process that diagnoses has failed")


def unseal(cases: Sequence[Case], work: Path) -> list[Row]:
    """Score what was diagnosed."""
    rows = []
    for case in cases:
        folder = work / "diagnoses" / case.name
        if (folder / "status.json").exists():
            truth = json.loads((work / "sealed" / f"{case.name}.json").read_text(encoding="utf-8"))
            rows.append(score(truth, folder))
    return sorted(rows, key=lambda r: (r["kind"], r["strength"], r["number"]))


def write_results(rows: Sequence[Row], out: Path, command: str) -> None:
    """summary.json, tables.md, recordings.csv and the pictures."""
    out.mkdir(parents=True, exist_ok=True)
    summary = summarise(rows)
    (out / "summary.json").write_text(json.dumps({"command": command, **summary}, indent=1) + "\n", encoding="utf-8")
    (out / "tables.md").write_text(markdown(rows, summary, command), encoding="utf-8")
    draw(rows, summary, out)
    fields = list(dict.fromkeys(key for row in rows for key in row))
    with (out / "recordings.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, fields, lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: _short(v) for k, v in row.items()} for row in rows)


def _short(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value


def run(given: Options) -> Made:
    """Make, diagnose and score the recordings of the plan that is named; with the word `score`, only score."""
    name, only_score = (*given.words, "quick")[0], "score" in given.words[1:]
    if name == "fleet":
        chosen = [case for case in CASES if case in given.words] or list(CASES)
        examine_fleet(chosen, given.out / name)
        return Made(seed=SEED, folder=given.out / name)
    file = HERE / f"{name}.toml"
    if not file.is_file():
        sys.exit(f"there is no plan '{name}'; there are {', '.join(f.stem for f in sorted(HERE.glob('*.toml')))}")
    cases, work = read_plan(file), WORK / name
    if not only_score:
        spread_out(conceal, [(case, work / "recordings", work / "sealed") for case in cases], given.jobs)
        examine_all([case.name for case in cases], work, given.jobs)
    write_results(unseal(cases, work), given.out / name, f"python -m experiments 20 {name}")
    return Made(seed=cases[0].seed, folder=given.out / name)
