"""The rows of a shard: trials drawn, calibrated by every method on the same draws, judged."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
from threadpoolctl import threadpool_limits

from ltsim.arrays import Floats, Ints
from ltsim.campaigns.calibrators import Calibrator, calibrator_of
from ltsim.campaigns.cell import truth_of
from ltsim.campaigns.columns import parameter_units, with_settings
from ltsim.campaigns.design import Factor
from ltsim.campaigns.engine import FAILED, STATUSES, Bench, Calibrated, parameter_columns, trials_of
from ltsim.campaigns.judge import Columns
from ltsim.campaigns.spec import Campaign, group_of
from ltsim.campaigns.stack import StackCalibrator, stacks
from ltsim.campaigns.store import encoded
from ltsim.campaigns.truth import BLOCK, Block, Truth
from ltsim.errors import SetupError
from ltsim.model.construction import Construction
from ltsim.randomness import stream
from ltsim.simulation.physics import construction_of, effects_of
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.workshop import Layout, planned

TOGETHER = 64
"""Trials with geometries of their own that are done side by side, as far as their stations see the same."""
CHECKED = "full_difference_sigma"
"""Column of the trials that were calibrated once more by the full solver: largest difference in sigmas."""


@dataclass(frozen=True)
class Task:
    """One shard of one cell, as plain data that any worker can take."""

    campaign: str
    scenario: str
    """As JSON."""
    fingerprint: str
    cell: int
    shard: int

    @property
    def key(self) -> dict[str, str]:
        """What the shard's file says of itself."""
        return {"campaign": self.fingerprint, "cell": str(self.cell), "shard": str(self.shard)}


@dataclass(frozen=True)
class Ready:
    """A geometry ready to work: what all its trials share."""

    truth: Truth
    bench: Bench
    calibrators: list[Calibrator]


