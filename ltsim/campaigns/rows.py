"""The rows of a shard: trials drawn, calibrated by every method on the same draws, judged."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
from threadpoolctl import threadpool_limits

from ltsim.arrays import Floats, Ints
from ltsim.campaigns.calibrators import Calibrator, calibrator_of
from ltsim.campaigns.cell import fitted_effects, truth_of
from ltsim.campaigns.columns import parameter_units, with_settings
from ltsim.campaigns.design import Factor
from ltsim.campaigns.engine import (
    FAILED,
    STATUSES,
    Bench,
    Calibrated,
    effect_columns,
    parameter_columns,
    trials_of,
)
from ltsim.campaigns.judge import Columns
from ltsim.campaigns.schema import column_of
from ltsim.campaigns.spec import JUDGE, Campaign
from ltsim.campaigns.stack import StackCalibrator, stacks
from ltsim.campaigns.store import encoded
from ltsim.campaigns.truth import Block, Truth
from ltsim.effects import CATALOGUE
from ltsim.effects.effect import Effect
from ltsim.errors import SetupError
from ltsim.model.construction import Construction
from ltsim.randomness import BLOCK, stream
from ltsim.simulation.draws import Normal
from ltsim.simulation.physics import construction_of, effects_of
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import place_key
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
    mark: str
    """Of the cell."""
    cell: int
    shard: int
    judge: str = ""
    """The scenario of `judge_in`, as JSON; empty for none."""
    effects: tuple[type[Effect], ...] = ()
    """Classes of the session, which a worker does not know."""

    @property
    def key(self) -> dict[str, str]:
        """What the shard's file says of itself."""
        held = " ".join(json.loads(self.campaign)["statistics"])
        return {"campaign": self.mark, "cell": str(self.cell), "shard": str(self.shard), "statistics": held}


@dataclass(frozen=True)
class Ready:
    """A geometry ready to work: what all its trials share."""

    truth: Truth
    bench: Bench
    calibrators: Sequence[Calibrator]


@dataclass(frozen=True)
class Prepared:
    """A cell ready to work: everything its trials share."""

    campaign: Campaign
    scenario: Scenario
    judge: Scenario | None = None

    @cached_property
    def shared(self) -> Ready:
        """The geometry that all trials share, with the calibrators in the order of the file's methods."""
        truth = truth_of(self.scenario, self.campaign.seed)
        return Ready(truth, Bench(truth), [calibrator_of(method, truth) for method in self.campaign.methods])

    @cached_property
    def elsewhere(self) -> Bench | None:
        """The place of `judge_in`, where the same instruments measure what no calibration used."""
        if self.judge is None:
            return None
        return Bench(truth_of(self.judge, self.campaign.seed, JUDGE))

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
        fitted = [effect for method in self.campaign.methods for effect in fitted_effects(method)]
        return parameter_units(self.campaign, construction_of(self.scenario), [*effects_of(self.scenario), *fitted])

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
                key = place_key(trial, self.campaign.geometry)
                found[trial] = truth_of(
                    self.scenario, self.campaign.seed, *key, like=self.shared.truth, plan=self._plan
                )
        return found


@lru_cache(maxsize=4)
def prepared(campaign: str, scenario: str, judge: str) -> Prepared:
    """The prepared cell of a task; kept, since a worker sees many shards of the same cell."""
    there = Scenario.model_validate_json(judge) if judge else None
    return Prepared(Campaign.model_validate_json(campaign), Scenario.model_validate_json(scenario), there)


def run_task(task: Task) -> bytes:
    """A shard as the bytes of its file; one thread, so that sums keep their order on any worker."""
    for kind in task.effects:
        CATALOGUE.add(kind)
    with threadpool_limits(limits=1):
        return encoded(shard_rows(task), task.key)


def shard_rows(task: Task) -> pa.Table:
    """The rows of a shard: by method, then by trial."""
    cell = prepared(task.campaign, task.scenario, task.judge)
    campaign = cell.campaign
    first = task.shard * campaign.shard
    last = min(first + campaign.shard, campaign.trials)
    checked = _checked_trials(campaign, task.shard, first, last)
    parts: list[list[Columns]] = [[] for _ in campaign.methods]
    missing = set(range(first, last))
    for ready, block, numbers in cell.blocks(first, last):
        wanted = np.flatnonzero((numbers >= first) & (numbers < last))
        missing -= set(numbers[wanted].tolist())
        work = Work(campaign, ready.bench, block, cell.elsewhere, wanted, wanted[np.isin(numbers[wanted], checked)])
        for part, calibrator in zip(parts, ready.calibrators, strict=True):
            columns = {"trial": numbers} | work.columns(calibrator)
            part.append({name: column[wanted] for name, column in columns.items()})
    if missing:
        for part in parts:
            part.append({"trial": np.array(sorted(missing))} | _failed(len(missing)))
    tables = [_table(task.cell, method.title, part) for method, part in zip(campaign.methods, parts, strict=True)]
    whole = pa.concat_tables(tables, promote_options="default").combine_chunks()
    return with_settings(whole, cell.factors, cell.levels, cell.units)


