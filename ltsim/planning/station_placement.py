"""Choice of the positions of stations among candidate positions on the floor, by the targets visible from each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import InputError
from ltsim.planning.layout_rules import SpacingRule, sees_enough_targets

N_DRAWN_PLACES_PER_STATION = 24
"""Number of candidate positions that are drawn for each station of a random layout; the best of them is used."""
MAX_BRANCH_AND_BOUND_NODES = 3000
"""Largest number of nodes of the branch-and-bound tree in the choice of station positions. A few nodes were sufficient
in all halls that were tested."""
MAX_RANDOM_TIE_BREAKER_COST = 1e-4
"""Largest random cost of a candidate position in the choice of positions, where a missing sight costs 1. The random
costs make each random draw of a layout different."""


@dataclass(frozen=True)
class StationPlacement:
    """Candidate positions of stations, together with fixed stations, and choice of positions for a layout."""

    candidate_positions: Floats
    """Coordinates (N, 3) [m] of the N candidate positions."""
    is_visible: Bools
    """Flags (N, T): True where one of T targets is visible from one of N candidate positions."""
    spacing_rule: SpacingRule
    """Rule on the horizontal distance of two stations."""
    fixed_positions: Floats
    """Positions (F, 3) [m] of the F fixed stations."""
    n_fixed_sights: Ints
    """Number (T,) of fixed stations that see each of T targets."""

    @classmethod
    def from_grid(
        cls,
        positions: Floats,
        is_visible: Bools,
        spacing_rule: SpacingRule,
        fixed_positions: Floats,
        n_fixed_sights: Ints,
    ) -> StationPlacement:
        """Placement at those of N positions (N, 3) [m] that see enough targets for the pose of a station.

        `is_visible` (N, T) flags the sights. Raises InputError if no position sees enough targets.
        """
        is_sufficient = sees_enough_targets(is_visible)
        if not is_sufficient.any():
            raise InputError("no position on the floor sees three points; enlarge the floor, or move obstacles")
        return cls(positions[is_sufficient], is_visible[is_sufficient], spacing_rule, fixed_positions, n_fixed_sights)

    def place_stations(
        self, n_stations: int, wanted_sights: int, random_generator: np.random.Generator | None = None
    ) -> list[int]:
        """Indices of candidate positions for `n_stations` stations, so that `wanted_sights` stations see each target.

        If that is not possible, as few sights as possible are missing. With `random_generator` each station is at the
        best of a few random positions, so that draws differ.
        """
        place_indices: list[int] = []
        while (
            len(place_indices) < n_stations
            and (place := self._best_candidate_position(place_indices, wanted_sights, random_generator)) >= 0
        ):
            place_indices.append(place)
        if len(place_indices) == n_stations and not self.missing_sights(place_indices, wanted_sights).any():
            return place_indices
        return self._optimal_places(n_stations, wanted_sights, random_generator) or place_indices

    def missing_sights(self, place_indices: list[int], wanted_sights: int) -> Ints:
        """Number (T,) of sights that each of T targets lacks to have `wanted_sights`.

        Stations are at the candidate positions with the indices `place_indices`, in addition to the fixed stations.
        """
        return np.asarray(
            np.maximum(wanted_sights - self.n_fixed_sights - self.is_visible[place_indices].sum(axis=0), 0)
        )

    def _best_candidate_position(
        self, used_places: list[int], wanted_sights: int, random_generator: np.random.Generator | None
    ) -> int:
        """Index of the candidate position that sees most targets with too few sights; -1 if all are too near.

        `used_places` are the indices of the positions of earlier stations. Sights beyond `wanted_sights` have a small
        weight. With `random_generator` only a few random positions are compared.
        """
        n_candidates = len(self.candidate_positions)
        candidate_order = (
            np.arange(n_candidates)
            if random_generator is None
            else random_generator.integers(n_candidates, size=min(N_DRAWN_PLACES_PER_STATION, n_candidates))
        )
        present_sights = self.n_fixed_sights + self.is_visible[used_places].sum(axis=0)
        added_sights = (
            (
                np.minimum(present_sights + self.is_visible[candidate_order], wanted_sights)
                - np.minimum(present_sights, wanted_sights)
            )
            .sum(axis=1)
            .astype(np.float64)
        )
        added_sights += 1e-3 * (self.is_visible[candidate_order] / (1.0 + present_sights) ** 2).sum(axis=1)
        for place in (*self.fixed_positions, *self.candidate_positions[used_places]):
            distance = np.linalg.norm(self.candidate_positions[candidate_order, :2] - place[:2], axis=1)
            added_sights[self.spacing_rule.is_too_near(distance)] = -1.0
        return int(candidate_order[np.argmax(added_sights)]) if added_sights.max(initial=-1.0) >= 0.0 else -1

    def _optimal_places(
        self, n_stations: int, wanted_sights: int, random_generator: np.random.Generator | None
    ) -> list[int]:
        """Indices of the positions with the fewest missing sights; empty if all are too near each other.

        The positions are the solution of a mixed-integer linear program; random costs make it different in each draw.
        """
        from scipy.optimize import Bounds, LinearConstraint, milp  # slow to load, and only a search of layouts needs it

        places, targets = self.is_visible.shape
        gap = np.linalg.norm(self.candidate_positions[:, None, :2] - self.fixed_positions[None, :, :2], axis=2)
        free = ~self.spacing_rule.is_too_near(gap).any(axis=1)
        is_too_near = self.spacing_rule.is_too_near(
            np.linalg.norm(self.candidate_positions[:, None, :2] - self.candidate_positions[None, :, :2], axis=2)
        )
        first, second = np.nonzero(np.triu(is_too_near, 1))
        rows = np.arange(len(first))
        pair_matrix = sp.csr_array(
            (np.ones(2 * len(first)), (np.r_[rows, rows], np.r_[first, second])), (len(first), places)
        )
        sights = sp.hstack([sp.csr_array(self.is_visible.T.astype(np.float64)), sp.eye_array(targets)])
        need = np.maximum(wanted_sights - self.n_fixed_sights, 0)
        limits = [
            LinearConstraint(sights, need, np.inf),
            LinearConstraint(np.r_[np.ones(places), np.zeros(targets)][None], n_stations, n_stations),
        ]
        if len(first):
            limits.append(LinearConstraint(sp.hstack([pair_matrix, sp.csr_array((len(first), targets))]), -np.inf, 1.0))
        cost = (
            np.zeros(places)
            if random_generator is None
            else MAX_RANDOM_TIE_BREAKER_COST * random_generator.random(places)
        )
        solution = milp(
            np.r_[cost, np.ones(targets)],
            constraints=limits,
            integrality=np.r_[np.ones(places), np.zeros(targets)],
            bounds=Bounds(0.0, np.r_[free.astype(np.float64), np.full(targets, float(wanted_sights))]),
            options={"node_limit": MAX_BRANCH_AND_BOUND_NODES},
        )
        return [] if solution.x is None else np.flatnonzero(solution.x[:places] > 0.5).tolist()
