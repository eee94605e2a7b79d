"""True network geometry of a cell (combination of factor levels), and its trials, drawn in batches as by the simulator.

A trial depends only on its number, and not on the workers, the number of trials or the compared methods. All cells of a
campaign use the same random streams, so that they differ only by their factor levels and not by chance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ltsim.campaigns.kernels import compute_readings
from ltsim.campaigns.kinematic_chain import ChainArrays
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import InputError
from ltsim.core.limits import (
    MAX_CAMPAIGN_POINTINGS,
    MAX_CAMPAIGN_UNKNOWNS,
    POINTINGS_LIMIT_VARIABLE,
    overridable_limit,
)
from ltsim.core.randomness import TRIALS_PER_STREAM as TRIALS_PER_STREAM
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.recordings.reflectors import smr_names
from ltsim.scene.sightings import Sightings
from ltsim.simulation.draws import (
    DrawnTrialValues,
    EffectDistribution,
    StandardNormalSource,
    TrialDistributions,
    TrueTrialValues,
)
from ltsim.simulation.measurement_geometry import MeasurementGeometry, make_measurement_geometry
from ltsim.simulation.physics import instrument_resolutions, true_noise_sigmas
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import error_free_recording, occurring_blunders, simulate_readings, trial_distributions
from ltsim.simulation.workshop import WorkshopLayout

FULL_TURN_RAD = 2 * np.pi
"""Full turn [rad]."""
MAX_EFFECT_NONLINEARITY_SIGMAS = 1e-3
"""Limit of the nonlinearity of an effect: difference between exact and linear change of a reading by three prior
standard deviations of the effect, divided by the sigma of the reading. Below the limit, the linear form is used for all
trials; above it, the exact change is computed trial by trial."""

MAX_CACHED_EFFECT_DESIGNS = 8
"""Largest number of cached design matrices of effects per network geometry, one for each combination of effects."""


def make_campaign_geometry(scenario: Scenario, seed: int, *stream_key: str | int) -> MeasurementGeometry:
    """Measurement geometry of a scenario of a campaign, with a check of its size.

    `seed` and `stream_key` determine the random draws. InputError is raised for more than `MAX_CAMPAIGN_POINTINGS`
    pointings or `MAX_CAMPAIGN_UNKNOWNS` unknowns.
    """
    geometry = make_measurement_geometry(scenario, seed, *stream_key)
    layout, n_pointings = geometry.layout, len(geometry.sightings)
    n_unknowns = 6 * len(layout.station_names) + 3 * len(layout.target_names)
    limits = (
        (n_pointings, MAX_CAMPAIGN_POINTINGS, "pointings", "repeats or targets"),
        (n_unknowns, MAX_CAMPAIGN_UNKNOWNS, "coordinates and angles of stations and targets", "targets"),
    )
    for number, default_limit, name, advice in limits:
        if number > (limit := overridable_limit(default_limit)):
            raise InputError(
                f"the network has {number} {name}; a campaign takes at most {limit}: use fewer {advice}; on a machine "
                f"with more memory set the environment variable {POINTINGS_LIMIT_VARIABLE} to {number}"
            )
    return geometry


@dataclass(frozen=True)
class TrialBatch(TrueTrialValues):
    """Batch of drawn trials: true values, readings and reference lengths of each trial."""

    reading_deviations: Floats
    """Readings minus nominal readings, (pointings, 3, trials) [m, rad, rad]."""
    length_errors: Floats
    """Declared minus true reference lengths, (lengths, trials) [m]."""
    single_trial_batches: tuple[TrialBatch, ...] = ()
    """A batch of one trial for each trial, if the trials have separate network geometries; otherwise empty."""

    @property
    def true_values(self) -> Floats:
        """All true parameters (parameters, trials) [SI]: those of each instrument, followed by those of the effects."""
        return np.concatenate([self.instrument_values.reshape(-1, len(self.trial_numbers)), *self.effect_values])


@dataclass(frozen=True)
class TrueNetwork:
    """True network geometry of a cell (combination of factor levels), and distributions of its random values."""

    recording: Recording
    """Recording with nominal readings, which an ideal tracker reads at `state`."""
    state: NetworkState
    """True poses and targets, in the frame in which a calibration starts (frame of the first station)."""
    distributions: TrialDistributions
    """Distributions of the random values of a trial; the positions in them may be in another frame than `state`."""
    resolution: Floats = field(default_factory=lambda: np.zeros((1, 3)))
    """Resolution of the readings of each instrument, (instruments, 3) [m, rad, rad]; 0 means no rounding."""
    is_recorded_observable: Bools = field(default_factory=lambda: np.ones(3, dtype=bool))
    """Mask (3,) of the recorded observables (range, azimuth, elevation). The reading deviations of all others are 0."""
    geometry: MeasurementGeometry | None = None
    """Measurement geometry, from which the simulator computes trials with blunders one by one; None without blunders.
    """

    @property
    def sightings(self) -> Sightings:
        """Pointings of a simulated network with the true positions of stations, targets and nests, all in one frame."""
        return self.distributions.sightings

    @property
    def construction(self) -> GeometricErrorModel:
        """Geometric error model that generates the readings."""
        return self.distributions.construction

    @property
    def effects(self) -> tuple[EffectDistribution, ...]:
        """Effects of the scenario in addition to the instrument's errors, with distributions of their parameters."""
        return self.distributions.effects

    @cached_property
    def _effect_design_cache(self) -> dict[tuple[Effect, ...], Floats]:
        """Design matrix of each tuple of effects for which it was computed."""
        return {}

    def effect_design(self, effects: tuple[Effect, ...]) -> Floats:
        """Change of the readings per unit of each parameter of `effects`.

        The shape is (pointings, 3, effect parameters, 1), or (pointings, 3, effect parameters, trials) if trials have
        separate network geometries.
        """
        cache = self._effect_design_cache  # no cached function, whose reference to this object would keep both alive
        if effects not in cache:
            while len(cache) >= MAX_CACHED_EFFECT_DESIGNS:
                del cache[next(iter(cache))]
            cache[effects] = self._effect_design(effects)
        return cache[effects]

    def _effect_design(self, effects: tuple[Effect, ...]) -> Floats:
        """Change of the readings per unit of each effect parameter, (pointings, 3, effect parameters, 1)."""
        return np.concatenate([effect.design(self.sightings) for effect in effects], axis=2)[..., None]

    @cached_property
    def reflector_masks(self) -> dict[str, Bools]:
        """Mask (pointings,) of the pointings to each reflector, by its name; '' for a reflector without a name."""
        names = smr_names(self.recording)
        return {name: np.array([other == name for other in names]) for name in dict.fromkeys(names)}

    def incidence_errors(self, parameters_by_reflector: Mapping[str, Floats]) -> Floats:
        """Range errors (pointings, trials) [m] that depend on the incidence angles at the reflectors.

        `parameters_by_reflector` holds the parameters (14, trials) [SI] of the effect `smr-incidence` by name of the
        reflector.
        """
        range_errors = np.zeros((len(self.recording), 1))
        for name, pointings in self.reflector_masks.items():
            if name in parameters_by_reflector:
                design, values = self.effect_design((SmrIncidence(),))[:, 0], parameters_by_reflector[name]
                shared = design.shape[2] == 1  # one network geometry for all trials
                errors = design[..., 0] @ values if shared else np.einsum("nqb,qb->nb", design, values)
                range_errors = range_errors + pointings[:, None] * errors
        return range_errors

    @cached_property
    def _chain_cache(self) -> list[tuple[GeometricErrorModel, tuple[ChainArrays, Floats]]]:
        """Kinematic chain and derivatives of each geometric error model for which they were computed."""
        return []

    def kinematic_chain_and_reading_derivatives(self, construction: GeometricErrorModel) -> tuple[ChainArrays, Floats]:
        """Kinematic chain, and derivative (pointings, 3, parameters) of the readings, at the nominal readings."""
        for other, chain in self._chain_cache:  # comparing a few models is quicker than hashing one model
            if other == construction:
                return chain
        self._chain_cache.append((construction, self._compute_kinematic_chain_and_reading_derivatives(construction)))
        return self._chain_cache[-1][1]

    def _compute_kinematic_chain_and_reading_derivatives(
        self, construction: GeometricErrorModel
    ) -> tuple[ChainArrays, Floats]:
        nominal_readings = self.recording.readings
        by_value = construction.reading_design(nominal_readings, np.zeros(construction.n_parameters))[1]
        return ChainArrays.from_construction(construction, nominal_readings), by_value

    def kinematic_chain(self, construction: GeometricErrorModel) -> ChainArrays:
        """Kinematic chain of a geometric error model, linearised at the nominal readings."""
        return self.kinematic_chain_and_reading_derivatives(construction)[0]

    @cached_property
    def _linear_effects(self) -> list[tuple[Floats, Floats] | None]:
        """Change of the readings by each effect as a linear function of its parameters; None for a nonlinear effect.

        The constant part has the shape (pointings, 3), the design matrix (pointings, 3, effect parameters).
        """
        return [self._linear_effect(entry) for entry in self.effects]

    def _linear_effect(self, effect_distribution: EffectDistribution) -> tuple[Floats, Floats] | None:
        """Change of the readings by one effect as a linear function of its parameters; None for a nonlinear effect.

        The constant part has the shape (pointings, 3), the design matrix (pointings, 3, effect parameters).
        """
        constant = effect_distribution.effect.reading_change(self.sightings, effect_distribution.parameter_means)
        if not np.any(effect_distribution.parameter_sigmas):  # nothing is drawn
            return constant, np.zeros((*constant.shape, len(effect_distribution.parameter_means)))
        design = effect_distribution.effect.design(self.sightings)
        probe = effect_distribution.parameter_means + 3 * effect_distribution.parameter_sigmas
        miss = (
            effect_distribution.effect.reading_change(self.sightings, probe)
            - constant
            - design @ (3 * effect_distribution.parameter_sigmas)
        )
        return (
            (constant, design)
            if np.all(np.abs(miss) <= MAX_EFFECT_NONLINEARITY_SIGMAS * self.recording.reading_sigmas())
            else None
        )

    def draw_batch(self, seed: int, batch_number: int, n_trials: int = TRIALS_PER_STREAM) -> TrialBatch:
        """Batch of `n_trials` trials drawn with `seed`; the number of the first is `batch_number` times `n_trials`."""
        return self.draw_trials(StandardNormalSource(seed, n_trials * batch_number + np.arange(n_trials)))

    def draw_trials(
        self, normal_source: StandardNormalSource, instrument_values: Floats | None = None, *, stream_key: str = ""
    ) -> TrialBatch:
        """Batch of the trials for which `normal_source` generates random numbers.

        `instrument_values` (instruments, parameters, trials) [SI], if given, replaces the drawn errors of the
        instruments. Two calls with different `stream_key` give the same trials independent noise, for a second
        measurement.
        """
        draw = self.distributions.draw(normal_source, instrument_values, stream_key=stream_key)
        return self.batch_from_draw(draw, self._exact_reading_deviations(draw.instrument_values))

    def batch_from_draw(self, draw: DrawnTrialValues, reading_deviations: Floats) -> TrialBatch:
        """Batch of trials from drawn random values: readings, reference lengths and true parameters.

        `reading_deviations` (pointings, 3, trials) are exact minus nominal readings; the noise is added to this array
        in place.
        """
        if occurring_blunders([law.effect for law in self.effects], draw.effect_values):
            reading_deviations = self._deviations_with_blunders(draw)
        else:
            for place, amounts in enumerate(draw.effect_values):
                reading_deviations += self._effect_change(place, amounts)
            reading_deviations += draw.reading_errors
            reading_deviations = self._round_to_resolution(reading_deviations)
        lengths = self.distributions.reference_lengths
        length_errors = draw.certified_lengths * lengths.expansion_factors[:, None] - lengths.lengths[:, None]
        return TrialBatch(
            draw.trial_numbers, draw.instrument_values, draw.effect_values, reading_deviations, length_errors
        )

    def _deviations_with_blunders(self, draw: DrawnTrialValues) -> Floats:
        """Readings minus nominal readings (pointings, 3, trials) of trials with blunders, computed by the simulator."""
        assert self.geometry is not None
        nominal, parts = self.recording.readings, []
        for k in range(len(draw.trial_numbers)):
            amounts = tuple(amount[:, k] for amount in draw.effect_values)
            gap = (
                simulate_readings(self.geometry, draw.instrument_values[:, :, k], amounts, draw.reading_errors[:, :, k])
                - nominal
            )
            gap[:, 1] -= FULL_TURN_RAD * np.round(gap[:, 1] / FULL_TURN_RAD) * (np.abs(gap[:, 1]) < 1.5 * FULL_TURN_RAD)
            parts.append(np.where(self.is_recorded_observable, gap, 0.0))
        return np.stack(parts, axis=2)

    def _exact_reading_deviations(self, true_parameters: Floats) -> Floats:
        """Exact minus nominal readings (pointings, 3, trials) for the true parameters [SI] of the instruments.

        Newton's method starts from the linear change of the readings.
        """
        which, sightings = self.recording.instrument, self.sightings
        program, by_value = self.kinematic_chain_and_reading_derivatives(self.construction)
        deviation = np.empty((len(which), 3, true_parameters.shape[2]))
        for i, parameters in enumerate(true_parameters):
            deviation[which == i] = by_value[which == i] @ parameters
        compute_readings(
            program, which, sightings.local_points, sightings.local_derivatives, true_parameters, deviation
        )
        return deviation

    def _effect_change(self, effect_index: int, amounts: Floats) -> Floats:
        """Change (pointings, 3, trials) of the readings by one effect with the parameter values `amounts` [SI]."""
        entry, linear = self.effects[effect_index], self._linear_effects[effect_index]
        if linear is None:
            return np.stack([entry.effect.reading_change(self.sightings, v) for v in amounts.T], axis=2)
        constant, design = linear
        return constant[:, :, None] + np.tensordot(design, amounts - entry.parameter_means[:, None], axes=1)

    def _round_to_resolution(self, reading_deviations: Floats) -> Floats:
        """Deviations from nominal readings, (pointings, 3, trials), changed in place by rounding of the readings."""
        of_row = np.broadcast_to(self.resolution[self.recording.instrument], reading_deviations.shape[:2])
        for column in range(3):
            rows = np.flatnonzero(of_row[:, column])
            selected: Any = rows if len(rows) < len(of_row) else slice(None)  # a slice makes no copy
            step, start = of_row[selected, column, None], self.recording.readings[selected, column, None]
            reading_deviations[selected, column] = (
                step * np.round((start + reading_deviations[selected, column]) / step) - start
            )
        return reading_deviations

    def trial_readings(self, trial_batch: TrialBatch, trial: int) -> Floats:
        """Readings (pointings, 3) [m, rad, rad] of one trial of a batch, with azimuths within +-180 degrees."""
        readings: Floats = self.recording.readings + trial_batch.reading_deviations[:, :, trial]
        readings[:, 1] = np.where(np.abs(readings[:, 1]) < FULL_TURN_RAD, wrap_angle(readings[:, 1]), readings[:, 1])
        readings[:, ~self.is_recorded_observable] = np.nan
        return readings


