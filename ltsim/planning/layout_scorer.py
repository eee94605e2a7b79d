"""Information matrices of many layouts at once: normal equations in blocks, targets eliminated analytically.

A set-up is a station at a position with a yaw. A search first computes the contribution of each candidate set-up to the
normal equations once (`NormalBlocks`). `LayoutScorer.evaluate_layouts` then adds the contributions of the set-ups of a
layout and eliminates targets (3 x 3 blocks) and poses (leading rows of a Cholesky factor). The information on
parameters of instrument and effects remains.

Readings are linearised by the geometric error model; constraints and priors come from the adjustment. A test compares
the results with those of `expected_precision.py`, which uses no blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.problem import DATUM_CONSTRAINT_SIGMAS, NetworkProblem
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.geometry.rigid import cross_matrix, determines_pose, rigid_motion_jacobian, rotation_about_z
from ltsim.physics.effects.air import turbulence_variance
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import GeometricErrorModel, misalignment_construction
from ltsim.physics.model.incidence import IncidenceErrors
from ltsim.physics.model.measurement import MeasurementModel
from ltsim.planning.normal_blocks import NormalBlocks
from ltsim.planning.survey import PlannedSurvey
from ltsim.scene.sightings import Sightings
from ltsim.solve.design import POINT_RANK_TOLERANCE, cholesky_where_determined, scale_to_unit_diagonal, to_dense

NORMAL_EQUATION_LENGTH_UNIT = 1e-5
"""Unit [m, rad] of poses and targets in the normal equations, chosen so that all columns have a similar norm."""


def incidence_error_flags(incidence_errors: IncidenceErrors, pointing_targets: Ints, n_targets: int) -> Floats:
    """Flags (T,) of T targets: 1 if the effect `incidence_errors` acts on the reflector of a target, otherwise 0.

    `incidence_errors` are range errors that depend on the angle of incidence at a reflector. `pointing_targets` (n,)
    holds the index of the target of each of n pointings.
    """
    indicator = np.zeros(n_targets)
    np.maximum.at(indicator, pointing_targets, incidence_errors.reflector_indicator)
    return indicator


@dataclass(frozen=True)
class LayoutPrecision:
    """Precision of B layouts: information on P parameters after elimination of all other unknowns, and point errors."""

    information_matrices: Floats
    """Information matrices (B, P, P) of B layouts for P parameters of instrument and effects, in units of their prior
    sigmas; NaN for a layout with an undetermined pose."""
    weighted_target_rms: Floats
    """Weighted root mean square point error (B,) [m] of the targets in B layouts, with the mean of the targets as
    datum; NaN if not requested, or for an undetermined pose."""


class LayoutScorer:
    """Evaluator of many layouts in one workshop: targets, gauge, noise and priors are fixed, set-ups vary.

    `survey` defines everything except the poses of the stations; all layouts have as many stations as `survey`. The
    parameters are those of the error model `construction` (default 16 misalignments) and of `effects`, in units of
    their prior sigmas. The information contains the priors of instrument parameters but not those of effects.
    """

    def __init__(
        self, survey: PlannedSurvey, construction: GeometricErrorModel | None = None, effects: Sequence[Effect] = ()
    ) -> None:
        self.survey, self.effects = survey, tuple(effects)
        self.construction = construction or misalignment_construction()
        full_survey = survey.replace(is_visible=np.ones_like(survey.is_visible))
        pointings, state = (
            full_survey.noise_free_recording(self.construction),
            full_survey.nominal_state(self.construction),
        )
        # Ranges from the initial positions may not determine all unknowns: only rows common to all layouts are used.
        problem = (
            Adjustment.from_plan(pointings, state, self.construction).problem
            if survey.records_angles
            else NetworkProblem.from_model(MeasurementModel(pointings, self.construction))
        )
        self._n_free_motions, self._free_motions = problem.free_motions.shape[1], problem.free_motions
        self._plumb_directions = np.full((self.n_stations, 3), np.nan)
        self._plumb_directions[problem.level_rows.station_indices] = problem.level_rows.plumb_directions
        self.prior_sigma = problem.prior.sigma[0]
        self._incidence_errors = [
            (e, incidence_error_flags(e, pointings.target, len(survey.target_points)))
            for e in problem.model.incidence_errors
        ]
        self._n_nuisances = sum(len(errors.parameters) for errors in problem.model.incidence_errors)
        effect_sigmas = [p.prior_sigma for effect in self.effects for p in effect.parameters]
        self.parameter_scales = np.concatenate(
            [np.ones(self._n_nuisances), self.prior_sigma, np.array(effect_sigmas, dtype=np.float64)]
        )
        self._gauge_targets = np.flatnonzero(problem.unknowns.target_columns[:, 0] < problem.unknowns.n_retained)
        self.eliminated_target_indices = np.flatnonzero(
            problem.unknowns.target_columns[:, 0] >= problem.unknowns.n_retained
        )
        other_rows = problem.linearise(state).design[int(problem.is_used_reading.sum()) :]
        other = to_dense(other_rows[: other_rows.shape[0] - self._n_free_motions])
        unknowns = problem.unknowns
        value_columns = np.concatenate([unknowns.effect_columns[: self._n_nuisances], unknowns.instrument_columns[0]])
        self._store_shared_blocks(other, unknowns.target_columns, unknowns.pose_columns, value_columns)
        self._target_weights, self._used_observables = survey.normalised_target_weights, survey.is_recorded_observable
        self._fixes_datum_rotations = problem.undetermined_unknowns.fixes_datum_rotations
        self._target_motions = rigid_motion_jacobian(survey.target_points) @ self._free_motions

    def _store_shared_blocks(
        self, design: Floats, target_columns: Ints, pose_columns: Ints, parameter_columns: Ints
    ) -> None:
        """Storage of the contributions to the normal equations that all layouts share (gauge, levels, priors, ...).

        `design` is the whitened design matrix of these observations. `target_columns` (T, 3), `pose_columns` (S, 6) and
        `parameter_columns` are the indices of its columns for T targets, S poses and parameters.
        """
        extra = np.zeros((len(design), len(self.parameter_scales) - len(parameter_columns)))
        front = [
            design[:, pose_columns.ravel()] * NORMAL_EQUATION_LENGTH_UNIT,
            design[:, target_columns[self._gauge_targets].ravel()] * NORMAL_EQUATION_LENGTH_UNIT,
        ]
        reduced_rows = np.hstack(
            [*front, design[:, parameter_columns] * self.parameter_scales[: len(parameter_columns)], extra]
        )
        mesh = (
            design[:, target_columns[self.eliminated_target_indices].ravel()].reshape(len(design), -1, 3)
            * NORMAL_EQUATION_LENGTH_UNIT
        )
        self._fixed_reduced_block = reduced_rows.T @ reduced_rows
        self._fixed_target_blocks = np.einsum("mti,mtj->tij", mesh, mesh)
        self._fixed_coupling_blocks = np.einsum("mti,mk->tik", mesh, reduced_rows)

    @property
    def n_stations(self) -> int:
        """Number of stations of each layout."""
        return len(self.survey.station_positions)

    def sightings(self, position: Floats, yaw: Floats, station_indices: Ints) -> Sightings:
        """Sightings of every target in each face from N set-ups at `position` (N, 3) [m] with `yaw` (N,) [rad].

        `station_indices` (N,) holds the index of the station that each set-up replaces; it defines time and name.
        """
        survey = self.survey
        axes = np.arange(len(position)), np.arange(len(survey.target_points)), np.array(survey.faces)
        station, target, face = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        turn = survey.pointing_ranks(station_indices[station], target, face)
        visit = survey.seconds_per_move + len(survey.target_points) * len(survey.faces) * survey.seconds_per_pointing
        nests = [survey.setup.targets.get(name) for name in survey.target_names]
        nest_normals = [(nest and nest.nest_normal) or (np.nan, np.nan, np.nan) for nest in nests]
        normal = np.array(nest_normals, dtype=np.float64)
        return Sightings(
            station=station,
            target=target,
            instrument=np.zeros(len(station), dtype=np.int64),
            face=face,
            repeat=np.ones(len(station), dtype=np.int64),
            time=station_indices[station] * visit + turn * survey.seconds_per_pointing,
            station_positions=position,
            station_rotations=np.stack([rotation_about_z(float(angle)) for angle in yaw]),
            target_points=survey.target_points,
            nest_normals=normal / np.linalg.norm(normal, axis=1, keepdims=True),
            is_reaimed=np.array([nest is None or nest.reaimed for nest in nests], dtype=bool),
            station_names=tuple(survey.station_names[s] for s in station_indices),
            target_names=survey.target_names,
        )

    def whitened_derivatives(
        self, position: Floats, yaw: Floats, station_indices: Ints, is_visible: Bools
    ) -> tuple[Floats, Floats]:
        """Whitened derivatives of r readings of each of T targets from N set-ups, by the target and by other unknowns.

        The set-ups are at `position` (N, 3) [m] with `yaw` (N,) [rad]; `station_indices` (N,) are those of the stations
        that they replace. The derivatives by the target are (N, T, r, 3), those by the pose followed by P parameters
        (N, T, r, 6 + P). They are zero where `is_visible` (N, T) is False. The first station is always included in the
        computation, as some effects depend on the time since its first pointing.
        """
        if self.effects and station_indices.min() > 0:
            first = position[:1], yaw[:1], np.zeros(1, dtype=np.int64)
            whole = (np.concatenate(pair) for pair in zip(first, (position, yaw, station_indices), strict=True))
            by_target, by_value = self._whitened_pointing_derivatives(self.sightings(*whole))
            n_first_rows = len(self.survey.target_points) * len(self.survey.faces)
            by_target, by_value = by_target[n_first_rows:], by_value[n_first_rows:]
        else:
            by_target, by_value = self._whitened_pointing_derivatives(self.sightings(position, yaw, station_indices))
        weight = (np.sqrt(self.survey.repeats) * is_visible)[:, :, None, None]
        shape = (*is_visible.shape, 3 * len(self.survey.faces))
        t, v = by_target.reshape(*shape, 3) * weight, by_value.reshape(*shape, -1) * weight
        rotation_rows = t @ cross_matrix(self.survey.target_points[None] - position[:, None])
        return t, np.concatenate([-t, rotation_rows, v], axis=3)

    def _whitened_pointing_derivatives(self, sightings: Sightings) -> tuple[Floats, Floats]:
        """Whitened derivatives of the readings of n pointings by target (n, 3, 3), and by P parameters (n, 3, P)."""
        by_point, by_value = self.construction.reading_design(
            sightings.ideal_raw_readings, np.zeros(self.construction.n_parameters)
        )
        by_target = by_point @ np.swapaxes(sightings.station_rotations[sightings.station], 1, 2)
        reflectors = [
            replace(e, reflector_indicator=acts[sightings.target]).design(sightings)
            for e, acts in self._incidence_errors
        ]
        designs = [*reflectors, by_value, *(effect.design(sightings) for effect in self.effects)]
        sigma = self.survey.noise_sigmas(sightings)
        if self.survey.air is not None:
            sigma = np.sqrt(sigma**2 + turbulence_variance(self.survey.air, sightings))
        white = (self._used_observables / sigma)[:, :, None]
        return by_target * (white * NORMAL_EQUATION_LENGTH_UNIT), np.concatenate(designs, axis=2) * (
            white * self.parameter_scales
        )

    def normal_blocks(
        self, position: Floats, yaw: Floats, station_indices: Ints | None = None, is_visible: Bools | None = None
    ) -> NormalBlocks:
        """Contributions of N set-ups at `position` (N, 3) [m] with `yaw` (N,) [rad] to the normal equations.

        `station_indices` (N,) holds the index of the station that each set-up replaces, default 0; some effects depend
        on the time or name of the station. `is_visible` (N, T) is True where a set-up measures one of T targets,
        default everywhere.
        """
        station_of_position = np.zeros(len(position), dtype=np.int64) if station_indices is None else station_indices
        is_visible = (
            np.ones((len(position), len(self.survey.target_points)), dtype=bool) if is_visible is None else is_visible
        )
        t, x = self.whitened_derivatives(position, yaw, station_of_position, is_visible)
        flattened = x.reshape(len(position), -1, x.shape[3])
        across = np.swapaxes(t, 2, 3)
        has_pose = determines_pose(self.survey.target_points, is_visible, self._plumb_directions[station_of_position])
        return NormalBlocks(
            position, yaw, is_visible, has_pose, across @ t, across @ x, np.swapaxes(flattened, 1, 2) @ flattened
        )

    def evaluate_layouts(
        self, blocks: NormalBlocks, setup_indices: Ints, *, with_target_errors: bool = False
    ) -> LayoutPrecision:
        """Precision of B layouts of S stations: information on parameters, and point errors if `with_target_errors`.

        Each row of `setup_indices` (B, S) has the indices in `blocks` of the set-ups of one layout.
        """
        schur, squared_norms, inverses, coefficients = self.eliminate_targets(blocks, setup_indices)
        n_parameters = len(self.parameter_scales) - self._n_nuisances
        information, rms = np.full((len(schur), n_parameters, n_parameters), np.nan), np.full(len(schur), np.nan)
        has_poses = blocks.has_determined_pose[setup_indices].all(axis=1) & np.isfinite(schur[:, 0, 0])
        information[has_poses] = self.information_on_parameters(schur[has_poses], squared_norms[has_poses])
        if with_target_errors:
            determined = np.isfinite(information).all(axis=(1, 2))
            rms[determined] = self.weighted_target_rms(
                schur[determined], inverses[determined], coefficients[determined], self.eliminated_target_indices
            )
        return LayoutPrecision(information, rms)

    def information_on_parameters(self, schur: Floats, squared_norms: Floats) -> Floats:
        """Information (B, P, P) on P parameters of instrument and effects in B layouts; NaN for undetermined unknowns.

        `schur` (B, K, K) are normal matrices of K unknowns; all unknowns except the parameters are eliminated from
        them. `squared_norms` (B, K) are the squared norms of the columns of the design matrices, relative to which a
        small pivot counts as an undetermined unknown.
        """
        unit, scale = scale_to_unit_diagonal(schur, squared_norms)
        roots, _ = cholesky_where_determined(unit)
        parameter_slice = slice(schur.shape[1] - len(self.parameter_scales) + self._n_nuisances, schur.shape[1])
        corner = roots[:, parameter_slice, parameter_slice] / scale[:, parameter_slice, None]
        return corner @ np.swapaxes(corner, 1, 2)

    def eliminate_targets(self, blocks: NormalBlocks, setup_indices: Ints) -> tuple[Floats, Floats, Floats, Floats]:
        """Normal matrices of B layouts after elimination of E targets, squared column norms, arrays for the targets.

        The matrices of the K remaining unknowns are Schur complements (B, K, K), NaN for an undetermined target. The
        squared norms (B, K) of the columns of the design matrix are those before the elimination. The last two arrays
        are the inverse blocks (B, E, 3, 3) of the targets, and their products (B, E, 3, K) with the coupling blocks.
        """
        reduced, tt, tk = self._normal_matrices(blocks, setup_indices)
        if not self._used_observables.all():  # with range and angles every target is determined
            spread = np.linalg.eigvalsh(tt)
            open_ = spread[..., 0] <= POINT_RANK_TOLERANCE * spread[..., 2]
            tt = tt + open_[..., None, None] * np.eye(3)
            reduced[open_.any(axis=1)] = np.nan
        inverses = np.asarray(np.linalg.inv(tt), dtype=np.float64)
        coefficients = inverses @ tk
        width = reduced.shape[1]
        flat, flat_weights = tk.reshape(len(reduced), -1, width), coefficients.reshape(len(reduced), -1, width)
        schur = reduced - np.swapaxes(flat, 1, 2) @ flat_weights
        return 0.5 * (schur + np.swapaxes(schur, 1, 2)), np.einsum("bkk->bk", reduced), inverses, coefficients

    def _normal_matrices(self, blocks: NormalBlocks, setup_indices: Ints) -> tuple[Floats, Floats, Floats]:
        """Blocks of the normal matrices of B layouts, for E targets that are eliminated later and K other unknowns.

        The blocks are those of the other unknowns (B, K, K), those of the targets (B, E, 3, 3), and those that couple
        targets with other unknowns (B, E, 3, K). `setup_indices` (B, S) holds the indices in `blocks` of the S set-ups
        of each layout.
        """
        layouts, stations = setup_indices.shape
        params, gauge = len(self.parameter_scales), len(self._gauge_targets)
        n_unknowns = 6 * stations + 3 * gauge + params
        reduced = np.broadcast_to(self._fixed_reduced_block, (layouts, n_unknowns, n_unknowns)).copy()
        tk = np.zeros((layouts, len(self.survey.target_points), 3, n_unknowns))
        tt = np.zeros((layouts, len(self.survey.target_points), 3, 3))
        parameter_slice = slice(n_unknowns - params, n_unknowns)
        for s in range(stations):
            which = setup_indices[:, s]
            at = slice(6 * s, 6 * s + 6)
            xx, tx = blocks.pose_blocks[which], blocks.coupling_blocks[which]
            reduced[:, at, at] += xx[:, :6, :6]
            reduced[:, at, parameter_slice] += xx[:, :6, 6:]
            reduced[:, parameter_slice, at] += xx[:, 6:, :6]
            reduced[:, parameter_slice, parameter_slice] += xx[:, 6:, 6:]
            tk[:, :, :, at] = tx[:, :, :, :6]
            tk[:, :, :, parameter_slice] += tx[:, :, :, 6:]
            tt += blocks.target_blocks[which]
        for g, t in enumerate(self._gauge_targets):
            at = slice(6 * stations + 3 * g, 6 * stations + 3 * g + 3)
            reduced[:, at, :] += tk[:, t]
            reduced[:, :, at] += np.swapaxes(tk[:, t], 1, 2)
            reduced[:, at, at] += tt[:, t]
        if self._n_free_motions:
            datum = self._datum_rows(blocks.setup_positions[setup_indices])
            pose_columns = slice(0, datum.shape[2])
            reduced[:, pose_columns, pose_columns] += np.swapaxes(datum, 1, 2) @ datum
        mesh = tt[:, self.eliminated_target_indices] + self._fixed_target_blocks
        unseen = np.einsum("beii->be", mesh) == 0.0
        return (
            reduced,
            mesh + unseen[:, :, None, None] * np.eye(3),
            tk[:, self.eliminated_target_indices] + self._fixed_coupling_blocks,
        )

    def _datum_rows(self, position: Floats) -> Floats:
        """Whitened rows (B, f, 6 a) that fix f free rigid motions of B layouts of stations at `position` (B, S, 3) [m].

        The rows constrain the poses of the first a stations. With angles a = 1; with ranges alone a = S, and only the
        positions are constrained.
        """
        motion = self._free_motions / np.linalg.norm(self._free_motions, axis=0)
        anchors = position[:, :1] if self._fixes_datum_rotations else position
        datum_rows = np.broadcast_to(motion.T[:, None], (len(anchors), motion.shape[1], anchors.shape[1], 6)).copy()
        datum_rows[..., :3] += np.cross(datum_rows[..., 3:], anchors[:, None])
        datum_rows[..., 3:] *= self._fixes_datum_rotations
        return (datum_rows / DATUM_CONSTRAINT_SIGMAS * NORMAL_EQUATION_LENGTH_UNIT).reshape(
            len(datum_rows), motion.shape[1], -1
        )

    def weighted_target_rms(self, schur: Floats, inverses: Floats, coefficients: Floats, targets: Ints) -> Floats:
        """Weighted root mean square point error (B,) [m] of targets in B layouts, with the survey's target weights.

        `schur` (B, K, K), `inverses` (B, E, 3, 3) and `coefficients` (B, E, 3, K) are results of `eliminate_targets`.
        `targets`, (E,) or (B, E), holds the indices of the E targets in the survey.
        """
        variance = self.squared_point_errors(schur, inverses, coefficients, targets)
        weight = self._target_weights[self.target_indices_with_gauge(targets)]
        return np.sqrt(np.sum(weight * variance, axis=1) / np.sum(weight * np.ones_like(variance), axis=1))

    def target_indices_with_gauge(self, targets: Ints) -> Ints:
        """Indices of the given targets followed by those of the gauge: (1, n) for all layouts, or (B, n) for B layouts.

        `targets` holds indices in the survey: (E,) for E targets, or (B, E) if they differ between B layouts.
        """
        indices = np.atleast_2d(targets)
        return np.concatenate(
            [indices, np.broadcast_to(self._gauge_targets, (len(indices), len(self._gauge_targets)))], axis=1
        )

    def squared_point_errors(self, schur: Floats, inverses: Floats, coefficients: Floats, targets: Ints) -> Floats:
        """Squared point errors (B, E + gauge) [m^2] of E targets and the gauge targets in B layouts.

        The datum is the mean of all these targets (inner constraints). Parameters of the instrument and of reflectors
        are estimated, effects are not. `schur` (B, K, K) for K unknowns, `inverses` (B, E, 3, 3) and `coefficients` (B,
        E, 3, K) are results of `eliminate_targets`. `targets`, (E,) or (B, E), holds the indices of the E targets in
        the survey.
        """
        estimated = self._n_nuisances + len(self.prior_sigma)
        layouts, size = len(schur), schur.shape[1] - (len(self.parameter_scales) - estimated)
        covariance = np.linalg.inv(schur[:, :size, :size])
        count, gauge = inverses.shape[1], len(self._gauge_targets)
        carry = np.zeros((layouts, count + gauge, 3, size))
        carry[:, :count] = -coefficients[..., :size]
        first_target_column = size - estimated - 3 * gauge
        for g in range(gauge):
            carry[:, count + g, :, first_target_column + 3 * g : first_target_column + 3 * g + 3] = np.eye(3)
        motion = np.broadcast_to(
            self._target_motions.reshape(-1, 3, self._n_free_motions)[self.target_indices_with_gauge(targets)],
            (layouts, count + gauge, 3, self._n_free_motions),
        )
        # Inner constraints: the errors of each target without the rigid motion of all targets.
        axes = 3 * (count + gauge)
        rows = motion.reshape(layouts, axes, self._n_free_motions)
        held = np.swapaxes(rows @ np.linalg.inv(np.swapaxes(rows, 1, 2) @ rows), 1, 2)
        flattened = carry.reshape(layouts, axes, size)
        constrained = flattened - rows @ (held @ flattened)
        part = held.reshape(layouts, self._n_free_motions, count + gauge, 3).transpose(0, 2, 1, 3)[:, :count]
        response = np.einsum("beij,befj->beif", inverses, part)
        common = np.einsum("befi,beig->bfg", part, response)
        variance = ((constrained @ covariance) * constrained).reshape(layouts, count + gauge, 3 * size).sum(axis=2)
        variance += ((rows @ common) * rows).reshape(layouts, count + gauge, 3 * self._n_free_motions).sum(axis=2)
        variance[:, :count] += np.einsum("beii->be", inverses) - 2.0 * np.einsum(
            "beif,beif->be", motion[:, :count], response
        )
        return NORMAL_EQUATION_LENGTH_UNIT**2 * variance