@dataclass(frozen=True)
class Work:
    """A block that every method calibrates."""

    campaign: Campaign
    bench: Bench
    block: Block
    elsewhere: Bench | None
    wanted: Ints
    checked: Ints
    """Places in the block of the trials that rows are wanted of, and of those that the full solver repeats."""

    @cached_property
    def shared(self) -> Columns:
        """Columns that all methods share."""
        return self.bench.before(self.block)

    @cached_property
    def new_points(self) -> tuple[Bench, Block, Columns] | None:
        """The same instruments elsewhere: noise of their own, the same amounts of the effects that act there too."""
        if self.elsewhere is None:
            return None
        there = Normal(self.campaign.seed, self.block.trials)
        block = self.elsewhere.truth.drawn(there, self._drifted(), apart=JUDGE)
        return self.elsewhere, block, self.elsewhere.before(block)

    def _drifted(self) -> Floats:
        """The instruments' errors (I, p, B) [SI] when they are judged."""
        values, share = self.block.values, self.campaign.judge_drift
        if not share:
            return values
        population = self.bench.truth.population
        moves = np.array([p.unit != "ppm" for p in population.construction.parameters])
        step = Normal(self.campaign.seed, self.block.trials)(values[:, :, 0].size, "drift")
        return values + share * (population.sigma * moves)[:, :, None] * step.reshape(values.shape)

    def columns(self, calibrator: Calibrator) -> Columns:
        """The columns of a method that the campaign wants."""
        found, wanted = calibrator.calibrate(self.block, self.wanted), self.campaign.statistics
        construction, effects = calibrator.construction, calibrator.effects
        truth, block = self.bench.truth, self.block
        names = truth.recording.instruments
        columns: Columns = {"status": found.status, "chi2": found.chi2}
        columns[CHECKED] = np.full(len(found.chi2), np.nan)
        for place in self.checked:
            columns[CHECKED][place] = calibrator.difference(block, int(place), found)
        judged = (
            self.shared | self.bench.after(block, found, construction, effects) | self._elsewhere(found, calibrator)
        )
        columns |= {name: own for name, own in judged.items() if (known := column_of(name)) and known.group in wanted}
        if "z-scores" in wanted:
            columns |= z_scores(truth, block, found, construction, names)
            columns |= _effect_z_scores(truth, block, found, effects)
        if "estimates" in wanted:
            columns |= parameter_columns(construction, names, found.values, "estimate")
            spread = np.broadcast_to(_per_trial(found.sigma), found.values.shape)
            columns |= parameter_columns(construction, names, spread, "sigma")
            columns |= effect_columns(effects, found.extra, "estimate")
            columns |= effect_columns(effects, np.broadcast_to(found.extra_sigma, found.extra.shape), "sigma")
        if "truth" in wanted:
            columns |= parameter_columns(truth.construction, names, block.values, "true")
            amounts = np.concatenate([*block.amounts, np.empty((0, len(found.chi2)))])
            columns |= effect_columns([law.effect for law in truth.effects], amounts, "true")
        return columns

    def _elsewhere(self, found: Calibrated, calibrator: Calibrator) -> Columns:
        """Errors of new points."""
        if self.new_points is None:
            return {}
        bench, block, before = self.new_points
        after = bench.after(
            block, replace(found, points=bench.nowhere(len(found.chi2))), calibrator.construction, calibrator.effects
        )
        return {f"new_point_{name}": own for name, own in (before | after).items() if name.startswith("error_")}


def _failed(trials: int) -> Columns:
    """Of a method that gave nothing."""
    empty = np.full(trials, np.nan)
    return {"status": np.full(trials, STATUSES.index(FAILED)), "chi2": empty, CHECKED: empty}


def _checked_trials(campaign: Campaign, shard: int, first: int, last: int) -> Ints:
    """Trials of a shard that the full solver repeats: a sample drawn by key."""
    draw = stream(campaign.seed, "campaign", "verify", shard)
    return first + draw.choice(last - first, size=min(campaign.verify, last - first), replace=False)


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


def _effect_z_scores(truth: Truth, block: Block, found: Calibrated, effects: Sequence[Effect]) -> Columns:
    """The same of fitted effects that are among the true ones."""
    if not effects:
        return {}
    both = [(law.effect, own) for law, own in zip(truth.effects, block.amounts, strict=True) if law.effect in effects]
    columns: Columns = {}
    parts = np.split(np.arange(len(found.extra)), np.cumsum([len(e.parameters) for e in effects])[:-1])
    for effect, rows in zip(effects, parts, strict=True):
        true = next((own for other, own in both if other == effect), None)
        if true is not None:
            z = (found.extra[rows] - true) / found.extra_sigma[rows]
            columns |= effect_columns([effect], z, "z")
    return columns


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


def task_of(
    campaign: Campaign, scenario: Scenario, mark: str, cell: int, shard: int, judge: Scenario | None = None
) -> Task:
    """A task as plain data."""
    return Task(
        campaign.model_dump_json(by_alias=True),
        json.dumps(scenario.model_dump(mode="json", by_alias=True)),
        mark,
        cell,
        shard,
        "" if judge is None else json.dumps(judge.model_dump(mode="json", by_alias=True)),
        CATALOGUE.of_session,
    )


def rows_of(campaign: Campaign, shard: int) -> int:
    """Number of rows of a shard."""
    return len(campaign.methods) * (min((shard + 1) * campaign.shard, campaign.trials) - shard * campaign.shard)
