"""Examination of programs that diagnose laser-tracker networks; RULES.md contains the rules.

python -m experiments.20_concealed_physics laws [FILE ...]              try laws: size at strength 100, responses, place
python -m experiments.20_concealed_physics make PLAN WORK               write recordings and sealed truth
python -m experiments.20_concealed_physics answer WORK ENTRANT          run ltsim, plain, snooping, huber, gama or ideal
python -m experiments.20_concealed_physics answer WORK NAME --command 'CMD {recording} {out}'
python -m experiments.20_concealed_physics score WORK ENTRANT... --out FOLDER
"""

import argparse
import hashlib
import json
import sys
from collections import Counter
from pathlib import Path

from . import entrants, make
from .law import carriers, laws_of
from .report import write_report
from .score import score_recording

PLANS = Path(__file__).resolve().parent / "plans"


def plan_file(name: str) -> Path:
    """File of a plan, given by its name or path; exit with a message if it does not exist."""
    file = Path(name) if name.endswith(".toml") else PLANS / f"{name}.toml"
    if not file.is_file():
        stems = ", ".join(f.stem for f in sorted(PLANS.glob("*.toml")))
        sys.exit(f"plan '{name}' does not exist; choose from {stems}, or give the path of a .toml file")
    return file


def try_laws(groups: tuple[str, ...]) -> None:
    """Print size at strength 100, responses and place of each law, or the reason if no hall is suitable."""
    for name, law in laws_of(groups or ("fresh",)).items():
        excluded: Counter[str] = Counter()
        case = make.Case(1, "unknown", "hall", name, 100, 0, (law.group,))
        try:
            _, _, cause, change = make.draw_case(case, excluded)
        except RuntimeError as problem:
            print(f"{law.group}  {name}: {problem}; excluded {dict(excluded)}")
            continue
        size = ", ".join(f"{k} up to {float(abs(v).max()):.3g}" for k, v in change.parts.items())
        places = {key: cause.words[key] for key in ("stations", "targets", "instruments")}
        text = f"responses {', '.join(carriers(change))}; depends on {law.follows}; at {places}"
        print(f"{law.group}  {name}: {size}; {text}; excluded {dict(excluded)}")


def score(work_folder: Path, names: list[str], out: Path, plan: str) -> None:
    """Score programs, and print the table; exit with a message if the checksum of the truth is wrong.

    Programs that were scored earlier into the same folder stay in its table.
    """
    text = (work_folder / make.TRUTH).read_bytes()
    seal = (work_folder / make.SEAL).read_text(encoding="utf-8").split()[0]
    if hashlib.sha256(text).hexdigest() != seal:
        sys.exit(f"the checksum of {work_folder / make.TRUTH} differs from {work_folder / make.SEAL} ({seal})")
    truth = json.loads(text).values()
    rows = {}
    for name in names:
        done = [t for t in truth if (work_folder / "answers" / name / t["name"] / entrants.STATUS).is_file()]
        if not done:
            sys.exit(f"{work_folder} contains no answers of '{name}'; run the step `answer` first")
        rows[name] = [score_recording(t, work_folder / "answers" / name / t["name"]) for t in done]
    excluded = sum(sum(t["excluded"].values()) for t in truth)
    write_report(rows, out, {"plan": plan, "sha256": seal, "recordings": len(truth), "draws_excluded": excluded})
    print((out / "table.md").read_text(encoding="utf-8"))


def main(arguments: list[str] | None = None) -> None:
    """Run one step of an examination."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("laws", "make", "answer", "score"))
    parser.add_argument("words", nargs="*")
    parser.add_argument("--command", default="", help="a program that writes diagnosis.json and targets.csv into {out}")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes; the results do not depend on it")
    parser.add_argument("--out", type=Path, help="folder of the scores; default WORK/scores")
    parsed = parser.parse_args(arguments)
    least = {"laws": 0, "make": 2, "answer": 2, "score": 2}[parsed.step]
    if len(parsed.words) < least:
        parser.error(f"the step {parsed.step} needs at least {least} arguments; see --help")
    first, *others = parsed.words or [""]
    if parsed.step == "laws":
        try_laws(tuple(parsed.words))
    elif parsed.step == "make":
        print("sha256 of the truth:", make.make(make.read_plan(plan_file(first)), Path(others[0]), parsed.jobs))
    elif parsed.step == "answer":
        if not parsed.command and others[0] not in entrants.ENTRANTS:
            names = ", ".join(entrants.ENTRANTS)
            sys.exit(f"program '{others[0]}' does not exist; choose from {names}, or give its --command")
        entrants.answer(Path(first), others[0], parsed.command, parsed.jobs)
    else:
        score(Path(first), others, parsed.out or Path(first) / "scores", Path(first).name)


if __name__ == "__main__":
    main()
