"""Instrument errors and environment of a scenario: construction, effects, and their distributions."""

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import SetupError, as_setup_error
from ltsim.core.units import ARCSECOND, DEGREE, MICROMETRE
from ltsim.physics.effects import BASELINE_EFFECTS
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import Construction, construction_with_orders, misalignment_construction
from ltsim.recordings.recording import noise_sigma
from ltsim.scene.sightings import Sightings
from ltsim.simulation.scenario import Scenario, tracker_table_name
from ltsim.simulation.sections import EffectEntry, ScenarioInstrument


def make_scenario_construction(scenario: Scenario) -> Construction:
    """Construction of the scenario's trackers, which is the same for all."""
    instrument = next(iter(scenario.trackers_in_use.values()))
    return construction_with_orders(instrument.construction, instrument.harmonics, instrument.degree)


def planned_construction(scenario: Scenario) -> Construction:
    """Construction whose parameters a plan for the scenario's tracker is to determine.

    Of the 78 parameters of a D-H chain only the misalignments are planned for; they represent all. A scenario that
    records ranges alone has only the parameters that act on ranges.
    """
    built = make_scenario_construction(scenario)
    if built.name == "steering-mirror":
        return built
    read = {name for tracker in scenario.trackers_in_use.values() for name in tracker.observables}
    return misalignment_construction(effect for effect in BASELINE_EFFECTS if read & {*effect.observables})


def instrument_error_distribution(scenario: Scenario, construction: Construction) -> tuple[Floats, Floats]:
    """Mean and standard deviation (I, p) [SI] of each tracker's errors.

    The standard deviation is 0 for declared errors.

    Raises SetupError for a declared error that the construction does not have.
    """
    laws = [_error_distribution(tracker, construction, name) for name, tracker in scenario.trackers_in_use.items()]
    return np.array([mean for mean, _ in laws]), np.array([sigma for _, sigma in laws])


def _error_distribution(
    instrument: ScenarioInstrument, construction: Construction, parameter_name: str
) -> tuple[Floats, Floats]:
    errors = {error: float(value) for error, value in instrument.errors.items() if error != "draw"}
    for error in errors:
        with as_setup_error(f"{tracker_table_name(parameter_name)}.errors.{error}"):
            construction.index(error)
    parameters = construction.parameters
    mean = np.array([errors.get(p.name, 0.0) * p.si_per_display_unit for p in parameters])
    free = [instrument.draws and p.name not in errors for p in parameters]
    prior = np.array([p.sigma_from(instrument.prior) for p in parameters])
    return mean, np.where(free, instrument.error_factor * prior, 0.0)


def nominal_noise(scenario: Scenario, sightings: Sightings) -> Floats:
    """True standard deviation (n, 3) [m, rad, rad] of the white noise: the specification times the noise factor."""
    trackers = scenario.trackers_in_use.values()
    factor = np.array([tracker.noise_factor for tracker in trackers])[sightings.instrument]
    noise = [tracker.noise for tracker in trackers]
    return factor[:, None] * noise_sigma(noise, sightings.instrument, sightings.range_, sightings.elevation)


def instrument_resolutions(scenario: Scenario) -> Floats:
    """Resolution (I, 3) [m, rad, rad] of each tracker's readings; 0 for none."""
    steps = [tracker.resolution for tracker in scenario.trackers_in_use.values()]
    units = np.array([MICROMETRE, ARCSECOND, ARCSECOND])
    return np.array([[step.distance_um, step.angle_arcsec, step.angle_arcsec] for step in steps]) * units


def round_to_resolution(readings: Floats, resolution: Floats) -> Floats:
    """Readings (n, 3) rounded to multiples of `resolution` (3,) or (n, 3) [m, rad, rad]; a step of 0 does not round."""
    resolution = np.broadcast_to(resolution, readings.shape)
    return np.where(
        resolution > 0.0, resolution * np.round(readings / np.where(resolution > 0.0, resolution, 1.0)), readings
    )


def scenario_effects(scenario: Scenario) -> tuple[Effect, ...]:
    """Effects of the scenario in the order of its file; the incidence error of the reflectors, if enabled, is last.

    The parameters of the incidence error are those of the table (`reflector_error_parameters`).

    Raises SetupError with the entry and the permitted values.
    """
    effects = [_effect_from_entry(entry, i + 1) for i, entry in enumerate(scenario.effects)]
    return (*effects, SmrIncidence()) if scenario.smr.incidence_error else tuple(effects)


def reflector_error_parameters(scenario: Scenario) -> Floats:
    """Parameters (p,) [SI] of the effect `smr-incidence` that correspond to the scenario's table."""
    table = tuple(x * MICROMETRE for x in scenario.smr.table_um)
    return SmrIncidence(table=table, direction=scenario.smr.direction_deg * DEGREE).parameters_from_table


def _effect_from_entry(effect_entry: EffectEntry, entry_number: int) -> Effect:
    effect = effect_entry.effect(f"effects.{entry_number}")
    names = [p.name for p in effect.parameters]
    for name in effect_entry.values:
        if name not in names:
            raise SetupError(
                f"effects.{entry_number}.values: {effect_entry.name} has no '{name}', it has {', '.join(names)}"
            )
    return effect
