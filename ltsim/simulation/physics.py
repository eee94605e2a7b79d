"""Instrument errors, noise and effects of a scenario, with the distributions from which the true values are drawn."""

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, reraise_as_input_error
from ltsim.core.units import ARCSECOND, DEGREE, MICROMETRE
from ltsim.physics.effects import ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import GeometricErrorModel, construction_with_dh_orders, misalignment_construction
from ltsim.recordings.recording import reading_sigmas_from_noise
from ltsim.scene.sightings import Sightings
from ltsim.simulation.scenario import Scenario, tracker_table_name
from ltsim.simulation.sections import EffectEntry, ScenarioInstrument


def make_scenario_construction(scenario: Scenario) -> GeometricErrorModel:
    """Geometric error model that all trackers of a scenario share."""
    instrument = next(iter(scenario.trackers_in_use.values()))
    return construction_with_dh_orders(instrument.construction, instrument.harmonics, instrument.degree)


def planned_construction(scenario: Scenario) -> GeometricErrorModel:
    """Geometric error model whose parameters the measurements planned from a scenario have to determine.

    If the scenario simulates a Denavit-Hartenberg chain with 78 parameters, the misalignment model with 16 parameters
    replaces it. A scenario with ranges alone has only the parameters that change ranges.
    """
    built = make_scenario_construction(scenario)
    if built.name == "steering-mirror":
        return built
    observables = {name for tracker in scenario.trackers_in_use.values() for name in tracker.observables}
    return misalignment_construction(
        effect for effect in ORDINARY_CALIBRATION_EFFECTS if observables & {*effect.observables}
    )


def instrument_error_distribution(scenario: Scenario, construction: GeometricErrorModel) -> tuple[Floats, Floats]:
    """Means and standard deviations of the errors of each tracker, both of shape (instruments, parameters) [SI].

    An error with a declared value has this value as mean, and the standard deviation 0. InputError is raised for a
    declared error that the instrument model does not have.
    """
    laws = [
        _tracker_error_distribution(tracker, construction, name) for name, tracker in scenario.trackers_in_use.items()
    ]
    return np.array([mean for mean, _ in laws]), np.array([sigma for _, sigma in laws])


def _tracker_error_distribution(
    instrument: ScenarioInstrument, construction: GeometricErrorModel, tracker_name: str
) -> tuple[Floats, Floats]:
    """Means and standard deviations of the errors of one tracker, both of shape (parameters,) [SI].

    `tracker_name` is used in messages only.
    """
    errors = {error: float(value) for error, value in instrument.errors.items() if error != "draw"}
    for error in errors:
        with reraise_as_input_error(f"{tracker_table_name(tracker_name)}.errors.{error}"):
            construction.parameter_index(error)
    parameters = construction.parameters
    error_means = np.array([errors.get(p.name, 0.0) * p.si_per_display_unit for p in parameters])
    free = [instrument.draws_errors and p.name not in errors for p in parameters]
    prior = np.array([p.prior_sigma_from(instrument.prior) for p in parameters])
    return error_means, np.where(free, instrument.error_factor * prior, 0.0)


def true_noise_sigmas(scenario: Scenario, sightings: Sightings) -> Floats:
    """True standard deviations of the readings, (pointings, 3) [m, rad, rad]: specified values times `noise_factor`."""
    trackers = scenario.trackers_in_use.values()
    factor = np.array([tracker.noise_factor for tracker in trackers])[sightings.instrument]
    noise = [tracker.noise for tracker in trackers]
    return factor[:, None] * reading_sigmas_from_noise(
        noise, sightings.instrument, sightings.range_, sightings.elevation
    )


def instrument_resolutions(scenario: Scenario) -> Floats:
    """Resolution of the readings of each tracker, shape (instruments, 3) [m, rad, rad]; 0 means no rounding."""
    steps = [tracker.resolution for tracker in scenario.trackers_in_use.values()]
    units = np.array([MICROMETRE, ARCSECOND, ARCSECOND])
    return np.array([[step.distance_um, step.angle_arcsec, step.angle_arcsec] for step in steps]) * units


def round_to_resolution(readings: Floats, resolution: Floats) -> Floats:
    """Readings (pointings, 3) [m, rad, rad], rounded to multiples of `resolution`; 0 means no rounding.

    `resolution` has the shape (3,) or (pointings, 3).
    """
    resolution = np.broadcast_to(resolution, readings.shape)
    return np.where(
        resolution > 0.0, resolution * np.round(readings / np.where(resolution > 0.0, resolution, 1.0)), readings
    )


def scenario_effects(scenario: Scenario) -> tuple[Effect, ...]:
    """Effects of a scenario in the order of its file, then the range error of the reflectors by incidence, if enabled.

    InputError is raised for an invalid entry.
    """
    effects = [_effect_from_entry(entry, i + 1) for i, entry in enumerate(scenario.effects)]
    return (*effects, SmrIncidence()) if scenario.smr.incidence_error else tuple(effects)


def incidence_error_parameters(scenario: Scenario) -> Floats:
    """Parameters [SI] of the effect `smr-incidence` that give the range errors `smr.range_error_table_um`."""
    table = tuple(x * MICROMETRE for x in scenario.smr.range_error_table_um)
    return SmrIncidence(table=table, direction=scenario.smr.direction_deg * DEGREE).parameter_values_of_table


def _effect_from_entry(effect_entry: EffectEntry, entry_number: int) -> Effect:
    """Effect object for entry number `entry_number` of the effects; raises InputError for an invalid entry."""
    effect = effect_entry.effect(f"effects.{entry_number}")
    names = [p.name for p in effect.parameters]
    for name in effect_entry.values:
        if name not in names:
            raise InputError(
                f"effects.{entry_number}.values: {effect_entry.name} has no '{name}', it has {', '.join(names)}"
            )
    return effect