@dataclass(frozen=True)
class Prepared:
    """A cell ready to work: everything its trials share."""

    campaign: Campaign
    scenario: Scenario

    @cached_property
    def shared(self) -> Ready:
        """The geometry that all trials share, with the calibrators in the order of the file's methods."""
        truth = truth_of(self.scenario, self.campaign.seed, "campaign")
        return Ready(truth, Bench(truth), [calibrator_of(method, truth) for method in self.campaign.methods])

    @cached_property
    def factors(self) -> tuple[Factor, ...]:
        """What differs between the cells of the campaign."""
        return self.campaign.factors(self.scenario)

    @cached_property
    def levels(self) -> dict[str, Any]:
        """What the factors are in this cell, by name."""
        tables = self.scenario.model_dump(mode="json", by_alias=True)
        return {factor.name: factor.level(tables) for factor in self.factors}

    @cached_property
    def units(self) -> dict[str, str]:
        """Units of the parameters in the rows."""
        return parameter_units(self.campaign, construction_of(self.scenario), effects_of(self.scenario))

    @cached_property
    def _plan(self) -> Layout:
        return planned(self.scenario)

    def blocks(self, first: int, last: int) -> Iterator[tuple[Ready, Block, Ints]]:
        """Blocks that hold the trials ``first`` to ``last - 1``, with the numbers (B,) of their trials.

        A trial whose own geometry is impossible, a station that sees nothing, is in none.
        """
        seed, methods = self.campaign.seed, self.campaign.methods
        if self.campaign.geometry == "shared":
            for number in range(first // BLOCK, -(-last // BLOCK)):
                yield self.shared, self.shared.truth.draw(seed, number), trials_of(number)
            return
        for low in range(first, last, TOGETHER):
            for stack, numbers in stacks(self._own(range(low, min(low + TOGETHER, last)))):
                block, alone = stack.draw_trials(seed, numbers)
                yield Ready(stack, Bench(stack), [StackCalibrator(stack, alone, m) for m in methods]), block, numbers

    def _own(self, trials: range) -> dict[int, Truth]:
        """The geometry of each trial that has a possible one; they share the set-up with the common one."""
        found = {}
        for trial in trials:
            with suppress(SetupError):
                key = self.campaign.seed, "campaign", trial
                found[trial] = truth_of(self.scenario, *key, like=self.shared.truth, plan=self._plan)
        return found


@lru_cache(maxsize=4)
def prepared(campaign: str, scenario: str) -> Prepared:
    """The prepared cell of a task; kept, since a worker sees many shards of the same cell."""
    return Prepared(Campaign.model_validate_json(campaign), Scenario.model_validate_json(scenario))


def run_task(task: Task) -> bytes:
    """A shard as the bytes of its file; one thread, so that sums keep their order on any worker."""
    with threadpool_limits(limits=1):
        return encoded(shard_rows(task), task.key)


def shard_rows(task: Task) -> pa.Table:
    """The rows of a shard: by method, then by trial."""
    cell = prepared(task.campaign, task.scenario)
    campaign = cell.campaign
    first = task.shard * campaign.shard
    last = min(first + campaign.shard, campaign.trials)
    checked = _checked_trials(campaign, task.shard, first, last)
    parts: list[list[Columns]] = [[] for _ in campaign.methods]
    missing = set(range(first, last))
    for ready, block, numbers in cell.blocks(first, last):
        wanted = np.flatnonzero((numbers >= first) & (numbers < last))
        missing -= set(numbers[wanted].tolist())
        places = wanted[np.isin(numbers[wanted], checked)]
        shared = ready.bench.before(block)
        for part, calibrator in zip(parts, ready.calibrators, strict=True):
            columns = {"trial": numbers} | _by_method(campaign, ready.bench, block, calibrator, shared, wanted, places)
            part.append({name: column[wanted] for name, column in columns.items()})
    if missing:
        for part in parts:
            part.append({"trial": np.array(sorted(missing))} | _failed(len(missing)))
    tables = [_table(task.cell, method.title, part) for method, part in zip(campaign.methods, parts, strict=True)]
    whole = pa.concat_tables(tables, promote_options="default").combine_chunks()
    return with_settings(whole, cell.factors, cell.levels, cell.units)


def _by_method(
    campaign: Campaign, bench: Bench, block: Block, calibrator: Calibrator, shared: Columns, wanted: Ints, checked: Ints
) -> Columns:
    """The columns of a method on a block."""
    found = calibrator.calibrate(block, wanted)
    columns = _columns(campaign, bench, block, found, calibrator.construction, shared)
    columns[CHECKED] = np.full(block.deviation.shape[2], np.nan)
    for place in checked:
        columns[CHECKED][place] = calibrator.difference(block, int(place), found)
    return columns


def _failed(trials: int) -> Columns:
    """Of a method that gave nothing."""
    empty = np.full(trials, np.nan)
    return {"status": np.full(trials, STATUSES.index(FAILED)), "chi2": empty, CHECKED: empty}


def _checked_trials(campaign: Campaign, shard: int, first: int, last: int) -> Ints:
    """Trials of a shard that the full solver repeats: a sample drawn by key."""
    draw = stream(campaign.seed, "campaign", "verify", shard)
    return first + draw.choice(last - first, size=min(campaign.verify, last - first), replace=False)


def _columns(
    campaign: Campaign,
    bench: Bench,
    block: Block,
    found: Calibrated,
    construction: Construction,
    shared: Columns,
) -> Columns:
    """The columns that the campaign wants of a method on a block."""
    wanted, truth = campaign.statistics, bench.truth
    names = truth.recording.instruments
    columns: Columns = {"status": found.status, "chi2": found.chi2}
    judged = shared | bench.after(block, found, construction, shared)
    columns |= {name: column for name, column in judged.items() if group_of(name) in wanted}
    if "z-scores" in wanted:
        columns |= z_scores(truth, block, found, construction, names)
    if "estimates" in wanted:
        columns |= parameter_columns(construction, names, found.values, "estimate")
        spread = np.broadcast_to(_per_trial(found.sigma), found.values.shape)
        columns |= parameter_columns(construction, names, spread, "sigma")
    if "truth" in wanted:
        columns |= parameter_columns(truth.construction, names, block.values, "true")
        for entry, amount in zip(truth.effects, block.amounts, strict=True):
            for k, parameter in enumerate(entry.effect.parameters):
                columns[f"true:{entry.effect.name}:{parameter.name} {entry.key}"] = amount[k] / parameter.factor
    return columns


def _per_trial(sigma: Floats) -> Floats:
    """Standard deviations with a last index for trials."""
    return sigma[:, :, None] if sigma.ndim == 2 else sigma


def z_scores(
    truth: Truth, block: Block, found: Calibrated, construction: Construction, names: tuple[str, ...]
) -> Columns:
    """(estimate - truth) / sigma of the parameters that the true instrument has under the same name."""
    both = [name for name in construction.names if name in truth.construction.names]
    fitted = [construction.index(name) for name in both]
    true = [truth.construction.index(name) for name in both]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (found.values[:, fitted] - block.values[:, true]) / _per_trial(found.sigma)[:, fitted]
    flat = np.array(construction.names_of(names)).reshape(len(names), construction.size)[:, fitted].ravel()
    return {f"z:{name}": own for name, own in zip(flat, z.reshape(len(flat), z.shape[2]), strict=True)}


def _table(cell: int, method: str, parts: list[Columns]) -> pa.Table:
    """Columns as a table; numbers that people read are kept to seven digits, empty where a geometry has none."""
    names = dict.fromkeys(name for part in parts for name in part)
    merged = {
        name: np.concatenate([part[name] if name in part else np.full(len(part["trial"]), np.nan) for part in parts])
        for name in names
    }
    order = np.argsort(merged["trial"])
    merged = {name: values[order] for name, values in merged.items()}
    trial, status = merged.pop("trial"), merged.pop("status").astype(np.int64)
    count = len(trial)
    lost = status == STATUSES.index(FAILED)
    columns: dict[str, pa.Array] = {
        "cell": pa.array(np.full(count, cell), pa.int32()),
        "method": pa.array([method] * count, pa.string()),
        "trial": pa.array(trial, pa.int64()),
        "status": pa.array([STATUSES[s] for s in status], pa.string()),
    }
    for name, values in merged.items():
        empty = np.isnan(values) | (lost if name.startswith(("z:", "estimate:")) or "after" in name else False)
        columns[name] = pa.array(values.astype(np.float32), pa.float32(), mask=empty)
    return pa.table(columns)


def task_of(campaign: Campaign, scenario: Scenario, fingerprint: str, cell: int, shard: int) -> Task:
    """A task as plain data."""
    return Task(
        campaign.model_dump_json(by_alias=True),
        json.dumps(scenario.model_dump(mode="json", by_alias=True)),
        fingerprint,
        cell,
        shard,
    )


def rows_of(campaign: Campaign, shard: int) -> int:
    """Number of rows of a shard."""
    return len(campaign.methods) * (min((shard + 1) * campaign.shard, campaign.trials) - shard * campaign.shard)
