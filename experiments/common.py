"""What the experiments share: options, campaigns and their figures, tables, manifests."""

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
"""Of others: no part of the project."""
USED = ("ltsim", "numpy", "scipy", "numba")
Row = dict[str, Any]
NEW_POINTS = "rms error of new points [µm]"
ERROR = "new_point_error_calibrated_um"


@dataclass(frozen=True)
class Options:
    """How an experiment is run: its folder, number of trials, processes, folder of the results, further words."""

    here: Path
    trials: int | None
    jobs: int
    out: Path
    words: tuple[str, ...] = ()

    @property
    def config(self) -> dict[str, Any]:
        """Its `config.toml`."""
        return tomllib.loads((self.here / "config.toml").read_text(encoding="utf-8"))

    @property
    def changes(self) -> dict[str, Any]:
        """What the command changes in a campaign file."""
        return {} if self.trials is None else {"trials": self.trials}


@dataclass(frozen=True)
class Made:
    """What an experiment tells of its results: seed and trials, and whatever else belongs into the manifest.

    `folder` is where they lie, if not directly in the folder that was asked for.
    """

    seed: int | None = None
    trials: int | None = None
    more: Mapping[str, Any] = field(default_factory=dict)
    folder: Path | None = None


def batches(trials: int, width: int = 250) -> Iterator[tuple[int, int]]:
    """Number and width of the blocks that make up so many trials; a block is drawn by its number."""
    for number in range(-(-trials // width)):
        yield number, min(width, trials - number * width)


def cells_of(given: Options) -> tuple[CampaignFile, Sequence[CampaignCell]]:
    """The campaign of an experiment's `config.toml` with its cells."""
    file = given.here / "config.toml"
    campaign_file, scenarios = load_campaign(file, given.changes)
    return campaign_file, spec.make_campaign_cells(campaign_file, scenarios, file)[1]


def campaign(file: str, given: Options, name: str = "", **changes: Any) -> CampaignResults:
    """Run an experiment's campaign file; its rows are kept as Parquet below the results, and `summary.csv` with them.

    `changes` are new values of keys of the file, by dotted key with `__` for a dot; `name` is that of their folder.
    """
    folder = given.out / (name or Path(file).stem)
    other = {key.replace("__", "."): value for key, value in changes.items()} | given.changes
    results = lt.campaign(given.here / file, out=folder, jobs=given.jobs, force=True, changes=other)
    results.to_dataframe().to_csv(folder / "summary.csv", index=False, float_format="%.6g")
    tell(f"{folder.name}: {len(results.levels)} cells, {results.manifest.trials} trials")
    return results


def summary(values: pd.Series, digits: int = 2) -> Row:
    """Mean with its 95 % confidence interval, and the middle 90 % of the trials."""
    finite = values[np.isfinite(values)].to_numpy()
    mean, half = (
        float(finite.mean()),
        1.96 * float(finite.std(ddof=1)) / np.sqrt(len(finite)) if len(finite) > 1 else np.nan,
    )
    five, middle, ninety_five = np.percentile(finite, [5, 50, 95])
    row = {"mean": mean, "low": mean - half, "high": mean + half, "p5": five, "median": middle, "p95": ninety_five}
    return {name: round(float(value), digits) for name, value in row.items()} | {"trials": len(finite)}


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """A CSV table, numbers with six digits; columns in the order in which they first appear."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: float(f"{v:.6g}") if isinstance(v, float) else v for k, v in row.items()})


def write_pairs(path: Path, *pairs: PairedDifferences) -> None:
    """Differences on the same draws as one CSV table."""
    pd.concat([pair.to_dataframe() for pair in pairs]).to_csv(path, index=False)


def write_figure(path: Path, figure: Figure) -> None:
    """An SVG file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(svg_text(figure), encoding="utf-8")


def refuse_changes(out: Path) -> None:
    """Leave with a word where results are to be committed that no commit could have made."""
    changed = changes()
    if changed and RESULTS in (out, *out.parents):
        files = ", ".join(line.split()[-1] for line in changed.splitlines()[:3])
        sys.exit(f"the sources are not committed ({files}, ...): commit them first, or name another folder with --out")


def changes() -> str | None:
    """Sources that differ from the commit."""
    return _git("status", "--porcelain", "--", "ltsim", "experiments", "benchmarks", "pyproject.toml")


def write_manifest(given: Options, made: Made) -> None:
    """``manifest.json``: command, seed, trials, versions, commit, and the experiment's files of settings."""
    words = [given.here.name[:2], *given.words, *([] if made.trials is None else ["--trials", str(made.trials)])]
    settings = {f.name: f.read_text(encoding="utf-8") for f in sorted(given.here.glob("*.toml"))}
    details = {"seed": made.seed, "trials": made.trials, "settings": settings, **made.more}
    folder = made.folder or given.out
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(manifest(" ".join(["python -m experiments", *words]), **details), indent=1) + "\n"
    steps = given.words if made.folder is None else ()  # steps of a whole have manifests of their own
    (folder / f"manifest{'-'.join(['', *steps])}.json").write_text(text, encoding="utf-8")


def manifest(command: str, **more: Any) -> dict[str, Any]:
    """Where results come from: command, versions, commit, and whether its sources had been changed."""
    versions = {"python": platform.python_version()} | {name: version(name) for name in USED}
    made = {"command": command, "versions": versions, "commit": commit(), "uncommitted_changes": bool(changes())}
    return made | more


def commit() -> str | None:
    """The commit that is checked out."""
    return _git("rev-parse", "HEAD")


def _git(*words: str) -> str | None:
    """What git says of this checkout; None where it is none."""
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or None if done.returncode == 0 else None


def run_steps(given: Options, steps: Mapping[str, Callable[[Path], None]]) -> None:
    """Run the steps that were named, or all; leaves with a word where there is no such step."""
    for word in given.words:
        if word not in steps:
            sys.exit(f"there is no step '{word}'; there are {', '.join(steps)}")
    given.out.mkdir(parents=True, exist_ok=True)
    for step in given.words or steps:
        steps[step](given.out)


def show_table(path: Path, rows: Sequence[Row]) -> None:
    """Write a table, and print it for whoever waits."""
    write_table(path, rows)
    tell("\n".join([f"\n{path.name}", *("  " + "  ".join(f"{k} {v}" for k, v in row.items()) for row in rows)]))


def tell(text: str) -> None:
    """A line for whoever waits."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
