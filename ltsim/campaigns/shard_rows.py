"""Rows of a shard (file of rows): trials are drawn, calibrated by every method, and compared with the true values."""

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
    estimated_effects,
    estimated_error_model,
    make_calibrator,
    stack_geometries,
)
from ltsim.campaigns.columns import (
    ResultColumns,
    append_factor_levels,
    method_table,
    parameter_labels,
    parameter_value_columns,
    z_score_columns,
)
from ltsim.campaigns.design import Factor
from ltsim.campaigns.schema import SOLVER_DIFFERENCE_COLUMN, TRIAL_STATUSES, WITHOUT_RESULT, find_result_column
from ltsim.campaigns.spec import VALIDATION_STREAM_KEY, CampaignFile
from ltsim.campaigns.store import parquet_bytes, stored_statistic_groups
from ltsim.campaigns.trial_calibrators import CalibratedBatch, TrialCalibrator
from ltsim.campaigns.trial_evaluation import TrialEvaluator
from ltsim.campaigns.true_network import TrialBatch, TrueNetwork, make_true_network
from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import InputError
from ltsim.core.randomness import TRIALS_PER_STREAM
from ltsim.physics.effects import CATALOGUE
from ltsim.physics.effects.effect import Effect
from ltsim.simulation.draws import StandardNormalSource
from ltsim.simulation.physics import make_scenario_construction, scenario_effects
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import position_stream_key
from ltsim.simulation.workshop import WorkshopLayout, planned_layout

STATISTICS_OF_CORRECTED_READINGS = {"criteria", "errors"}
"""Groups of result columns that are computed from readings corrected by the calibration."""
MAX_TRIALS_PER_STACK = 64
"""Largest number of trials with separate network geometries that are calibrated together."""
MAX_BATCH_ARRAY_VALUES = 5_000_000
"""Largest number of values (8 bytes each) in the arrays of a batch of trials. Larger batches are divided."""
BATCH_VALUES_PER_POINTING = 30
"""Number of values in memory per pointing and trial of a batch, for readings and for measured or predicted points."""
BATCH_VALUES_PER_SIGHT = 12
"""Number of values in memory per station, target and trial of a batch, for points before and after a correction."""
GEOMETRY_VALUES_PER_POINTING = 300
"""Number of values in memory per pointing of each separate network geometry, for the derivatives by 16 parameters and
the kinematic chain."""


@dataclass(frozen=True)
class ShardTask:
    """Task of a worker process: computation of one shard, a file with trials of one combination of factor levels.

    A cell is a combination of factor levels.
    """

    campaign: CampaignFile
    scenario: Scenario
    """Scenario of the cell (combination of factor levels)."""
    cell_digest: str
    """Digest of everything that determines the rows of the cell (combination of factor levels)."""
    cell: int
    """Index of the cell (combination of factor levels) in the campaign, from 0."""
    shard: int
    """Index of the file of rows (shard) in the cell (combination of factor levels), from 0."""
    validation_scenario: Scenario | None = None
    """Scenario of the held-out points; None if the campaign names none (key `validation_points`)."""
    runtime_effects: tuple[type[Effect], ...] = field(default_factory=lambda: CATALOGUE.runtime_effects)
    """Classes of effects that the user registered in this session, because worker processes do not have them."""
    existing_rows: pa.Table | None = None
    """Rows that the file of rows (shard) already contains, if trials or statistics were added to the campaign; else
    None."""

    @property
    def shard_metadata(self) -> dict[str, str]:
        """Metadata of the file of rows (shard): digest of its combination of factor levels, indices, statistics."""
        statistics = " ".join(self.campaign.statistics)
        return {
            "campaign": self.cell_digest,
            "cell": str(self.cell),
            "shard": str(self.shard),
            "statistics": statistics,
        }


