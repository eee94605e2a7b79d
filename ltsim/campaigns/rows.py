"""Rows of a shard: trials are drawn, calibrated by every method on the same draws, and evaluated."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
from threadpoolctl import threadpool_limits

from ltsim.campaigns.calibrators import (
    StackCalibrator,
    calibrator_of,
    fitted_construction,
    fitted_effects,
    stacks,
)
from ltsim.campaigns.columns import Columns, labels_of, parameter_columns, rows_of_method, with_settings, z_scores
from ltsim.campaigns.design import Factor
from ltsim.campaigns.engine import Calibrated, Calibrator
from ltsim.campaigns.judge import TrialEvaluator
from ltsim.campaigns.schema import CHECKED, FAILED, STATUSES, column_of
from ltsim.campaigns.spec import JUDGE, Campaign
from ltsim.campaigns.store import encoded, statistics_of
from ltsim.campaigns.truth import CellTruth, TrialBatch, truth_of
from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import SetupError
from ltsim.core.randomness import BLOCK
from ltsim.physics.effects import CATALOGUE
from ltsim.physics.effects.effect import Effect
from ltsim.simulation.draws import StandardNormalSource
from ltsim.simulation.physics import make_scenario_construction, scenario_effects
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import placing_stream_key
from ltsim.simulation.workshop import WorkshopLayout, planned_layout

CORRECTED_STATISTICS = {"criteria", "errors"}
"""Statistics that need corrected readings."""
TRIALS_PER_STACK = 64
"""Number of trials per batch if each has a separate geometry with the same sightings."""


@dataclass(frozen=True)
class ShardTask:
    """Shard of a cell as a task for any worker."""

    campaign: Campaign
    scenario: Scenario
    mark: str
    """Digest of the cell."""
    cell: int
    shard: int
    judge: Scenario | None = None
    """Scenario of `judge_in`, in which methods are evaluated; None without one."""
    effects: tuple[type[Effect], ...] = field(default_factory=lambda: CATALOGUE.session_effects)
    """Effect classes that were registered in this session, which a worker does not have."""
    held: pa.Table | None = None
    """Existing rows of the shard, if it lacks trials or statistics."""

    @property
    def key(self) -> dict[str, str]:
        """Metadata of the shard's file: campaign, cell, shard and statistics."""
        held = " ".join(self.campaign.statistics)
        return {"campaign": self.mark, "cell": str(self.cell), "shard": str(self.shard), "statistics": held}


