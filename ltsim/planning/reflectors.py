"""Choice of the positions of reflectors among candidate positions (called places), for given stations.

After the elimination of the target's coordinates, each reflector contributes one term to the normal matrix of the other
unknowns. The exchange of two places is thus the difference of two small matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import InputError
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.planning.layout_scorer import LayoutPrecision, LayoutScorer
from ltsim.planning.objective import MIN_SWEEP_IMPROVEMENT, LayoutObjective
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.survey import PlannedSurvey
from ltsim.scene.visibility import nest_normals_of_smallest_incidence

MAX_REFLECTOR_SWEEPS = 8
"""Largest number of sweeps, in each of which every reflector may be exchanged once."""
MAX_SAME_PLACE_DISTANCE = 1e-3
"""Distance [m] within which a candidate position counts as the present position of a reflector, and is not listed
twice."""


@dataclass(frozen=True)
class NormalMatrixTerms:
    """Terms of the normal matrix of K unknowns (poses, gauge, parameters) after elimination of the targets.

    One term belongs to the fixed targets, and one to a reflector at each of P candidate places.
    """

    scorer: LayoutScorer
    """Evaluator of layouts whose targets are the fixed targets, followed by reflectors at all candidate positions
    (places)."""
    fixed_normal_matrix: Floats
    """Normal matrix (K, K) of K unknowns by the fixed targets, reference lengths, priors and datum."""
    place_normal_matrices: Floats
    """Contribution of a reflector at each of P candidate positions (places) to the normal matrix of K unknowns, (P, K,
    K)."""
    squared_column_norms: Floats
    """Squared norms (K,) of the columns of the design matrix of K unknowns, before elimination of targets and with
    reflectors at all candidate positions (places)."""
    target_block_inverses: Floats
    """Inverses (E, 3, 3) of the blocks of the E eliminated targets: fixed targets without those of the gauge, followed
    by reflectors at all places (`LayoutScorer.eliminate_targets`)."""
    elimination_coefficients: Floats
    """Products (E, 3, K) of two blocks of the normal matrix for each of E eliminated targets: inverse of the target's
    block, and the block that couples the target with K other unknowns."""

    @classmethod
    def from_places(
        cls, survey: PlannedSurvey, is_fixed: Bools, places: Floats, is_visible: Bools, scorer: LayoutScorer
    ) -> NormalMatrixTerms:
        """Terms for reflectors at P `places` (P, 3) [m] with the S stations of a survey of T targets.

        `is_fixed` (T,) flags the k fixed targets. `scorer` evaluates layouts with the fixed targets followed by the
        places. `is_visible` (S, k + P) flags the sights, in the same order.
        """
        count, staying = len(survey.station_positions), int(is_fixed.sum())
        stations = np.arange(count)
        only = is_visible.copy()
        only[:, staying:] = False
        alone = scorer.normal_blocks(survey.station_positions, survey.station_yaws, stations, only)
        base, squared_norms = (block[0] for block in scorer.eliminate_targets(alone, stations[None])[:2])
        t, x = (
            part[:, staying:]
            for part in scorer.whitened_derivatives(survey.station_positions, survey.station_yaws, stations, is_visible)
        )
        rows: Floats = np.zeros((len(places), count, t.shape[2], len(base)))
        for s in range(count):
            rows[:, s, :, 6 * s : 6 * s + 6] = x[s, ..., :6]
            rows[:, s, :, len(base) - x.shape[3] + 6 :] = x[s, ..., 6:]
        rows = rows.reshape(len(places), -1, len(base))
        basis = np.linalg.qr(np.swapaxes(t, 0, 1).reshape(len(places), -1, 3))[0]
        projected = rows - basis @ (np.swapaxes(basis, 1, 2) @ rows)
        all_blocks = scorer.normal_blocks(survey.station_positions, survey.station_yaws, stations, is_visible)
        _, _, inverse, weights = scorer.eliminate_targets(all_blocks, stations[None])
        squared_norms = squared_norms + np.sum(rows**2, axis=(0, 1))
        return cls(scorer, base, np.swapaxes(projected, 1, 2) @ projected, squared_norms, inverse[0], weights[0])

    def normal_matrix(self, places: Ints) -> Floats:
        """Normal matrix (K, K) of K unknowns for the fixed targets and for reflectors at some candidate positions.

        `places` holds the indices of these positions.
        """
        return self.fixed_normal_matrix + self.place_normal_matrices[places].sum(axis=0)

    def information_matrices(self, normal_matrices: Floats) -> Floats:
        """Information matrices (B, p, p) of p parameters of instrument and effects in B layouts; NaN if undetermined.

        `normal_matrices` (B, K, K) are those of the layouts, for K unknowns.
        """
        return self.scorer.information_on_parameters(
            normal_matrices, np.broadcast_to(self.squared_column_norms, normal_matrices.shape[:2])
        )

    def weighted_target_rms(self, normal_matrices: Floats, place_indices: Ints) -> Floats:
        """Weighted root mean square point error (B,) [m] of the fixed targets and of n reflectors, in B layouts.

        `normal_matrices` (B, K, K) are those of the layouts for K unknowns. `place_indices`, (n,) or (B, n), holds the
        indices of the places of the reflectors.
        """
        rows = self._target_block_indices(len(normal_matrices), place_indices)
        return self.scorer.weighted_target_rms(
            normal_matrices,
            self.target_block_inverses[rows],
            self.elimination_coefficients[rows],
            self.scorer.eliminated_target_indices[rows],
        )

    def point_error_by_name(self, normal_matrix: Floats, place_indices: Ints) -> dict[str, float]:
        """Point error [m] of each fixed target, and of the reflectors at the places `place_indices`, by name.

        `normal_matrix` (K, K) is that of the layout, for K unknowns.
        """
        at, scorer = self._target_block_indices(1, place_indices), self.scorer
        variance = scorer.squared_point_errors(
            normal_matrix[None],
            self.target_block_inverses[at],
            self.elimination_coefficients[at],
            scorer.eliminated_target_indices[at],
        )[0]
        names = [
            scorer.survey.target_names[t]
            for t in scorer.target_indices_with_gauge(scorer.eliminated_target_indices[at])[0]
        ]
        return dict(zip(names, np.sqrt(variance).tolist(), strict=True))

    def _target_block_indices(self, n_layouts: int, place_indices: Ints) -> Ints:
        """Indices in `target_block_inverses` of f fixed targets followed by n reflectors, (B, f + n), for B layouts.

        `place_indices`, (n,) or (B, n), holds the indices of the places of the reflectors.
        """
        stay = len(self.target_block_inverses) - len(self.place_normal_matrices)
        place_indices = np.broadcast_to(place_indices, (n_layouts, np.shape(place_indices)[-1]))
        return np.concatenate([np.broadcast_to(np.arange(stay), (n_layouts, stay)), stay + place_indices], axis=1)

    def objective_values(self, normal_matrices: Floats, place_indices: Ints, objective: LayoutObjective) -> Floats:
        """Objective (B,) of B layouts with n reflectors at the places with the indices `place_indices` (B, n).

        `normal_matrices` (B, K, K) are those of the layouts, for K unknowns.
        """
        information = self.information_matrices(normal_matrices)
        rms, determined = np.full(len(normal_matrices), np.nan), np.isfinite(information).all(axis=(1, 2))
        if objective.needs_target_errors:
            rms[determined] = self.weighted_target_rms(normal_matrices[determined], place_indices[determined])
        return objective.objective_values(LayoutPrecision(information, rms), self.scorer.construction.n_parameters)


def with_reflectors_at_places(
    survey: PlannedSurvey, is_fixed: Bools, places: Floats, target_names: tuple[str, ...], is_visible: Bools
) -> PlannedSurvey:
    """Survey whose targets are the fixed ones, followed by reflectors at P `places` (P, 3) [m].

    `is_fixed` (T,) flags the k fixed ones of T targets. `target_names` (P names) are those of the reflectors.
    `is_visible` (S, k + P) flags the new targets that each of S stations sees.
    """
    keep = np.flatnonzero(is_fixed)
    n_targets = len(keep) + len(places)
    rank = None if survey.target_ranks is None else np.tile(np.arange(n_targets), (len(survey.station_positions), 1))
    return survey.replace(
        target_names=(*(survey.target_names[k] for k in keep), *target_names),
        target_points=np.concatenate([survey.target_points[keep], places]),
        is_visible=is_visible,
        target_ranks=rank,
    )


@dataclass(frozen=True)
class ReflectorPlaces:
    """Positions (places) for movable reflectors: first the present positions, then candidates of the search space."""

    places: Floats
    """Coordinates (P, 3) [m] of the P positions (places) where a reflector can be."""
    place_names: tuple[str, ...]
    """Name that a reflector gets at each of the P places."""
    n_present_places: int
    """Number of places with a movable reflector at present; they are the first in the list of places."""
    is_visible: Bools
    """Flags (S, k + P): True where a station sees a target, for S stations and k fixed targets followed by P places."""
    normal_matrix_terms: NormalMatrixTerms
    """Contributions of the fixed targets and of a reflector at each place to the normal matrix."""

    @classmethod
    def from_search_space(
        cls,
        search_space: SearchSpace,
        survey: PlannedSurvey,
        is_fixed: Bools,
        objective: LayoutObjective,
        construction: GeometricErrorModel,
    ) -> ReflectorPlaces:
        """Candidate positions (places) that enough stations see and that are far enough from the fixed targets.

        `is_fixed` (T,) flags those of the T targets of `survey` that do not move. `construction` is the geometric error
        model whose parameters a calibration would estimate.
        """
        offered = (
            np.zeros((0, 3))
            if search_space.candidate_reflector_places is None
            else search_space.candidate_reflector_places
        )
        places = np.concatenate([survey.target_points[~is_fixed], offered])
        present = [name for name, stay in zip(survey.target_names, is_fixed, strict=True) if not stay]
        is_usable = _is_usable_place(search_space, survey, places)
        is_usable &= ~np.r_[
            np.zeros(len(present), bool),
            _is_near_point(survey.target_points[~is_fixed], offered, MAX_SAME_PLACE_DISTANCE),
        ]
        is_usable &= ~np.r_[
            np.zeros(len(present), bool),
            _is_near_point(survey.target_points[is_fixed], offered, search_space.min_reflector_spacing),
        ]
        names = tuple(n for n, g in zip((*present, *search_space.reflector_place_names), is_usable, strict=True) if g)
        places = places[is_usable]
        visible = search_space.is_visible(
            survey.station_positions, np.concatenate([survey.target_points[is_fixed], places])
        )
        # Sights to present reflectors are those of the survey; only new places need sights within the tolerance.
        now = np.concatenate(
            [survey.is_visible[:, is_fixed], survey.is_visible[:, ~is_fixed][:, is_usable[: len(present)]]], axis=1
        )
        visible[:, : now.shape[1]] = now
        full_survey = with_reflectors_at_places(survey, is_fixed, places, names, np.ones_like(visible))
        table = NormalMatrixTerms.from_places(
            survey, is_fixed, places, visible, LayoutScorer(full_survey, construction, objective.effects)
        )
        return cls(places, names, int(is_usable[: len(present)].sum()), visible, table)


def choose_reflectors(
    search_space: SearchSpace,
    survey: PlannedSurvey,
    is_fixed: Bools,
    objective: LayoutObjective,
    construction: GeometricErrorModel,
) -> PlannedSurvey:
    """Survey whose movable reflectors are at those present and candidate places that give the smallest objective.

    Reflectors flagged in `is_fixed` (T,), of T targets, do not move. `construction` is the geometric error model.
    Raises InputError if too few places are visible.
    """
    if search_space.candidate_reflector_places is None:
        return survey
    choice, wanted = (
        ReflectorPlaces.from_search_space(search_space, survey, is_fixed, objective, construction),
        int((~is_fixed).sum()),
    )
    places = choice.places
    if len(places) < wanted:
        raise InputError(
            f"only {len(places)} places for reflectors are visible from the stations, expected {wanted}; "
            "add places or ask for fewer"
        )
    start = _initial_reflector_places(
        places, np.arange(len(places)) < choice.n_present_places, wanted, search_space.min_reflector_spacing
    )
    chosen = _exchange_places(choice.normal_matrix_terms, objective, places, start, search_space.min_reflector_spacing)
    columns = np.r_[0 : is_fixed.sum(), is_fixed.sum() + chosen]
    return with_reflectors_at_places(
        survey, is_fixed, places[chosen], tuple(choice.place_names[i] for i in chosen), choice.is_visible[:, columns]
    )


def _is_usable_place(search_space: SearchSpace, survey: PlannedSurvey, places: Floats) -> Bools:
    """Flags (P,): True for a place that enough stations see, in an aimed nest also within the incidence limit.

    `places` (P, 3) [m] are the coordinates.
    """
    is_usable: Bools = search_space.is_visible(survey.station_positions, places).sum(axis=0) >= min(
        search_space.min_sights_per_target, len(survey.station_positions)
    )
    if search_space.is_aimed_nest.any():
        is_usable &= (
            nest_normals_of_smallest_incidence(survey.station_positions, places)[1]
            <= search_space.sight_limits.max_incidence_angle
        )
    return is_usable


def _is_near_point(points: Floats, places: Floats, distance: float) -> Bools:
    """Flags (P,): True for each of P `places` (P, 3) [m] within `distance` [m] of a point of `points` (k, 3) [m]."""
    gap = np.linalg.norm(places[:, None] - points[None], axis=2)
    return np.asarray((gap < distance).any(axis=1))


def _initial_reflector_places(places: Floats, is_present_place: Bools, n_reflectors: int, spacing: float) -> Ints:
    """Indices of initial places for `n_reflectors` reflectors: present places first, then the farthest place each time.

    The farthest place has the largest distance from all places chosen so far. `is_present_place` (P,) flags the present
    ones of the P `places` (P, 3) [m]. Raises InputError if there are too few places `spacing` [m] apart.
    """
    chosen: list[int] = np.flatnonzero(is_present_place).tolist()
    while len(chosen) < n_reflectors:
        gap = np.linalg.norm(places[:, None] - places[chosen][None], axis=2).min(axis=1, initial=np.inf)
        best = int(np.argmax(gap))
        if gap[best] < spacing:
            raise InputError(f"fewer than {n_reflectors} places for reflectors lie {spacing:g} m apart; add places")
        chosen.append(best)
    return np.array(chosen, dtype=np.int64)


def pairwise_distances(places: Floats) -> Floats:
    """Distances (P, P) [m] between all pairs of P places (P, 3) [m], computed row by row to limit the memory."""
    distances = np.empty((len(places), len(places)))
    for i, place in enumerate(places):
        distances[i] = np.linalg.norm(place - places, axis=1)
    return distances


def _exchange_places(
    table: NormalMatrixTerms, objective: LayoutObjective, places: Floats, place_indices: Ints, spacing: float
) -> Ints:
    """Indices of the places of reflectors after exchanges, one reflector at a time, until none improves the objective.

    This is the exchange algorithm of Fedorov. It starts from the places `place_indices` and keeps reflectors at least
    `spacing` [m] apart. `table` holds the terms of the normal matrix for P `places` (P, 3) [m].
    """
    place_indices = place_indices.copy()
    normal_matrix = table.normal_matrix(place_indices)
    value = float(table.objective_values(normal_matrix[None], place_indices[None], objective)[0])
    gap = pairwise_distances(places)
    for _ in range(MAX_REFLECTOR_SWEEPS):
        before = value
        for i in range(len(place_indices)):
            others = np.delete(place_indices, i)
            free = np.setdiff1d(np.flatnonzero((gap[:, others] >= spacing).all(axis=1)), place_indices)
            if not len(free):
                continue
            without = normal_matrix - table.place_normal_matrices[place_indices[i]]
            tried = np.insert(np.tile(others, (len(free), 1)), i, free, axis=1)
            values = table.objective_values(without + table.place_normal_matrices[free], tried, objective)
            best = int(np.argmin(values))
            if values[best] < value:
                place_indices[i], value = free[best], float(values[best])
                normal_matrix = without + table.place_normal_matrices[place_indices[i]]
        if value > before * (1 - MIN_SWEEP_IMPROVEMENT):
            break
    return place_indices
