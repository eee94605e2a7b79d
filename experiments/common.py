"""What the experiments share: options, cells of a file, trials of one instrument in two places, tables, manifests."""

from __future__ import annotations

import csv
import json
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from matplotlib.figure import Figure

from ltsim.arrays import Floats
from ltsim.campaigns.calibrators import Calibrator, calibrator_of
from ltsim.campaigns.cell import fitted_construction, truth_of
from ltsim.campaigns.engine import Bench, Calibrated
from ltsim.campaigns.spec import Campaign, Method, load_campaign
from ltsim.campaigns.truth import Block, Truth
from ltsim.evaluation.share_removed import share as share_of
from ltsim.model.construction import Construction
from ltsim.pages.style import svg
from ltsim.simulation.draws import Normal
from ltsim.simulation.scenario import Scenario, load_scenario

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
HELD_OUT = ROOT / "experiments" / "held_out.toml"
"""Another day in the same workshop: stations and reflectors that nobody calibrated with."""
USED = ("ltsim", "numpy", "scipy", "numba")
Row = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """How an experiment is run: number of trials, processes, folder of the results, further words of the command."""

    trials: int | None
    jobs: int
    out: Path
    words: tuple[str, ...] = ()


@dataclass(frozen=True)
class Made:
    """What an experiment tells of its results: seed and trials, and whatever else belongs into the manifest.

    `folder` is where they lie, if not directly in the folder that was asked for.
    """

    seed: int | None = None
    trials: int | None = None
    more: Mapping[str, Any] = field(default_factory=dict)
    folder: Path | None = None


@dataclass(frozen=True)
class Cell:
    """One setting of an experiment: what is true."""

    title: str
    scenario: Scenario


def cells_of(file: Path, trials: int | None = None) -> tuple[Campaign, list[Cell]]:
    """An experiment's file, which is a campaign file: the truth of its cells, named by their titles, and methods."""
    campaign, scenarios = load_campaign(file)
    if trials is not None:
        campaign = campaign.model_copy(update={"trials": trials})
    return campaign, [Cell(scenario.title, scenario) for scenario in scenarios]


