"""Functions that all experiments use: options, campaigns, tables, figures and manifests."""

import csv
import json
import platform
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import ltsim as lt
from ltsim.campaigns import spec
from ltsim.campaigns.results import CampaignResults, PairedDifferences
from ltsim.campaigns.spec import CampaignCell, CampaignFile, load_campaign
from ltsim.reports.style import svg_text

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
RECORDINGS = ROOT.parent / "shared" / "recordings"
"""Folder of published recordings of other authors, which the repository of ltsim does not contain."""
PACKAGES = ("ltsim", "numpy", "scipy", "numba")
Row = dict[str, Any]
NEW_POINTS = "rms error of new points [µm]"
ERROR = "new_point_error_calibrated_um"


@dataclass(frozen=True)
class Options:
    """Options of one run of an experiment.

    The options are the folder of the experiment, the number of trials (None: as in `config.toml`), the number of
    processes, the folder of the results, and further command-line arguments (steps, a plan or a round).
    """

    folder: Path
    trials: int | None
    jobs: int
    out: Path
    arguments: tuple[str, ...] = ()

    @property
    def config(self) -> dict[str, Any]:
        """Content of the experiment's `config.toml`."""
        return tomllib.loads((self.folder / "config.toml").read_text(encoding="utf-8"))

    @property
    def campaign_changes(self) -> dict[str, Any]:
        """Keys of a campaign file that the command line overrides, with their values."""
        return {} if self.trials is None else {"trials": self.trials}


@dataclass(frozen=True)
class RunRecord:
    """Entries of the manifest that an experiment provides: seed, number of trials, and further entries.

    `folder` is the folder of the results if it is not `Options.out` itself.
    """

    seed: int | None = None
    trials: int | None = None
    entries: Mapping[str, Any] = field(default_factory=dict)
    folder: Path | None = None


def batches(trials: int, width: int = 250) -> Iterator[tuple[int, int]]:
    """Number (from 0) and width of each batch of at most `width` trials; the number seeds the draws of a batch."""
    for number in range(-(-trials // width)):
        yield number, min(width, trials - number * width)


def cells_of(options: Options) -> tuple[CampaignFile, Sequence[CampaignCell]]:
    """Campaign of an experiment's `config.toml`, and the cells of the campaign."""
    file = options.folder / "config.toml"
    campaign_file, scenarios = load_campaign(file, options.campaign_changes)
    return campaign_file, spec.make_campaign_cells(campaign_file, scenarios, file)[1]


def campaign(file: str, options: Options, name: str = "", **changes: Any) -> CampaignResults:
    """Results of an experiment's campaign file, which is run first.

    The rows are written as Parquet files to the folder `name` (default: name of the file) of the results, with
    `summary.csv`. `changes` are values that replace those of the file, by dotted key with `__` for a dot.
    """
    folder = options.out / (name or Path(file).stem)
    overrides = {key.replace("__", "."): value for key, value in changes.items()} | options.campaign_changes
    results = lt.campaign(options.folder / file, out=folder, jobs=options.jobs, force=True, changes=overrides)
    results.to_dataframe().to_csv(folder / "summary.csv", index=False, float_format="%.6g")
    print_line(f"{folder.name}: {len(results.levels)} cells, {results.manifest.trials} trials")
    return results


def summary(values: pd.Series, digits: int = 2) -> Row:
    """Mean with its 95 % confidence interval, and 5 %, 50 % and 95 % quantiles of the finite values."""
    finite = values[np.isfinite(values)].to_numpy()
    mean, half = (
        float(finite.mean()),
        1.96 * float(finite.std(ddof=1)) / np.sqrt(len(finite)) if len(finite) > 1 else np.nan,
    )
    five, middle, ninety_five = np.percentile(finite, [5, 50, 95])
    row = {"mean": mean, "low": mean - half, "high": mean + half, "p5": five, "median": middle, "p95": ninety_five}
    return {name: round(float(value), digits) for name, value in row.items()} | {"trials": len(finite)}


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write rows to a CSV file, numbers with six digits, columns in the order of their first appearance."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: float(f"{v:.6g}") if isinstance(v, float) else v for k, v in row.items()})


def write_paired_differences(path: Path, *pairs: PairedDifferences) -> None:
    """Write the differences of pairs of cells or methods, on the same draws, to one CSV file."""
    pd.concat([pair.to_dataframe() for pair in pairs]).to_csv(path, index=False)


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure to an SVG file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(svg_text(figure), encoding="utf-8")


def require_committed_sources(out: Path) -> None:
    """Exit with a message if sources are not committed and `out` is in the results folder of the repository."""
    changed = uncommitted_changes()
    if changed and RESULTS in (out, *out.parents):
        files = ", ".join(line.split()[-1] for line in changed.splitlines()[:3])
        sys.exit(f"the sources are not committed ({files}, ...); commit them, or choose another folder with --out")


def uncommitted_changes() -> str | None:
    """Sources that differ from the commit, in the format of `git status --porcelain`; None if there are none."""
    return _git("status", "--porcelain", "--", "ltsim", "experiments", "benchmarks", "pyproject.toml")


def write_manifest(options: Options, record: RunRecord) -> None:
    """Write ``manifest.json``: command, seed, trials, versions, commit, and the TOML files of the experiment."""
    trials = [] if record.trials is None else ["--trials", str(record.trials)]
    words = [options.folder.name[:2], *options.arguments, *trials]
    settings = {f.name: f.read_text(encoding="utf-8") for f in sorted(options.folder.glob("*.toml"))}
    details = {"seed": record.seed, "trials": record.trials, "settings": settings, **record.entries}
    folder = record.folder or options.out
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(manifest(" ".join(["python -m experiments", *words]), **details), indent=1) + "\n"
    steps = options.arguments if record.folder is None else ()  # each step has its own manifest in a common folder
    (folder / f"manifest{'-'.join(['', *steps])}.json").write_text(text, encoding="utf-8")


def manifest(command: str, **details: Any) -> dict[str, Any]:
    """Entries of a manifest: command, versions, commit, and True if the sources differ from the commit."""
    versions = {"python": platform.python_version()} | {name: version(name) for name in PACKAGES}
    sources = {"commit": commit(), "uncommitted_changes": bool(uncommitted_changes())}
    return {"command": command, "versions": versions} | sources | details


def commit() -> str | None:
    """Hash of the commit that is checked out; None outside a git repository."""
    return _git("rev-parse", "HEAD")


def _git(*words: str) -> str | None:
    """Output of a git command in this checkout; None if it is empty or the command fails."""
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or None if done.returncode == 0 else None


def run_steps(options: Options, steps: Mapping[str, Callable[[Path], None]]) -> None:
    """Run the steps that the command line names, or all steps; exit with a message if a step does not exist."""
    for word in options.arguments:
        if word not in steps:
            sys.exit(f"step '{word}' does not exist; choose from {', '.join(steps)}")
    options.out.mkdir(parents=True, exist_ok=True)
    for step in options.arguments or steps:
        steps[step](options.out)


def show_table(path: Path, rows: Sequence[Row]) -> None:
    """Write rows to a CSV file, and print them."""
    write_table(path, rows)
    print_line("\n".join([f"\n{path.name}", *("  " + "  ".join(f"{k} {v}" for k, v in row.items()) for row in rows)]))


def print_line(text: str) -> None:
    """Print a line immediately."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
