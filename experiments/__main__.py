"""Run experiments, and write a manifest (command, versions, commit) with the results.

python -m experiments                     list of all experiments
python -m experiments 02 --jobs 2         run experiment 02; results are written to results/<name of the experiment>
python -m experiments 11 transfer         run only the step `transfer` of experiment 11
python -m experiments all                 run all lines of all.toml in order; a second call continues an interrupted run
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

# Set before the first import of numpy: the work is distributed over processes, each with one thread.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "results"
LIST = HERE / "all.toml"
MARKS = HERE.parent / "build" / "experiments"
"""Folder with a mark file for each finished line of all.toml; the file contains the commit."""
FOLDERS = {folder.name[:2]: folder for folder in sorted(HERE.glob("[0-9][0-9]_*"))}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiment that is named by the command-line arguments, or list all experiments."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "number", nargs="?", choices=["all", *FOLDERS], help="number of the experiment; default: list all experiments"
    )
    parser.add_argument("words", nargs="*", metavar="WORD", help="steps, plan or round (README of the experiment)")
    parser.add_argument("--trials", type=int, help="number of trials; default: as in config.toml")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes; the results do not depend on it")
    parser.add_argument("--out", type=Path, help="folder of the results; default results/<name of the experiment>")
    parsed = parser.parse_args(arguments)
    if parsed.number is None:
        sys.stdout.writelines(
            f"{number}  {_question(folder)} [{_settings(folder)}]\n" for number, folder in FOLDERS.items()
        )
    elif parsed.number == "all":
        run_all(parsed.out or RESULTS, parsed.jobs)
    else:
        run_experiment(parsed.number, parsed.words, parsed.trials, parsed.jobs, parsed.out)


def run_experiment(number: str, words: Sequence[str], trials: int | None, jobs: int, out: Path | None) -> None:
    """Run one experiment, and write a manifest (command, versions, commit) with its results."""
    from experiments.common import Options, require_committed_sources, write_manifest

    folder, needs = FOLDERS[number], line_of(number).get("needs", "")
    if not (HERE.parent / needs).exists():
        sys.exit(f"experiment {number} needs the folder {needs}, which the repository does not contain")
    options = Options(folder, trials, jobs, (out or RESULTS / folder.name).resolve(), tuple(words))
    require_committed_sources(options.out)
    write_manifest(options, import_module(f"experiments.{folder.name}.run").run(options))


def run_all(out: Path, jobs: int) -> None:
    """Run every line of all.toml in a separate process, except lines that this commit has finished already."""
    from experiments.common import commit, require_committed_sources, uncommitted_changes

    require_committed_sources(out.resolve())
    begin, state = time.perf_counter(), f"{commit()} {bool(uncommitted_changes())} {out}"
    for line in lines_of_all():
        words, folder = [*line["words"]], FOLDERS[line["words"][0]]
        title = f"{' '.join(words)}, about {line['minutes']:g} min"
        if not (HERE.parent / line.get("needs", "")).exists():
            print(f"{title}: skipped, because the folder {line['needs']} does not exist", flush=True)
            continue
        mark = MARKS / out.name / "-".join(words)
        if mark.is_file() and mark.read_text(encoding="utf-8") == state:
            print(f"{title}: skipped, because it was run at this commit already", flush=True)
            continue
        start, trials = time.perf_counter(), line.get("trials")
        command = [sys.executable, "-m", "experiments", *words, "--jobs", str(jobs), "--out", str(out / folder.name)]
        process = subprocess.run([*command, *([] if trials is None else ["--trials", str(trials)])], cwd=HERE.parent)
        if process.returncode:
            sys.exit(f"{title}: failed; repeat the command to continue with this line")
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.write_text(state, encoding="utf-8")
        print(f"{title}: took {(time.perf_counter() - start) / 60:.1f} min", flush=True)
    print(f"all took {(time.perf_counter() - begin) / 60:.1f} min", flush=True)


def lines_of_all() -> list[dict[str, Any]]:
    """Entries `[[run]]` of all.toml: arguments, expected minutes, and optionally trials and required folder."""
    with LIST.open("rb") as file:
        entries: list[dict[str, Any]] = tomllib.load(file)["run"]
    return entries


def line_of(number: str) -> dict[str, Any]:
    """Entry of all.toml for one experiment; empty if `all` does not run the experiment."""
    return next((line for line in lines_of_all() if line["words"][0] == number), {})


def _question(folder: Path) -> str:
    """First line of the docstring of an experiment's `run.py`, which is its title."""
    return (folder / "run.py").read_text(encoding="utf-8").partition("\n")[0].strip('"')


def _settings(folder: Path) -> str:
    """TOML files of an experiment, or a text with the data that an experiment without TOML files reads."""
    files = sorted(f.relative_to(HERE).as_posix() for f in folder.glob("**/*.toml"))
    line = line_of(folder.name[:2])
    return ", ".join(files) or f"reads {line.get('needs') or line['reads']}"


if __name__ == "__main__":
    main()