def batches(trials: int, width: int = 250) -> Iterator[tuple[int, int]]:
    """Number and width of the blocks that make up so many trials; a block is drawn by its number."""
    for number in range(-(-trials // width)):
        yield number, min(width, trials - number * width)


def spread_out(work: Any, tasks: Sequence[tuple[Any, ...]], jobs: int) -> list[Any]:
    """`work` on every task in order; processes where more than one is asked for."""
    if jobs == 1:
        return [work(*task) for task in tasks]
    return list(Parallel(n_jobs=jobs, inner_max_num_threads=1, backend="loky")(delayed(work)(*task) for task in tasks))


def same_instrument(truth: Truth, values: Floats, seed: int, number: int) -> Block:
    """Trials elsewhere with instruments that are given: noise and effects are drawn, the instrument is not.

    Parameters
    ----------
    truth : Truth
        The other place.
    values : (I, p, B) float [SI]
        True parameters of each trial, of the truth's construction.
    seed, number : int
        Of the draws; another seed than that of the first place, or the noise would be the same.
    """
    return truth.drawn(Normal(seed, number * values.shape[2] + np.arange(values.shape[2])), values)


def calibrated(truth: Truth, calibrator: Calibrator, block: Block) -> tuple[Calibrated, dict[str, Floats]]:
    """A block calibrated and judged: criteria, errors against the truth, share of the correctable error removed."""
    bench = Bench(truth)
    shared = bench.before(block)
    found = calibrator.calibrate(block, np.arange(block.deviation.shape[2]))
    return found, shared | bench.after(block, found, calibrator.construction, calibrator.effects)


def held_out(
    room: Truth, values: Floats, seed: int, number: int, found: Calibrated, construction: Construction
) -> dict[str, Floats]:
    """Rms errors [um] of the same instruments in another room, raw, calibrated and with the true parameters.

    Parameters
    ----------
    room : Truth
    values : (I, p, B) float [SI]
        True parameters of each trial, of the room's construction.
    seed, number : int
        As in `same_instrument`.
    found : Calibrated
    construction : Construction
        That was fitted.
    """
    block, bench = same_instrument(room, values, seed, number), Bench(room)
    shared = bench.before(block)
    elsewhere = replace(found, points=np.zeros((*room.state.points.shape, values.shape[2])))
    after = bench.after(block, elsewhere, construction)
    names = ("error_raw_um", "error_calibrated_um", "error_true_parameters_um")
    return {f"held_out_{name}": (shared | after)[name] for name in names}


def calibrator_for(method: Method, truth: Truth) -> Calibrator:
    """The calibrator of a method; one whose name begins with 'eq. 9' finds the minimum of eq. 9 as printed."""
    if not method.title.startswith("eq. 9"):
        return calibrator_of(method, truth)
    from experiments.printed import Printed  # what few experiments need

    return Printed(truth, fitted_construction(method), method.method)


def with_prior(truth: Truth, factor: float) -> Truth:
    """The same truth where the set-up states every prior so many times as wide."""
    setup = truth.recording.setup
    prior = setup.instrument.prior
    wider = {name: factor * value for name, value in prior.model_dump(exclude={"parameters"}).items()}
    stated = setup.instrument.model_copy(update={"prior": prior.model_copy(update=wider)})
    return replace(truth, recording=truth.recording.replace(setup=setup.model_copy(update={"instrument": stated})))


def compared(
    campaign: Campaign, scenario: Scenario, method: Method, number: int, width: int, *, factor: float = 1.0
) -> dict[str, Floats]:
    """A batch of one cell by one method: at home, in the held-out room with the same instruments, per parameter.

    The set-up states the priors `factor` times as wide as the errors are drawn.

    Besides the columns of `calibrated` and `held_out`: improvements [%], and ``miss:<parameter>``, estimate less
    truth in display units, where the fitted construction is the true one.
    """
    truth = with_prior(truth_of(scenario, campaign.seed, "campaign"), factor)
    room = load_scenario(HELD_OUT).model_copy(update={"instrument": scenario.instrument})
    calibrator = calibrator_for(method, truth)
    block = truth.draw(campaign.seed, number, width)
    found, columns = calibrated(truth, calibrator, block)
    elsewhere = truth_of(room, campaign.seed, "held out")
    columns |= held_out(elsewhere, block.values, campaign.seed + 1, number, found, calibrator.construction)
    for kind in ("distance", "coordinate"):
        gain = 1 - columns[f"{kind}_after_mean_um"] / columns[f"{kind}_before_mean_um"]
        columns[f"{kind}_improvement_percent"] = 100 * gain
    if truth.construction.names == calibrator.construction.names:
        for k, parameter in enumerate(truth.construction.parameters):
            columns[f"miss:{parameter.name}"] = (found.values[0, k] - block.values[0, k]) / parameter.factor
    return columns


def share(columns: Mapping[str, Floats], prefix: str = "") -> float:
    """Share of the correctable mean-square error that was removed, over all trials together."""
    raw, after, perfect = (columns[f"{prefix}error_{name}_um"] for name in ("raw", "calibrated", "true_parameters"))
    return share_of(raw, after, perfect)


def share_interval(columns: Mapping[str, Floats], prefix: str = "") -> tuple[float, float, float]:
    """`share` with its 95 % interval over 500 resamples of the trials."""
    trials = len(columns[f"{prefix}error_raw_um"])
    rows = np.random.default_rng(0).integers(0, trials, (500, trials))
    names = [f"{prefix}error_{name}_um" for name in ("raw", "calibrated", "true_parameters")]
    raw, after, perfect = (np.nanmean(columns[name][rows] ** 2, axis=1) for name in names)
    low, high = np.percentile((raw - after) / (raw - perfect), [2.5, 97.5])
    return round(share(columns, prefix), 4), round(float(low), 4), round(float(high), 4)


def beside_floor(columns: Mapping[str, Floats]) -> Row:
    """What no calibration touches, the error with the true parameters, and what is left above it (rms, in quadrature).

    Held-out errors hold the noise of the readings that new points are measured with: two methods are compared by what
    is above it.
    """
    error, floor = (
        float(np.nanmean(columns[f"held_out_error_{k}_um"] ** 2)) for k in ("calibrated", "true_parameters")
    )
    above = round(max(error - floor, 0.0) ** 0.5, 2)
    return {"held_out_floor_um": round(floor**0.5, 2), "held_out_above_floor_um": above}


def stacked(parts: Sequence[Mapping[str, Floats]]) -> dict[str, Floats]:
    """Columns of several blocks as one."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def summary(values: Floats, digits: int = 2) -> Row:
    """Mean with its 95 % confidence interval, and the middle 90 % of the trials."""
    kept = values[np.isfinite(values)]
    mean, half = float(kept.mean()), 1.96 * float(kept.std(ddof=1)) / np.sqrt(len(kept)) if len(kept) > 1 else np.nan
    five, middle, ninety_five = np.percentile(kept, [5, 50, 95])
    row = {"mean": mean, "low": mean - half, "high": mean + half, "p5": five, "median": middle, "p95": ninety_five}
    return {name: round(float(value), digits) for name, value in row.items()} | {"trials": len(kept)}


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """A CSV table; columns in the order in which they first appear."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fields = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, fields, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def write_figure(path: Path, figure: Figure) -> None:
    """An SVG file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(svg(figure), encoding="utf-8")


def refuse_changes(out: Path) -> None:
    """Leave with a word where results are to be committed that no commit could have made."""
    changed = changes()
    if changed and RESULTS in (out, *out.parents):
        files = ", ".join(line.split()[-1] for line in changed.splitlines()[:3])
        sys.exit(f"the sources are not committed ({files}, ...): commit them first, or name another folder with --out")


def changes() -> str | None:
    """Sources that differ from the commit."""
    return _git("status", "--porcelain", "--", "ltsim", "experiments", "benchmarks", "pyproject.toml")


def write_manifest(here: Path, given: Options, made: Made) -> None:
    """``manifest.json``: command, seed, trials, versions, commit, and the experiment's files of settings."""
    words = [here.name[:2], *given.words, *([] if made.trials is None else ["--trials", str(made.trials)])]
    settings = {f.name: f.read_text(encoding="utf-8") for f in sorted(here.glob("*.toml"))}
    own = {"seed": made.seed, "trials": made.trials} | {"settings": settings} | dict(made.more)
    folder = made.folder or given.out
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(manifest(" ".join(["python -m experiments", *words]), **own), indent=1) + "\n"
    (folder / manifest_name(given.words if made.folder is None else ())).write_text(text, encoding="utf-8")


def manifest(command: str, **more: Any) -> dict[str, Any]:
    """Where results come from: command, versions, commit, and whether its sources had been changed."""
    versions = {"python": platform.python_version()} | {name: version(name) for name in USED}
    made = {"command": command, "versions": versions, "commit": commit(), "uncommitted_changes": bool(changes())}
    return made | more


def manifest_name(words: Sequence[str]) -> str:
    """Steps of a whole have manifests of their own."""
    return f"manifest{'-'.join(['', *words])}.json"


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
