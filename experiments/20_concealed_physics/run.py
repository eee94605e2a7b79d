"""Conceal, diagnose in another process, unseal and score.

Example: python experiments/20_concealed_physics/run.py quick --work build/concealed
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from concealed.conceal import conceal  # noqa: E402
from concealed.pictures import draw  # noqa: E402
from concealed.plan import Case, read_plan  # noqa: E402
from concealed.score import Row, score  # noqa: E402
from concealed.tables import markdown, summarise  # noqa: E402
from joblib import Parallel, delayed  # noqa: E402


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", help="name of a plan here (quick, full), or a file")
    parser.add_argument("--work", type=Path, default=Path("build/concealed"), help="recordings, truth and diagnoses")
    parser.add_argument("--out", type=Path, help="folder of the results (default: inside --work)")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only-score", action="store_true", help="score what was diagnosed so far")
    chosen = parser.parse_args()
    file = Path(chosen.plan) if chosen.plan.endswith(".toml") else HERE / f"{chosen.plan}.toml"
    cases = read_plan(file)
    work = chosen.work / file.stem
    if not chosen.only_score:
        Parallel(n_jobs=chosen.jobs)(delayed(conceal)(c, work / "recordings", work / "sealed") for c in cases)
        examine_all([case.name for case in cases], work, chosen.jobs)
    command = f"python experiments/20_concealed_physics/run.py {file.stem} --jobs {chosen.jobs}"
    write_results(unseal(cases, work), chosen.out or work / "results", command)


if __name__ == "__main__":
    main()
