"""An examination for programs that diagnose laser-tracker networks; the rules are in RULES.md.

python -m experiments.20_concealed_physics laws [FILE ...]              try laws: does each act, and can it be seen?
python -m experiments.20_concealed_physics make PLAN WORK               recordings and sealed truth
python -m experiments.20_concealed_physics answer WORK ENTRANT          ltsim, plain, snooping, huber
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
    """The file of a plan by its name or path."""
    file = Path(name) if name.endswith(".toml") else PLANS / f"{name}.toml"
    if not file.is_file():
        sys.exit(f"there is no plan '{name}'; there are {', '.join(f.stem for f in sorted(PLANS.glob('*.toml')))}")
    return file


def try_laws(groups: tuple[str, ...]) -> None:
    """Draw each law of some files at a strength of 100; say its size, what it turns, or why no hall was found."""
    for name, law in laws_of(groups or ("fresh",)).items():
        excluded: Counter[str] = Counter()
        case = make.Case(1, "unknown", "hall", name, 100, 0, (law.group,))
        try:
            _, _, cause, change = make.drawn(case, excluded)
        except RuntimeError as problem:
            print(f"{law.group}  {name}: {problem}; excluded {dict(excluded)}")
            continue
        size = ", ".join(f"{k} up to {float(abs(v).max()):.3g}" for k, v in change.parts.items())
        places = {key: cause.words[key] for key in ("stations", "targets", "instruments")}
        words = f"turns {', '.join(carriers(change))}; follows {law.follows}; at {places}"
        print(f"{law.group}  {name}: {size}; {words}; excluded {dict(excluded)}")


def score(work: Path, names: list[str], out: Path, plan: str) -> None:
    """Check the seal, score the entrants; those that were scored into the same folder before stay beside them."""
    text = (work / make.TRUTH).read_bytes()
    seal = (work / make.SEAL).read_text(encoding="utf-8").split()[0]
    if hashlib.sha256(text).hexdigest() != seal:
        sys.exit(f"{work / make.TRUTH} is not what was sealed ({seal})")
    truth = json.loads(text).values()
    rows = {}
    for name in names:
        done = [t for t in truth if (work / "answers" / name / t["name"] / entrants.STATUS).is_file()]
        if not done:
            sys.exit(f"'{name}' has answered nothing in {work}")
        rows[name] = [score_recording(t, work / "answers" / name / t["name"]) for t in done]
    excluded = sum(sum(t["excluded"].values()) for t in truth)
    write_report(rows, out, {"plan": plan, "sha256": seal, "recordings": len(truth), "draws_excluded": excluded})
    print((out / "table.md").read_text(encoding="utf-8"))


def main(arguments: list[str] | None = None) -> None:
    """One step of an examination."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("laws", "make", "answer", "score"))
    parser.add_argument("words", nargs="*")
    parser.add_argument("--command", default="", help="a program that writes diagnosis.json and targets.csv into {out}")
    parser.add_argument("--jobs", type=int, default=1, help="processes; the results do not depend on it")
    parser.add_argument("--out", type=Path, help="folder of the scores; default WORK/scores")
    given = parser.parse_args(arguments)
    least = {"laws": 0, "make": 2, "answer": 2, "score": 2}[given.step]
    if len(given.words) < least:
        parser.error(f"{given.step} needs {least} words; see --help")
    first, *others = given.words or [""]
    if given.step == "laws":
        try_laws(tuple(given.words))
    elif given.step == "make":
        print("sha256 of the truth:", make.make(make.read_plan(plan_file(first)), Path(others[0]), given.jobs))
    elif given.step == "answer":
        if not given.command and others[0] not in entrants.ENTRANTS:
            sys.exit(f"there is no entrant '{others[0]}' ({', '.join(entrants.ENTRANTS)}); give its --command")
        entrants.answer(Path(first), others[0], given.command, given.jobs)
    else:
        score(Path(first), others, given.out or Path(first) / "scores", Path(first).name)


if __name__ == "__main__":
    main()