@dataclass(frozen=True)
class CellContext:
    """Cell with everything that its trials share."""

    campaign: Campaign
    scenario: Scenario
    judge: Scenario | None = None

    @cached_property
    def shared(self) -> tuple[TrialEvaluator, list[Calibrator]]:
        """Common geometry of all trials, with the calibrators in the order of the file's methods."""
        truth = truth_of(self.scenario, self.campaign.seed)
        return TrialEvaluator(truth), [calibrator_of(method, truth) for method in self.campaign.methods]

    @cached_property
    def elsewhere(self) -> TrialEvaluator | None:
        """Geometry of `judge_in`, at which the same instruments measure points that no calibration used.

        It is None without one.
        """
        return None if self.judge is None else TrialEvaluator(truth_of(self.judge, self.campaign.seed, JUDGE))

    @cached_property
    def factors(self) -> tuple[Factor, ...]:
        """Factors of the campaign: the settings that differ between its cells."""
        return self.campaign.factors(self.scenario)

    @cached_property
    def levels(self) -> dict[str, Any]:
        """Levels of the factors in this cell, by name."""
        tables = self.scenario.model_dump(mode="json", by_alias=True)
        return {factor.name: factor.level(tables) for factor in self.factors}

    @cached_property
    def units(self) -> dict[str, str]:
        """Units of the parameters in the rows."""
        names = tuple(self.scenario.trackers_in_use)
        labels = labels_of(make_scenario_construction(self.scenario), names, scenario_effects(self.scenario))
        for method in self.campaign.methods:
            labels += labels_of(fitted_construction(method), names, fitted_effects(method))
        return {label.name: label.parameter.unit for label in labels}

    @cached_property
    def _plan(self) -> WorkshopLayout:
        return planned_layout(self.scenario)

    def blocks(self, first: int, last: int) -> Iterator[tuple[TrialEvaluator, Sequence[Calibrator], TrialBatch]]:
        """Blocks with the trials ``first`` to ``last - 1``, each with the evaluation and calibrators of its geometry.

        Trials with an impossible geometry, such as a station without visible targets, are in no block.
        """
        seed, methods = self.campaign.seed, self.campaign.methods
        if self.campaign.geometry == "shared":
            judge, calibrators = self.shared
            for number in range(first // BLOCK, -(-last // BLOCK)):
                yield judge, calibrators, judge.truth.draw(seed, number)
            return
        for low in range(first, last, TRIALS_PER_STACK):
            for stack, numbers in stacks(self._geometries(range(low, min(low + TRIALS_PER_STACK, last)))):
                yield (
                    TrialEvaluator(stack),
                    [StackCalibrator.of(m, stack) for m in methods],
                    stack.draw_trials(seed, numbers),
                )

    def _geometries(self, trials: range) -> dict[int, CellTruth]:
        """True geometry of each trial that has a possible one; they share the set-up with the common one."""
        geometries, seed = {}, self.campaign.seed
        for trial in trials:
            with suppress(SetupError):
                key, like = placing_stream_key(trial, self.campaign.geometry), self.shared[0].truth
                geometries[trial] = truth_of(self.scenario, seed, *key, like=like, plan=self._plan)
        return geometries


@lru_cache(maxsize=4)
def cell_context(campaign: str, scenario: str, judge: str) -> CellContext:
    """Cell of a task, from JSON texts; it is cached, because a worker computes many shards of the same cell."""
    there = Scenario.model_validate_json(judge) if judge else None
    return CellContext(Campaign.model_validate_json(campaign), Scenario.model_validate_json(scenario), there)


def run_task(task: ShardTask) -> tuple[ShardTask, bytes]:
    """Task and the bytes of its shard's file; computed with one thread, so that sums keep their order on any worker."""
    for kind in task.effects:
        CATALOGUE.add(kind)
    with threadpool_limits(limits=1):
        return replace(task, held=None), encoded(shard_rows(task), task.key)


def shard_rows(task: ShardTask) -> pa.Table:
    """Rows of a shard, by method, then by trial; existing rows are reused, missing ones computed."""
    if task.held is None:
        return _computed(task, 0)
    campaign, held = task.campaign, task.held
    more = tuple(name for name in campaign.statistics if name not in statistics_of(held))
    if not more:
        order = pa.array([method.title for method in campaign.methods])
        whole = pa.concat_tables([held, _computed(task, len(held) // len(order))], promote_options="default")
        places = pa.compute.index_in(whole["method"], order).to_numpy()
        return whole.take(np.lexsort((whole["trial"].to_numpy(), places))).combine_chunks()
    if len(held) < rows_of(campaign, task.shard):
        return _computed(task, 0)
    only = campaign.model_copy(update={"statistics": more, "verify": 0, "stop": None})
    added = _computed(replace(task, campaign=only), 0, drawn=more == ("truth",))
    for column in added.schema:
        held = held if column.name in held.column_names else held.append_column(column, added[column.name])
    return held


def _computed(task: ShardTask, done: int, *, drawn: bool = False) -> pa.Table:
    """New rows of a shard after the existing trials; with `drawn` only the true values, without a calibration."""
    campaign, given = task.campaign, (task.campaign, task.scenario, task.judge)
    cell = cell_context(*("" if model is None else model.model_dump_json(by_alias=True) for model in given))
    start = task.shard * campaign.shard
    first, last = start + done, min(start + campaign.shard, campaign.trials)
    parts: list[list[Columns]] = [[] for _ in campaign.methods]
    missing = set(range(first, last))
    for judge, calibrators, block in cell.blocks(first, last):
        numbers = block.trials
        wanted = np.flatnonzero((numbers >= first) & (numbers < last))
        missing -= set(numbers[wanted].tolist())
        checked = wanted[numbers[wanted] < start + campaign.verify]
        work = TrialBlock(campaign, judge, block, cell.elsewhere, wanted, checked, drawn)
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
class TrialBlock:
    """Block that every method calibrates."""

    campaign: Campaign
    judge: TrialEvaluator
    block: TrialBatch
    elsewhere: TrialEvaluator | None
    wanted: Ints
    checked: Ints
    """Indices in the block of the trials whose rows are wanted, and of those that the full solver repeats."""
    drawn: bool = False
    """True if rows contain the drawn truth only, without a calibration."""

    @cached_property
    def shared(self) -> Columns:
        """Columns common to all methods."""
        return self.judge.before(self.block)

    @cached_property
    def new_points(self) -> tuple[TrialEvaluator, TrialBatch, Columns] | None:
        """Held-out points measured by the same instruments, with independent noise and equal sizes of effects.

        It is None without `judge_in`.
        """
        if self.elsewhere is None:
            return None
        there = StandardNormalSource(self.campaign.seed, self.block.trials)
        block = self.elsewhere.truth.drawn(there, self._drifted(), stream_key=JUDGE)
        return self.elsewhere, block, self.elsewhere.before(block)

    def _drifted(self) -> Floats:
        """Errors of the instruments (I, p, B) [SI] at the time of evaluation."""
        values, share = self.block.values, self.campaign.judge_drift
        if not share:
            return values
        population = self.judge.truth.population
        moves = np.array([p.unit != "ppm" for p in population.construction.parameters])
        step = StandardNormalSource(self.campaign.seed, self.block.trials)(values[:, :, 0].size, "drift")
        return values + share * (population.instrument_sigmas * moves)[:, :, None] * step.reshape(values.shape)

    def columns(self, calibrator: Calibrator) -> Columns:
        """Columns of a method that the campaign stores."""
        wanted, block, truth = self.campaign.statistics, self.block, self.judge.truth
        construction, effects = calibrator.construction, calibrator.effects
        if self.drawn:
            calibrated = Calibrated.none(truth, construction, effects, len(block.trials))
        else:
            calibrated = calibrator.calibrate(block, self.wanted)
        columns: Columns = {"status": calibrated.status, "chi2": calibrated.chi2}
        columns[CHECKED] = np.full(len(calibrated.chi2), np.nan)
        for place in self.checked:
            columns[CHECKED][place] = calibrator.difference(block, int(place), calibrated)
        if CORRECTED_STATISTICS & {*wanted}:
            judged = self.shared | self.judge.after(block, calibrated, construction, effects)
            judged |= self._elsewhere(calibrated, calibrator)
            columns |= {
                n: column_values
                for n, column_values in judged.items()
                if (column := column_of(n)) and column.group in wanted
            }
        labels = labels_of(construction, truth.recording.instruments, effects)
        true_labels = labels_of(truth.construction, truth.recording.instruments, [law.effect for law in truth.effects])
        (values, sigma), true = calibrated.estimates, block.true_values
        if "z-scores" in wanted:
            columns |= z_scores(labels, values, sigma, true_labels, true)
        if "estimates" in wanted:
            columns |= parameter_columns(labels, values, "estimate") | parameter_columns(labels, sigma, "sigma")
        if "truth" in wanted:
            columns |= parameter_columns(true_labels, true, "true")
        return columns

    def _elsewhere(self, calibrated: Calibrated, calibrator: Calibrator) -> Columns:
        if self.new_points is None:
            return {}
        there, block, before = self.new_points
        nowhere = np.full(
            (*there.truth.state.target_points.shape, len(calibrated.chi2)), np.nan
        )  # no target is adjusted there
        after = there.after(block, replace(calibrated, points=nowhere), calibrator.construction, calibrator.effects)
        return {f"new_point_{name}": values for name, values in (before | after).items() if name.startswith("error_")}


def rows_of(campaign: Campaign, shard: int) -> int:
    """Number of rows of a shard."""
    return len(campaign.methods) * (min((shard + 1) * campaign.shard, campaign.trials) - shard * campaign.shard)