def make_true_network(
    scenario: Scenario,
    seed: int,
    *key: str | int,
    reference_network: TrueNetwork | None = None,
    planned_layout: WorkshopLayout | None = None,
) -> TrueNetwork:
    """True network geometry of a scenario, drawn once, with the distributions of its trials; raises InputError.

    `seed` and `key` determine the random draws of the geometry; without `key` they are those of `simulate`.
    `reference_network` is another geometry of the same scenario; its declarations are used if the same targets are
    visible. `planned_layout` are the planned poses and targets of the scenario; None if they are not computed yet.
    """
    read = {frozenset(tracker.observables) for tracker in scenario.trackers_in_use.values()}
    if len(read) > 1:
        raise InputError("instruments: observables differ between the trackers; give all trackers the same observables")
    geometry = make_measurement_geometry(scenario, seed, *key, plan=planned_layout)
    if geometry.sightings.sight_vector_offsets is not None and np.any(geometry.sightings.sight_vector_offsets):
        raise InputError("reflectors: a campaign uses one SMR radius; give all SMRs of the scenario the same radius")
    s, reference = geometry.sightings, None if reference_network is None else reference_network.recording
    if (
        reference_network
        and reference
        and not scenario.lengths
        and (s.station_names, s.target_names) == (reference.stations, reference.targets)
    ):
        pointings = {name: getattr(s, name) for name in ("station", "target", "face", "repeat", "time", "covariates")}
        there = replace(reference_network.distributions, sightings=s, noise_sigmas=true_noise_sigmas(scenario, s))
        nominal, state = (
            reference.replace(**pointings, readings=s.ideal_raw_readings, notes=geometry.hidden_pair_notes),
            _state_in_start_frame(geometry, there.instrument_error_means),
        )
        return replace(reference_network, recording=nominal, state=state, distributions=there, geometry=geometry)
    recording = error_free_recording(geometry)
    population = trial_distributions(geometry, recording)
    return TrueNetwork(
        recording=recording,
        state=_state_in_start_frame(geometry, population.instrument_error_means),
        distributions=population,
        resolution=instrument_resolutions(scenario),
        is_recorded_observable=np.isin(OBSERVABLES, [*next(iter(read))]),
        geometry=geometry,
    )


def _state_in_start_frame(geometry: MeasurementGeometry, mean_parameters: Floats) -> NetworkState:
    """True stations and targets, in the frame of the first station, or of the hall if levels define the vertical.

    `mean_parameters` [SI] are the means of the true instrument parameters.
    """
    s = geometry.sightings
    if any(station.levelled for station in geometry.scenario.stations.values()):
        return NetworkState(s.station_positions, s.station_rotations, s.target_points, mean_parameters)
    origin, turn = s.station_positions[0], s.station_rotations[0]
    return NetworkState(
        (s.station_positions - origin) @ turn,
        turn.T @ s.station_rotations,
        (s.target_points - origin) @ turn,
        mean_parameters,
    )