@dataclass(frozen=True)
class CellContext:
    """Quantities that all trials of a cell (combination of factor levels) have in common."""

    campaign: CampaignFile
    scenario: Scenario
    """Scenario of the cell (combination of factor levels)."""
    validation_scenario: Scenario | None = None
    """Scenario of the held-out points; None if the campaign names none (key `validation_points`)."""

    @cached_property
    def shared_geometry_evaluator_and_calibrators(self) -> tuple[TrialEvaluator, list[TrialCalibrator]]:
        """Evaluator and calibrators (one per method) for the network geometry that all trials share."""
        network = make_true_network(self.scenario, self.campaign.seed)
        return TrialEvaluator(network), [make_calibrator(method, network) for method in self.campaign.methods]

    @cached_property
    def validation_evaluator(self) -> TrialEvaluator | None:
        """Evaluator for the held-out points; None if the campaign names none (key `validation_points`).

        The instruments of each trial measure these points, but no calibration uses them.
        """
        return (
            None
            if self.validation_scenario is None
            else TrialEvaluator(make_true_network(self.validation_scenario, self.campaign.seed, VALIDATION_STREAM_KEY))
        )

    @cached_property
    def factors(self) -> tuple[Factor, ...]:
        """Factors of the campaign: keys of the scenario that differ between cells (combinations of factor levels)."""
        return self.campaign.factors(self.scenario)

    @cached_property
    def levels(self) -> dict[str, Any]:
        """Levels of the factors in this cell (combination of factor levels), by name of the factor."""
        tables = self.scenario.model_dump(mode="json", by_alias=True)
        return {factor.name: factor.level_in_scenario(tables) for factor in self.factors}

    @cached_property
    def parameter_units(self) -> dict[str, str]:
        """Units of the parameters in the rows, by the label of the parameter."""
        names = tuple(self.scenario.trackers_in_use)
        labels = parameter_labels(make_scenario_construction(self.scenario), names, scenario_effects(self.scenario))
        for method in self.campaign.methods:
            labels += parameter_labels(estimated_error_model(method), names, estimated_effects(method))
        return {label.text: label.parameter.unit for label in labels}

    @cached_property
    def _planned_layout(self) -> WorkshopLayout:
        """Planned poses of the stations and positions of the targets."""
        return planned_layout(self.scenario)

    def trial_batches(
        self, first_trial: int, end_trial: int
    ) -> Iterator[tuple[TrialEvaluator, Sequence[TrialCalibrator], TrialBatch]]:
        """Evaluator, calibrators of all methods, and drawn trials for each batch of trials.

        The batches contain the trials from ``first_trial`` to ``end_trial - 1``. A trial with an impossible network
        geometry, such as a station without visible targets, is left out.
        """
        seed, methods = self.campaign.seed, self.campaign.methods
        if self.campaign.geometry == "shared":
            evaluator, calibrators = self.shared_geometry_evaluator_and_calibrators
            size = self._max_batch_trials(TRIALS_PER_STREAM, 0)
            for number in range(first_trial // size, -(-end_trial // size)):
                yield evaluator, calibrators, evaluator.true_network.draw_batch(seed, number, size)
            return
        size = self._max_batch_trials(MAX_TRIALS_PER_STACK, GEOMETRY_VALUES_PER_POINTING)
        for low in range(first_trial, end_trial, size):
            for stack, numbers in stack_geometries(self._trial_geometries(range(low, min(low + size, end_trial)))):
                yield (
                    TrialEvaluator(stack),
                    [StackCalibrator.for_stack(m, stack) for m in methods],
                    stack.draw_numbered_trials(seed, numbers),
                )

    def _max_batch_trials(self, default_number: int, geometry_values_per_pointing: int) -> int:
        """Number of trials of a batch: `default_number`, halved until the arrays have at most `MAX_BATCH_ARRAY_VALUES`.

        `geometry_values_per_pointing` is 0 if all trials share a geometry. The number does not depend on the trials
        that are requested, because sums may depend on the number of trials in a batch.
        """
        evaluators = (self.shared_geometry_evaluator_and_calibrators[0], self.validation_evaluator)
        values = 0
        for recording in (evaluator.true_network.recording for evaluator in evaluators if evaluator is not None):
            n_unknowns = 6 * len(recording.stations) + 3 * len(recording.targets)
            values += BATCH_VALUES_PER_SIGHT * len(recording.stations) * len(recording.targets)
            values += (BATCH_VALUES_PER_POINTING + geometry_values_per_pointing) * len(recording)
            values += 3 * n_unknowns**2 if geometry_values_per_pointing else 0
        size = default_number
        while size > 1 and values * size > MAX_BATCH_ARRAY_VALUES:
            size //= 2
        return size

    def _trial_geometries(self, trials: range) -> dict[int, TrueNetwork]:
        """True network geometry of each trial by its number, without trials whose geometry is impossible.

        All have the same set-up (visible targets, declared values) as the network geometry of the planned layout.
        """
        geometries, seed = {}, self.campaign.seed
        for trial in trials:
            with suppress(InputError):
                key, like = (
                    position_stream_key(trial, self.campaign.geometry),
                    self.shared_geometry_evaluator_and_calibrators[0].true_network,
                )
                geometries[trial] = make_true_network(
                    self.scenario, seed, *key, reference_network=like, planned_layout=self._planned_layout
                )
        return geometries


@lru_cache(maxsize=1)
def load_cell_context(campaign: str, scenario: str, validation_scenario: str) -> CellContext:
    """Common quantities of the trials of a cell (combination of factor levels), from JSON texts of its input.

    The last result is cached, because a worker process computes many files of rows of the same cell one after the
    other.
    """
    validation_model = Scenario.model_validate_json(validation_scenario) if validation_scenario else None
    return CellContext(
        CampaignFile.model_validate_json(campaign), Scenario.model_validate_json(scenario), validation_model
    )


def run_shard_task(task: ShardTask) -> tuple[ShardTask, bytes]:
    """Completed task without its existing rows, and the bytes of the file of rows (shard) that it computed.

    The shard is computed with one thread, so that sums have the same order in every worker process.
    """
    for kind in task.runtime_effects:
        CATALOGUE.add(kind)
    with threadpool_limits(limits=1):
        return replace(task, existing_rows=None), parquet_bytes(make_shard_rows(task), task.shard_metadata)


def make_shard_rows(task: ShardTask) -> pa.Table:
    """Rows of a shard, ordered by method and then by trial; existing rows are reused, missing rows are computed."""
    if task.existing_rows is None:
        return _compute_new_rows(task, 0)
    campaign, held = task.campaign, task.existing_rows
    new_statistics = tuple(name for name in campaign.statistics if name not in stored_statistic_groups(held))
    if not new_statistics:
        order = pa.array([method.title for method in campaign.methods])
        table = pa.concat_tables([held, _compute_new_rows(task, len(held) // len(order))], promote_options="default")
        method_indices = pa.compute.index_in(table["method"], order).to_numpy()
        return table.take(np.lexsort((table["trial"].to_numpy(), method_indices))).combine_chunks()
    if len(held) < n_rows_of_shard(campaign, task.shard):
        return _compute_new_rows(task, 0)
    reduced_campaign = campaign.model_copy(
        update={"statistics": new_statistics, "verified_trials_per_shard": 0, "stop": None}
    )
    new_rows = _compute_new_rows(replace(task, campaign=reduced_campaign), 0, truth_only=new_statistics == ("truth",))
    for column in new_rows.schema:
        held = held if column.name in held.column_names else held.append_column(column, new_rows[column.name])
    return held


def _compute_new_rows(task: ShardTask, n_existing_trials: int, *, truth_only: bool = False) -> pa.Table:
    """Rows of a file of rows (shard) for the trials after the first `n_existing_trials`, which have rows already.

    With `truth_only` the rows contain only the true values, and no trial is calibrated.
    """
    campaign, given = task.campaign, (task.campaign, task.scenario, task.validation_scenario)
    cell = load_cell_context(*("" if model is None else model.model_dump_json(by_alias=True) for model in given))
    first_trial = task.shard * campaign.trials_per_shard
    first, last = first_trial + n_existing_trials, min(first_trial + campaign.trials_per_shard, campaign.trials)
    tables_by_method: list[list[ResultColumns]] = [[] for _ in campaign.methods]
    missing_numbers = set(range(first, last))
    for evaluator, calibrators, batch in cell.trial_batches(first, last):
        numbers = batch.trial_numbers
        wanted = np.flatnonzero((numbers >= first) & (numbers < last))
        missing_numbers -= set(numbers[wanted].tolist())
        checked = wanted[numbers[wanted] < first_trial + campaign.verified_trials_per_shard]
        work = TrialBatchRowBuilder(campaign, evaluator, batch, cell.validation_evaluator, wanted, checked, truth_only)
        for part, calibrator in zip(tables_by_method, calibrators, strict=True):
            columns = {"trial": numbers} | work.method_columns(calibrator)
            part.append({name: column[wanted] for name, column in columns.items()})
    if missing_numbers:
        empty = np.full(len(missing_numbers), np.nan)
        failed = {
            "status": np.full(len(missing_numbers), TRIAL_STATUSES.index(WITHOUT_RESULT)),
            "chi2": empty,
            SOLVER_DIFFERENCE_COLUMN: empty,
        }
        for part in tables_by_method:
            part.append({"trial": np.array(sorted(missing_numbers))} | failed)
    tables = [
        method_table(task.cell, method.title, part)
        for method, part in zip(campaign.methods, tables_by_method, strict=True)
    ]
    full_table = pa.concat_tables(tables, promote_options="default").combine_chunks()
    return append_factor_levels(full_table, cell.factors, cell.levels, cell.parameter_units)


@dataclass(frozen=True)
class TrialBatchRowBuilder:
    """Builder of the rows of a campaign, for all calibration methods, from a batch of drawn trials."""

    campaign: CampaignFile
    evaluator: TrialEvaluator
    trial_batch: TrialBatch
    validation_evaluator: TrialEvaluator | None
    """Evaluator for the held-out points; None if the campaign names none (key `validation_points`)."""
    requested_trial_indices: Ints
    """Indices (requested trials,), in the batch, of the trials whose rows are requested."""
    verified_trial_indices: Ints
    """Indices, in the batch, of the trials that `lt.calibrate` calibrates again, for verification."""
    contains_only_true_values: bool = False
    """True if the rows contain only the drawn true values, and no trial is calibrated."""

    @cached_property
    def method_independent_columns(self) -> ResultColumns:
        """Result columns that do not depend on the calibration method."""
        return self.evaluator.method_independent_columns(self.trial_batch)

    @cached_property
    def validation_batch(self) -> tuple[TrialEvaluator, TrialBatch, ResultColumns] | None:
        """Measurements of the held-out points: evaluator, drawn trials, and columns that all methods share.

        The instruments of each trial measure the points. The noise is independent of the calibrated recordings; the
        effects have the same sizes. None if the campaign names no held-out points (key `validation_points`).
        """
        if self.validation_evaluator is None:
            return None
        normal_source = StandardNormalSource(self.campaign.seed, self.trial_batch.trial_numbers)
        batch = self.validation_evaluator.true_network.draw_trials(
            normal_source, self._drifted_instrument_values(), stream_key=VALIDATION_STREAM_KEY
        )
        return self.validation_evaluator, batch, self.validation_evaluator.method_independent_columns(batch)

    def _drifted_instrument_values(self) -> Floats:
        """Instrument errors when the held-out points are measured, after the random drift (key `validation_drift`).

        The shape is (instruments, parameters, trials) [SI].
        """
        values, share = self.trial_batch.instrument_values, self.campaign.validation_drift
        if not share:
            return values
        population = self.evaluator.true_network.distributions
        moves = np.array([p.unit != "ppm" for p in population.construction.parameters])
        step = StandardNormalSource(self.campaign.seed, self.trial_batch.trial_numbers)(values[:, :, 0].size, "drift")
        return values + share * (population.instrument_error_sigmas * moves)[:, :, None] * step.reshape(values.shape)

    def method_columns(self, calibrator: TrialCalibrator) -> ResultColumns:
        """Result columns of a calibration method, in the groups that the key `statistics` of the campaign selects."""
        wanted, batch, network = self.campaign.statistics, self.trial_batch, self.evaluator.true_network
        construction, effects = calibrator.construction, calibrator.effects
        if self.contains_only_true_values:
            calibrated = CalibratedBatch.from_failed_trials(network, construction, effects, len(batch.trial_numbers))
        else:
            calibrated = calibrator.calibrate(batch, self.requested_trial_indices)
        columns: ResultColumns = {"status": calibrated.status_indices, "chi2": calibrated.chi2}
        columns[SOLVER_DIFFERENCE_COLUMN] = np.full(len(calibrated.chi2), np.nan)
        for place in self.verified_trial_indices:
            columns[SOLVER_DIFFERENCE_COLUMN][place] = calibrator.largest_solver_difference(
                batch, int(place), calibrated
            )
        if STATISTICS_OF_CORRECTED_READINGS & {*wanted}:
            judged = self.method_independent_columns | self.evaluator.method_columns(
                batch, calibrated, construction, effects
            )
            judged |= self._validation_columns(calibrated, calibrator)
            columns |= {
                n: column_values
                for n, column_values in judged.items()
                if (column := find_result_column(n)) and column.group in wanted
            }
        labels = parameter_labels(construction, network.recording.instruments, effects)
        true_labels = parameter_labels(
            network.construction, network.recording.instruments, [law.effect for law in network.effects]
        )
        (values, sigma), true = calibrated.estimates_and_sigmas, batch.true_values
        if "z-scores" in wanted:
            columns |= z_score_columns(labels, values, sigma, true_labels, true)
        if "estimates" in wanted:
            columns |= parameter_value_columns(labels, values, "estimate") | parameter_value_columns(
                labels, sigma, "sigma"
            )
        if "truth" in wanted:
            columns |= parameter_value_columns(true_labels, true, "true")
        return columns

    def _validation_columns(self, calibrated_batch: CalibratedBatch, calibrator: TrialCalibrator) -> ResultColumns:
        """Result columns of a method with the errors at held-out points; empty without the key `validation_points`."""
        if self.validation_batch is None:
            return {}
        there, batch, before = self.validation_batch
        nowhere = np.full(
            (*there.true_network.state.target_points.shape, len(calibrated_batch.chi2)), np.nan
        )  # the targets of the held-out measurement are not adjusted
        columns = there.method_columns(
            batch, replace(calibrated_batch, target_errors=nowhere), calibrator.construction, calibrator.effects
        )
        return {f"new_point_{name}": values for name, values in (before | columns).items() if name.startswith("error_")}


def n_rows_of_shard(campaign: CampaignFile, shard: int) -> int:
    """Number of rows of the file of rows (shard) with the index `shard` in its cell (combination of factor levels)."""
    first_trial = shard * campaign.trials_per_shard
    return len(campaign.methods) * (min(first_trial + campaign.trials_per_shard, campaign.trials) - first_trial)
