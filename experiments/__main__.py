"""Run one experiment and write beside its results where they came from.

python -m experiments                     the list
python -m experiments 02 --jobs 2         one of them, into results/<its name>
python -m experiments 11 transfer         some steps of one that has steps
python -m experiments all                 those of all.toml one after another; goes on where it was broken off
"""

import argparse
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

# Before numpy is imported for the first time: processes, not threads, share the work.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "results"
LIST = HERE / "all.toml"
MARKS = HERE.parent / "build" / "experiments"
"""What `all` has done, by commit."""
FOLDERS = {folder.name[:2]: folder for folder in sorted(HERE.glob("[0-9][0-9]_*"))}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiment that the arguments name, or list all."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("number", nargs="?", choices=["all", *FOLDERS], help="which; without it all are listed")
    parser.add_argument("words", nargs="*", metavar="WORD", help="steps, a plan or a round, where its README says so")
    parser.add_argument("--trials", type=int, help="instead of those of its config.toml")
    parser.add_argument("--jobs", type=int, default=1, help="processes; the results do not depend on it")
    parser.add_argument("--out", type=Path, help="folder of the results; default results/<its name>")
    given = parser.parse_args(arguments)
    if given.number is None:
        sys.stdout.writelines(
            f"{number}  {_question(folder)} [{_settings(folder)}]\n" for number, folder in FOLDERS.items()
        )
    elif given.number == "all":
        run_all(given.out or RESULTS, given.jobs)
    else:
        run_experiment(given.number, given.words, given.trials, given.jobs, given.out)


def run_experiment(number: str, words: Sequence[str], trials: int | None, jobs: int, out: Path | None) -> None:
    """Run one experiment, and write beside its results where they came from."""
    from experiments.common import Options, refuse_changes, write_manifest

    folder, needs = FOLDERS[number], line_of(number).get("needs", "")
    if not (HERE.parent / needs).exists():
        sys.exit(f"{number} needs {needs}: recordings of others, which are no part of the project")
    options = Options(folder, trials, jobs, (out or RESULTS / folder.name).resolve(), tuple(words))
    refuse_changes(options.out)
    write_manifest(options, import_module(f"experiments.{folder.name}.run").run(options))


def run_all(out: Path, jobs: int) -> None:
    """Run every line of all.toml in a process of its own; what this commit has made already is left as it is."""
    from experiments.common import changes, commit, refuse_changes

    refuse_changes(out.resolve())
    whole, state = time.perf_counter(), f"{commit()} {bool(changes())} {out}"
    for line in lines_of_all():
        words, folder = [*line["words"]], FOLDERS[line["words"][0]]
        title = f"{' '.join(words)}, about {line['minutes']:g} min"
        if not (HERE.parent / line.get("needs", "")).exists():
            print(f"{title}: left out, {line['needs']} is not beside the project", flush=True)
            continue
        mark = MARKS / out.name / "-".join(words)
        if mark.is_file() and mark.read_text(encoding="utf-8") == state:
            print(f"{title}: made by this commit already", flush=True)
            continue
        start, trials = time.perf_counter(), line.get("trials")
        command = [sys.executable, "-m", "experiments", *words, "--jobs", str(jobs), "--out", str(out / folder.name)]
        done = subprocess.run([*command, *([] if trials is None else ["--trials", str(trials)])], cwd=HERE.parent)
        if done.returncode:
            sys.exit(f"{title}: failed; the same command goes on with it")
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.write_text(state, encoding="utf-8")
        print(f"{title}: took {(time.perf_counter() - start) / 60:.1f} min", flush=True)
    print(f"all took {(time.perf_counter() - whole) / 60:.1f} min", flush=True)


def lines_of_all() -> list[dict[str, Any]]:
    """What `all` runs."""
    with LIST.open("rb") as file:
        entries: list[dict[str, Any]] = tomllib.load(file)["run"]
    return entries


def line_of(number: str) -> dict[str, Any]:
    """What all.toml says of one experiment; nothing of those that run by themselves."""
    return next((line for line in lines_of_all() if line["words"][0] == number), {})


def _question(folder: Path) -> str:
    """The first line of what the experiment says of itself."""
    return (folder / "run.py").read_text(encoding="utf-8").partition("\n")[0].strip('"')


def _settings(folder: Path) -> str:
    """Its TOML files, those of the examination its plans; of one without what it reads instead."""
    files = sorted(f.relative_to(HERE).as_posix() for f in folder.glob("**/*.toml"))
    line = line_of(folder.name[:2])
    return ", ".join(files) or f"reads {line.get('needs') or line['reads']}"


if __name__ == "__main__":
    main()
