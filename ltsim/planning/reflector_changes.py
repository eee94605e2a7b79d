"""Changes of one reflector of a planned layout (move, addition, removal) and their effect on the objective."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.units import DEGREE, MICROMETRE, MILLIMETRE
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.planning.objective import TARGETS_QUALITY_NAME, LayoutObjective
from ltsim.planning.reflectors import ReflectorPlaces, pairwise_distances
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.survey import PlannedSurvey
from ltsim.recordings.result_file import Entry, Finite, Vector


def to_millimetres(point: Floats, decimals: int = 1) -> Vector:
    """Coordinates (3,) in millimetres, rounded to a number of `decimals`, of a `point` (3,) [m], for a result file."""
    x, y, z = (round(float(v) / MILLIMETRE, decimals) for v in point)
    return x, y, z


def to_degrees(angle: float) -> float:
    """Angle in degrees (0 to 360) of an `angle` [rad], rounded to 0.01 deg, for a result file."""
    return round(float(angle) / DEGREE % 360, 2)


class ReflectorChangeEntry(Entry):
    """Change of one reflector of a plan: moved, added or removed."""

    kind: Literal["move", "add", "remove"]
    """Kind of the change: a reflector is moved, added or removed."""
    sentence: str = ""
    """Sentence on the change and its benefit."""
    reflector: str = ""
    """Name of the reflector that is moved or removed; empty for an addition."""
    new_place: str = ""
    """Name of the new position of the reflector; empty for a removal."""
    position_mm: Vector | None = None
    """Coordinates of the new position [mm] in the hall frame; null for a removal."""
    target_rms_decrease_um: Finite
    """Decrease [um], caused by the change, of the weighted root mean square point error of all reflectors except the
    changed one (datum: inner constraints); negative for an increase."""
    objective_ratio: Finite
    """Objective after the change divided by the objective of the plan; below 1 is better. If only targets have a weight
    in the goal, weighted point error of all other targets after the change divided by that before."""
    most_affected_parameter: str = ""
    """Instrument parameter (or target, if only targets have a weight in the goal) whose standard deviation the change
    reduces most. For a removal, the parameter or target whose standard deviation rises most."""
    most_affected_ratio: Finite = 1.0
    """Standard deviation of `most_affected_parameter` after the change, divided by that before; below 1 is better."""

    @property
    def action_text(self) -> str:
        """Text of the change, such as "move P3 to N1 (1.00, 2.00, 0.50) m"."""
        if self.position_mm is None:
            return f"leave out {self.reflector}"
        place = f"{self.new_place} ({', '.join(f'{v / 1000:.2f}' for v in self.position_mm)}) m"
        return f"move {self.reflector} to {place}" if self.reflector else f"add a reflector at {place}"


MIN_REPORTED_IMPROVEMENT = 0.002
"""Smallest relative improvement of the objective by a move or an addition that is reported as useful."""
MAX_NEGLIGIBLE_OBJECTIVE_CHANGE = 5e-4
"""Largest relative change of the objective by a change of a reflector that is said to make no difference."""
MAX_REPORTED_CHANGES_PER_KIND = 3
"""Largest number of reported changes of each kind (moves, additions, removals)."""

ChangeKind = Literal["move", "add", "remove"]
"""Kind of a change of a reflector."""
CHANGE_KINDS: tuple[ChangeKind, ...] = get_args(ChangeKind)
"""Kinds of changes of a reflector: move, add, remove."""
ReflectorChangeResult = tuple[float, int | None, int | None, Floats]
"""Result of a change of a reflector, four values: objective after the change divided by the objective before; index of
the removed or moved reflector (None for an addition); index of its new position (None for a removal); normal matrix (K,
K) after the change, for K unknowns without targets."""


@dataclass(frozen=True)
class ReflectorChanges:
    """Results of all changes (moves, additions, removals) of a single reflector while all other reflectors stay."""

    reported_changes: tuple[ReflectorChangeEntry, ...]
    """Reported changes: useful moves and additions, the best first, then removals with the smallest loss."""
    n_evaluated_by_kind: dict[ChangeKind, int]
    """Number of evaluated changes, by kind."""
    n_useful_by_kind: dict[ChangeKind, int]
    """Number of changes that improve the objective by at least `MIN_REPORTED_IMPROVEMENT`, by kind."""

    @property
    def summary_sentence(self) -> str:
        """Sentence on the numbers of evaluated and of useful moves and additions."""
        if not self.n_evaluated_by_kind["move"] + self.n_evaluated_by_kind["add"]:
            return (
                "No change of a reflector was tested. Give candidate places in reflectors.candidate_bodies, "
                "reflectors.places or reflectors.surfaces, and in reflectors.movable_points the points that may move."
            )
        evaluated, useful = self.n_evaluated_by_kind, self.n_useful_by_kind
        return (
            f"Tested one at a time: {evaluated['move']} moves of a reflector ({useful['move']} useful), "
            f"{evaluated['add']} additional reflectors ({useful['add']} useful). A change is useful if it improves the "
            f"objective by at least {100 * MIN_REPORTED_IMPROVEMENT:.1f} %."
        )


def evaluate_reflector_changes(
    search_space: SearchSpace,
    survey: PlannedSurvey,
    is_fixed: Bools,
    objective: LayoutObjective,
    construction: GeometricErrorModel,
) -> ReflectorChanges:
    """Results of every move, addition and removal of a single reflector of the layout of `survey`.

    Reflectors flagged in `is_fixed` (T,), of T targets, do not change. New positions are the candidate places of
    `search_space`. `construction` is the geometric error model whose parameters a calibration would estimate.
    """
    if is_fixed.all() and search_space.candidate_reflector_places is None:
        return ReflectorChanges((), dict.fromkeys(CHANGE_KINDS, 0), dict.fromkeys(CHANGE_KINDS, 0))
    return _ChangeEvaluator(
        ReflectorPlaces.from_search_space(search_space, survey, is_fixed, objective, construction),
        objective,
        search_space.min_reflector_spacing,
    ).evaluate_changes()


class _ChangeEvaluator:
    """Evaluator of changes (move, addition, removal) of single reflectors of a layout.

    `spacing` [m] is the smallest permitted distance between reflectors.
    """

    def __init__(self, movable_reflectors: ReflectorPlaces, objective: LayoutObjective, spacing: float) -> None:
        self.movable_reflectors, self.normal_matrix_terms, self.objective = (
            movable_reflectors,
            movable_reflectors.normal_matrix_terms,
            objective,
        )
        self.present_place_indices = np.arange(movable_reflectors.n_present_places)
        self.present_normal_matrix = self.normal_matrix_terms.normal_matrix(self.present_place_indices)
        self.present_objective = self.normal_matrix_terms.objective_values(
            self.present_normal_matrix[None], self.present_place_indices[None], objective
        )[0]
        self.present_sigmas = self._parameter_sigmas(self.present_normal_matrix)
        gap = pairwise_distances(movable_reflectors.places)
        self.is_too_near = gap < spacing

    @property
    def _has_target_goal_only(self) -> bool:
        """True if only the point errors of targets have a weight in the goal."""
        return not any(
            weight > 0 for name, weight in self.objective.quality_weights.items() if name != TARGETS_QUALITY_NAME
        )

    def _objective_ratios(self, normal_matrices: Floats, occupied_places: Ints, other_places: Ints) -> Floats:
        """Objectives (B,) of B layouts with n reflectors at `occupied_places` (B, n), divided by the plan's objective.

        Places are given by index. `normal_matrices` (B, K, K) are those of the layouts, for K unknowns. If only targets
        have a weight in the goal, the result is the ratio of the point errors of the reflectors at `other_places`,
        which do not change.
        """
        if self._has_target_goal_only:
            rms = self.normal_matrix_terms.weighted_target_rms
            return rms(normal_matrices, other_places) / rms(self.present_normal_matrix[None], other_places)
        return (
            self.normal_matrix_terms.objective_values(normal_matrices, occupied_places, self.objective)
            / self.present_objective
        )

    def _parameter_sigmas(self, normal_matrix: Floats) -> Floats:
        """Standard deviations (p,) of p instrument parameters, in prior sigmas, from a normal matrix (K, K).

        The K unknowns of the normal matrix are poses, gauge targets and parameters.
        """
        n_parameters = self.normal_matrix_terms.scorer.construction.n_parameters
        information = self.normal_matrix_terms.information_matrices(normal_matrix[None])[
            0, :n_parameters, :n_parameters
        ]
        return np.sqrt(np.diag(np.linalg.inv(information)))

    def _free_reflector_positions(self, used_places: Ints) -> Ints:
        """Indices of candidate positions without reflector that are far enough from the positions `used_places`."""
        open_ = np.asarray(~self.is_too_near[:, used_places].any(axis=1))
        open_[self.present_place_indices] = False
        return np.flatnonzero(open_)

    def evaluate_changes(self) -> ReflectorChanges:
        """Results of all moves, additions and removals of a single reflector while all other reflectors stay."""
        terms, chosen = self.normal_matrix_terms.place_normal_matrices, self.present_place_indices
        candidates: dict[ChangeKind, list[ReflectorChangeResult]] = {what: [] for what in CHANGE_KINDS}
        tried, helped = dict.fromkeys(CHANGE_KINDS, 0), dict.fromkeys(CHANGE_KINDS, 0)

        def record_change(kind: ChangeKind, removed_index: int | None, places: Ints) -> None:
            """Storage of the results of a removal, of all additions, or of the best move of a reflector.

            `places` are the indices of the candidate positions for an addition or a move.
            """
            other_places = chosen if removed_index is None else np.delete(chosen, removed_index)
            start_matrix = (
                self.present_normal_matrix
                if removed_index is None
                else self.present_normal_matrix - terms[chosen[removed_index]]
            )
            occupied_places = np.column_stack([np.tile(other_places, (len(places), 1)), places])
            normal_matrices = start_matrix + terms[places]
            if kind == "remove":
                occupied_places, normal_matrices = other_places[None], start_matrix[None]
            if not len(occupied_places):
                return
            objective_factors = self._objective_ratios(normal_matrices, occupied_places, other_places)
            tried[kind] += len(objective_factors)
            helped[kind] += int(np.sum(objective_factors < 1 - MIN_REPORTED_IMPROVEMENT))
            for k in np.argsort(objective_factors)[: 1 if kind == "move" else None].tolist():
                place = None if kind == "remove" else int(places[k])
                candidates[kind].append((float(objective_factors[k]), removed_index, place, normal_matrices[k]))

        for i in range(len(chosen)):
            record_change("move", i, self._free_reflector_positions(np.delete(chosen, i)))
            record_change("remove", i, chosen[:0])
        record_change("add", None, self._free_reflector_positions(chosen))
        reported: list[ReflectorChangeEntry] = []
        for what, made in candidates.items():
            best = _best_change_per_place(sorted(made, key=lambda pair: pair[0]))[:MAX_REPORTED_CHANGES_PER_KIND]
            reported += [
                self._change_entry(what, *change)
                for change in best
                if what == "remove" or change[0] < 1 - MIN_REPORTED_IMPROVEMENT
            ]
        return ReflectorChanges(tuple(reported), tried, helped)

    def _change_entry(
        self, kind: ChangeKind, value: float, removed_index: int | None, place_index: int | None, normal_matrix: Floats
    ) -> ReflectorChangeEntry:
        """Entry of plan.json for a change of a reflector.

        `value` is the objective after the change divided by that before, `removed_index` the index of the reflector
        that leaves its place, `place_index` that of its new place, `normal_matrix` the normal matrix after the change.
        """
        present_indices = self.present_place_indices
        remaining_places = present_indices if removed_index is None else np.delete(present_indices, removed_index)
        matrices = np.stack([self.present_normal_matrix, normal_matrix])
        before, after = self.normal_matrix_terms.weighted_target_rms(matrices, remaining_places)
        if self._has_target_goal_only:
            now = self.normal_matrix_terms.point_error_by_name(self.present_normal_matrix, remaining_places)
            ratios = {
                name: s / now[name]
                for name, s in self.normal_matrix_terms.point_error_by_name(normal_matrix, remaining_places).items()
            }
        else:
            ratio = self._parameter_sigmas(normal_matrix) / self.present_sigmas
            ratios = dict(
                zip(self.normal_matrix_terms.scorer.construction.parameter_names, ratio.tolist(), strict=True)
            )
        affected_parameter = (min if kind != "remove" else max)(ratios, key=lambda name: ratios[name])
        names, places = self.movable_reflectors.place_names, self.movable_reflectors.places
        change = ReflectorChangeEntry(
            kind=kind,
            reflector="" if removed_index is None else names[removed_index],
            new_place="" if place_index is None else names[place_index],
            position_mm=None if place_index is None else to_millimetres(places[place_index]),
            target_rms_decrease_um=float(before - after) / MICROMETRE,
            objective_ratio=value,
            most_affected_parameter=affected_parameter,
            most_affected_ratio=float(ratios[affected_parameter]),
        )
        return change.model_copy(update={"sentence": _change_sentence(change)})


def _change_sentence(change: ReflectorChangeEntry) -> str:
    """Sentence on a change and its benefit, without a full stop."""
    if abs(1 - change.objective_ratio) < MAX_NEGLIGIBLE_OBJECTIVE_CHANGE:
        return f"{change.action_text}: makes no difference"
    better = f"{100 * abs(1 - change.objective_ratio):.1f} % {'better' if change.objective_ratio <= 1 else 'worse'}"
    decrease = change.target_rms_decrease_um
    other = f"{abs(decrease):.2f} um {'less' if decrease >= 0 else 'more'} error of the other points"
    sigma = 100 * (change.most_affected_ratio - 1)
    parameter = change.most_affected_parameter
    return f"{change.action_text}: quality {better}, {other}, sigma of {parameter} {sigma:+.1f} %"


def _best_change_per_place(change_results: list[ReflectorChangeResult]) -> list[ReflectorChangeResult]:
    """Best change for each new position of a reflector, and all removals, from results with the best change first."""
    distinct, places = [], set()
    for change in change_results:
        if change[2] is None or change[2] not in places:
            distinct.append(change)
        places.add(change[2])
    return distinct
