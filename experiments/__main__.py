"""Run one experiment and write beside its results where they came from.

python -m experiments                     the list
python -m experiments 02 --jobs 2         one of them, into results/<its name>
python -m experiments 11 transfer         some steps of one that has steps
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

# Before numpy is imported for the first time: processes, not threads, share the work.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

HERE = Path(__file__).resolve().parent
FOLDERS = {folder.name[:2]: folder for folder in sorted(HERE.glob("[0-9][0-9]_*"))}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the experiment that the arguments name, or list all."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("number", nargs="?", choices=list(FOLDERS), help="which; without it all are listed")
    parser.add_argument("words", nargs="*", metavar="WORD", help="steps, a plan or a folder, where its README says so")
    parser.add_argument("--trials", type=int, help="instead of those of its config.toml")
    parser.add_argument("--jobs", type=int, default=1, help="processes; the results do not depend on it")
    parser.add_argument("--out", type=Path, help="folder of the results; default results/<its name>")
    given = parser.parse_args(arguments)
    if given.number is None:
        sys.stdout.writelines(f"{number}  {_question(folder)}\n" for number, folder in FOLDERS.items())
        return
    from experiments.common import ROOT, Options, write_manifest

    folder = FOLDERS[given.number]
    module = import_module(f"experiments.{folder.name}.run")
    options = Options(given.trials, given.jobs, given.out or ROOT / "results" / folder.name, tuple(given.words))
    write_manifest(folder, options, module.run(options))


def _question(folder: Path) -> str:
    """The first line of what the experiment says of itself."""
    return (folder / "run.py").read_text(encoding="utf-8").partition("\n")[0].strip('"')


if __name__ == "__main__":
    main()
