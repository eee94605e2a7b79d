"""The rows of a shard: trials drawn, calibrated by every method on the same draws, judged."""

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
from ltsim.campaigns.calibrators import (
    StackCalibrator,
    calibrator_of,
    fitted_construction,
    fitted_effects,
    stacks,
)
from ltsim.campaigns.columns import labels_of, parameter_columns, rows_of_method, with_settings, z_scores
from ltsim.campaigns.design import Factor
from ltsim.campaigns.engine import FAILED, STATUSES, Calibrated, Calibrator
from ltsim.campaigns.judge import Columns, Judge
from ltsim.campaigns.schema import CHECKED, column_of
from ltsim.campaigns.spec import JUDGE, Campaign
from ltsim.campaigns.store import encoded
from ltsim.campaigns.truth import Block, Truth, truth_of
from ltsim.effects import CATALOGUE
from ltsim.effects.effect import Effect
from ltsim.errors import SetupError
from ltsim.randomness import BLOCK, stream
from ltsim.simulation.draws import Normal
from ltsim.simulation.physics import construction_of, effects_of
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import place_key
from ltsim.simulation.workshop import Layout, planned

TOGETHER = 64
"""Trials with geometries of their own that are done side by side, as far as their stations see the same."""


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
class Prepared:
    """A cell ready to work: everything its trials share."""

    campaign: Campaign
    scenario: Scenario
    judge: Scenario | None = None

    @cached_property
    def shared(self) -> tuple[Judge, list[Calibrator]]:
        """The geometry that all trials share, with the calibrators in the order of the file's methods."""
        truth = truth_of(self.scenario, self.campaign.seed)
        return Judge(truth), [calibrator_of(method, truth) for method in self.campaign.methods]

    @cached_property
    def elsewhere(self) -> Judge | None:
        """The place of `judge_in`, where the same instruments measure what no calibration used."""
        return None if self.judge is None else Judge(truth_of(self.judge, self.campaign.seed, JUDGE))

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
        names = tuple(self.scenario.trackers)
        labels = labels_of(construction_of(self.scenario), names, effects_of(self.scenario))
        for method in self.campaign.methods:
            labels += labels_of(fitted_construction(method), names, fitted_effects(method))
        return {label.name: label.parameter.unit for label in labels}

    @cached_property
    def _plan(self) -> Layout:
        return planned(self.scenario)

    def blocks(self, first: int, last: int) -> Iterator[tuple[Judge, Sequence[Calibrator], Block]]:
        """Blocks that hold the trials ``first`` to ``last - 1``, with their geometry's judge and calibrators.

        A trial whose own geometry is impossible, a station that sees nothing, is in none.
        """
        seed, methods = self.campaign.seed, self.campaign.methods
        if self.campaign.geometry == "shared":
            judge, calibrators = self.shared
            for number in range(first // BLOCK, -(-last // BLOCK)):
                yield judge, calibrators, judge.truth.draw(seed, number)
            return
        for low in range(first, last, TOGETHER):
            for stack, numbers in stacks(self._own(range(low, min(low + TOGETHER, last)))):
                yield Judge(stack), [StackCalibrator.of(m, stack) for m in methods], stack.draw_trials(seed, numbers)

    def _own(self, trials: range) -> dict[int, Truth]:
        """The geometry of each trial that has a possible one; they share the set-up with the common one."""
        found, seed = {}, self.campaign.seed
        for trial in trials:
            with suppress(SetupError):
                key, like = place_key(trial, self.campaign.geometry), self.shared[0].truth
                found[trial] = truth_of(self.scenario, seed, *key, like=like, plan=self._plan)
        return found


@lru_cache(maxsize=4)
def prepared(campaign: str, scenario: str, judge: str) -> Prepared:
    """The prepared cell of a task; kept, since a worker sees many shards of the same cell."""
    there = Scenario.model_validate_json(judge) if judge else None
    return Prepared(Campaign.model_validate_json(campaign), Scenario.model_validate_json(scenario), there)


def run_task(task: Task) -> tuple[Task, bytes]:
    """A shard as the bytes of its file, with its task; one thread, so that sums keep their order on any worker."""
    for kind in task.effects:
        CATALOGUE.add(kind)
    with threadpool_limits(limits=1):
        return task, encoded(shard_rows(task), task.key)


def shard_rows(task: Task) -> pa.Table:
    """The rows of a shard: by method, then by trial."""
    cell = prepared(task.campaign, task.scenario, task.judge)
    campaign = cell.campaign
    first = task.shard * campaign.shard
    last = min(first + campaign.shard, campaign.trials)
    checked = _checked_trials(campaign, task.shard, first, last)
    parts: list[list[Columns]] = [[] for _ in campaign.methods]
    missing = set(range(first, last))
    for judge, calibrators, block in cell.blocks(first, last):
        numbers = block.trials
        wanted = np.flatnonzero((numbers >= first) & (numbers < last))
        missing -= set(numbers[wanted].tolist())
        work = Work(campaign, judge, block, cell.elsewhere, wanted, wanted[np.isin(numbers[wanted], checked)])
        for part, calibrator in zip(parts, calibrators, strict=True):
            columns = {"trial": numbers} | work.columns(calibrator)
            part.append({name: column[wanted] for name, column in columns.items()})
    if missing:
        empty = np.full(len(missing), np.nan)
        failed = {"status": np.full(len(missing), STATUSES.index(FAILED)), "chi2": empty, CHECKED: empty}
        for part in parts:
            part.append({"trial": np.array(sorted(missing))} | failed)
    tables = [
        rows_of_method(task.cell, method.title, part) for method, part in zip(campaign.methods, parts, strict=True)
    ]
    whole = pa.concat_tables(tables, promote_options="default").combine_chunks()
    return with_settings(whole, cell.factors, cell.levels, cell.units)


@dataclass(frozen=True)
class Work:
    """A block that every method calibrates."""

    campaign: Campaign
    judge: Judge
    block: Block
    elsewhere: Judge | None
    wanted: Ints
    checked: Ints
    """Places in the block of the trials that rows are wanted of, and of those that the full solver repeats."""

    @cached_property
    def shared(self) -> Columns:
        """Columns that all methods share."""
        return self.judge.before(self.block)

    @cached_property
    def new_points(self) -> tuple[Judge, Block, Columns] | None:
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
        population = self.judge.truth.population
        moves = np.array([p.unit != "ppm" for p in population.construction.parameters])
        step = Normal(self.campaign.seed, self.block.trials)(values[:, :, 0].size, "drift")
        return values + share * (population.sigma * moves)[:, :, None] * step.reshape(values.shape)

    def columns(self, calibrator: Calibrator) -> Columns:
        """The columns of a method that the campaign wants."""
        found, wanted = calibrator.calibrate(self.block, self.wanted), self.campaign.statistics
        construction, effects = calibrator.construction, calibrator.effects
        truth, block = self.judge.truth, self.block
        columns: Columns = {"status": found.status, "chi2": found.chi2}
        columns[CHECKED] = np.full(len(found.chi2), np.nan)
        for place in self.checked:
            columns[CHECKED][place] = calibrator.difference(block, int(place), found)
        judged = self.shared | self.judge.after(block, found, construction, effects)
        judged |= self._elsewhere(found, calibrator)
        columns |= {name: own for name, own in judged.items() if (known := column_of(name)) and known.group in wanted}
        labels = labels_of(construction, truth.recording.instruments, effects)
        true_labels = labels_of(truth.construction, truth.recording.instruments, [law.effect for law in truth.effects])
        (values, sigma), true = found.estimates, block.true_values
        if "z-scores" in wanted:
            columns |= z_scores(labels, values, sigma, true_labels, true)
        if "estimates" in wanted:
            columns |= parameter_columns(labels, values, "estimate") | parameter_columns(labels, sigma, "sigma")
        if "truth" in wanted:
            columns |= parameter_columns(true_labels, true, "true")
        return columns

    def _elsewhere(self, found: Calibrated, calibrator: Calibrator) -> Columns:
        if self.new_points is None:
            return {}
        there, block, before = self.new_points
        nowhere = np.full((*there.truth.state.points.shape, len(found.chi2)), np.nan)  # no target is adjusted there
        after = there.after(block, replace(found, points=nowhere), calibrator.construction, calibrator.effects)
        return {f"new_point_{name}": own for name, own in (before | after).items() if name.startswith("error_")}


def _checked_trials(campaign: Campaign, shard: int, first: int, last: int) -> Ints:
    """Trials of a shard that the full solver repeats: a sample drawn by key."""
    draw = stream(campaign.seed, "campaign", "verify", shard)
    return first + draw.choice(last - first, size=min(campaign.verify, last - first), replace=False)


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
