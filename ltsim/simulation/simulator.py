"""Simulator: recording and true values of one trial of a scenario, for a given seed."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any, Literal

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE, MILLIMETRE
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.effects.effect import Blunder, Effect, NoiseEffect
from ltsim.recordings.recording import OBSERVABLES, REFLECTOR_COLUMN, Recording
from ltsim.recordings.references import ReferenceLengths
from ltsim.recordings.setup import (
    ElevationLimits,
    GaugeDistance,
    Instrument,
    LengthGauge,
    LengthMaterialAndTemperature,
    Prior,
    Setup,
    Station,
    Target,
    Vector,
)
from ltsim.simulation.draws import StandardNormalSource, TrialDistributions, effect_distributions
from ltsim.simulation.measurement_geometry import MeasurementGeometry, make_measurement_geometry, smr_names_of_pointings
from ltsim.simulation.physics import (
    instrument_error_distribution,
    instrument_resolutions,
    round_to_resolution,
    true_noise_sigmas,
)
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.sections import ScenarioInstrument
from ltsim.simulation.truth import AppliedEffect, TrackerTruth, Truth, TruthArrays
from ltsim.simulation.workshop import cmm_length_sigmas, measure_points_by_cmm

GeometrySharing = Literal["shared", "per-trial"]
"""Use of true positions by the trials: `shared` for one draw of all positions, `per-trial` for a separate draw per
trial."""


def simulate(
    scenario: Scenario, seed: int, trial: int = 0, geometry: GeometrySharing = "shared"
) -> tuple[Recording, Truth]:
    """Recording and true values of trial number `trial` of a scenario; a campaign with this seed has the same trial.

    `geometry` selects true positions that all trials share, or a separate draw for each trial. InputError is raised for
    an impossible scenario.
    """
    return measure_trial(make_measurement_geometry(scenario, seed, *position_stream_key(trial, geometry)), seed, trial)


def position_stream_key(trial: int, geometry: GeometrySharing) -> tuple[str | int, ...]:
    """Key of the random stream for true positions: one key for all trials (`shared`) or one per trial."""
    return ("trial", trial) if trial and geometry == "per-trial" else ()


def measure_trial(
    geometry: MeasurementGeometry,
    seed: int,
    trial_number: int = 0,
    *,
    true_instrument_errors: Floats | None = None,
    stream_key: str = "",
) -> tuple[Recording, Truth]:
    """Recording and true values of a trial at the true positions `geometry`; instrument errors and noise are drawn.

    `true_instrument_errors` (instruments, parameters) [SI] replaces the drawn instrument errors. Two calls with
    different `stream_key` give the trial independent noise, for a second measurement.
    """
    blank = error_free_recording(geometry)
    given = None if true_instrument_errors is None else true_instrument_errors[:, :, None]
    drawn = trial_distributions(geometry, blank).draw(
        StandardNormalSource(seed, np.array([trial_number])), given, stream_key=stream_key
    )
    true_instrument_errors, amounts = (
        drawn.instrument_values[:, :, 0],
        tuple(amount[:, 0] for amount in drawn.effect_values),
    )
    readings = simulate_readings(geometry, true_instrument_errors, amounts, drawn.reading_errors[:, :, 0])
    recording = with_certified_reference_lengths(blank.with_readings(readings), drawn.certified_lengths[:, 0])
    return recording, _truth_of_trial(geometry, true_instrument_errors, amounts, seed, trial_number)


def error_free_recording(geometry: MeasurementGeometry) -> Recording:
    """Recording with the declared set-up, but of a tracker without errors and noise, and with exact certificates."""
    s, scenario = geometry.sightings, geometry.scenario
    has_reflectors = scenario.reflectors or any(station.reflector for station in scenario.stations.values())
    bare_recording = Recording(
        setup=_declared_setup(geometry),
        stations=s.station_names,
        targets=s.target_names,
        station=s.station,
        target=s.target,
        face=s.face,
        repeat=s.repeat,
        time=s.time,
        readings=s.ideal_raw_readings,
        covariates=s.covariates,
        labels={REFLECTOR_COLUMN: smr_names_of_pointings(scenario, s)} if has_reflectors else {},
    )
    blank = with_exact_reference_lengths(bare_recording, geometry)
    return blank.replace(
        notes=(
            *geometry.hidden_pair_notes,
            *_ineffective_effect_sentences(geometry, ReferenceLengths.from_recording(blank)),
        )
    )


def trial_distributions(geometry: MeasurementGeometry, error_free_recording: Recording) -> TrialDistributions:
    """Distributions of the random values of trials at the true positions of `geometry`.

    `error_free_recording` is the recording without errors at these positions.
    """
    scenario = geometry.scenario
    mean, sigma = instrument_error_distribution(scenario, geometry.construction)
    return TrialDistributions(
        sightings=geometry.sightings,
        construction=geometry.construction,
        instrument_names=tuple(scenario.trackers_in_use),
        instrument_error_means=mean,
        instrument_error_sigmas=sigma,
        noise_sigmas=true_noise_sigmas(scenario, geometry.sightings),
        reference_lengths=ReferenceLengths.from_recording(error_free_recording),
        length_target_names=error_free_recording.targets,
        effects=effect_distributions(scenario, geometry.effects),
        certificate_error_factor=scenario.cmm.noise_factor,
    )


def simulate_readings(
    geometry: MeasurementGeometry, instrument: Floats, effect_values: tuple[Floats, ...], noise: Floats
) -> Floats:
    """Raw readings with noise and rounding, shape (pointings, 3) [m, rad, rad]; NaN for observables not recorded.

    `instrument` (instruments, parameters) [SI] are the errors of the trackers, `effect_values` are the parameters [SI]
    of each effect, and `noise` (pointings, 3) [m, rad, rad] is added to the readings.
    """
    readings = exact_readings(geometry, instrument, effect_values) + noise
    readings[:, 1] = wrap_angle(readings[:, 1])
    readings = round_to_resolution(readings, instrument_resolutions(geometry.scenario)[geometry.sightings.instrument])
    for mistake in occurring_blunders(geometry.effects, effect_values):
        readings = mistake.recorded_readings(geometry.sightings, readings)
    recorded = [
        [name in tracker.observables for name in OBSERVABLES] for tracker in geometry.scenario.trackers_in_use.values()
    ]
    return np.where(np.array(recorded)[geometry.sightings.instrument], readings, np.nan)


def exact_readings(geometry: MeasurementGeometry, instrument: Floats, effect_values: tuple[Floats, ...]) -> Floats:
    """Raw readings without noise, shape (pointings, 3) [m, rad, rad], of trackers with errors and with the effects.

    `instrument` (instruments, parameters) [SI] are the errors of the trackers, `effect_values` are the parameters [SI]
    of each effect.
    """
    sightings = geometry.sightings
    for mistake in occurring_blunders(geometry.effects, effect_values):
        sightings = mistake.measured_sightings(sightings)
    errors = instrument[0] if len(instrument) == 1 else instrument[sightings.instrument]
    readings = geometry.construction.readings_from_points(sightings.local_points, sightings.face, errors)
    for k in sorted(range(len(geometry.effects)), key=lambda k: geometry.effects[k].light_path_stage):
        if not isinstance(geometry.effects[k], Blunder):
            readings = readings + geometry.effects[k].reading_change(sightings, effect_values[k])
    return readings


def occurring_blunders(effects: Sequence[Effect], effect_values: Sequence[Floats]) -> list[Blunder]:
    """Blunders among `effects` that occur in a trial, that is, whose first parameter in `effect_values` is not 0."""
    return [e for e, made in zip(effects, effect_values, strict=True) if isinstance(e, Blunder) and np.any(made[0])]


def ineffective_effect_notes(geometry: MeasurementGeometry) -> Iterator[str]:
    """Notes on effects of the scenario that change no reading, for example because the recording has no times."""
    yield from error_free_recording(geometry).notes[len(geometry.hidden_pair_notes) :]


def _ineffective_effect_sentences(geometry: MeasurementGeometry, lengths: ReferenceLengths) -> Iterator[str]:
    """Sentence on each effect that changes neither a reading nor a reference length."""
    for effect in geometry.effects:
        if isinstance(effect, NoiseEffect) or np.any(effect.design(geometry.sightings)):
            continue
        if np.any(effect.gauge_design(lengths.first_targets, lengths.second_targets, geometry.sightings.target_points)):
            continue
        yield f"{effect.name} changes no reading of this recording"


def _declared_setup(geometry: MeasurementGeometry) -> Setup:
    """Content of the recording's set-up file: declared instruments, stations, targets and reference lengths."""
    scenario, step = geometry.scenario, geometry.scenario.placing
    stations = {
        name: Station(
            position_mm=_rounded_position(s.position_mm, step.plan_step_mm),
            yaw_deg=step.plan_step_deg * round(s.yaw_deg / step.plan_step_deg),
            levelled=s.levelled,
            levelling_sigma_arcsec=s.levelling_sigma_arcsec,
            instrument=s.instrument,
        )
        for name, s in scenario.stations.items()
    }
    return Setup(
        title=scenario.title,
        air=scenario.air,
        instrument=_declared_data_sheet(scenario.instrument) if "" in scenario.trackers_in_use else Instrument(),
        instruments={name: _declared_data_sheet(tracker) for name, tracker in scenario.instruments.items()},
        stations=stations,
        targets=_declared_targets(geometry),
        reflectors=scenario.reflectors,
        reference_radius_mm=scenario.reference_radius_mm,
    )


def _declared_data_sheet(tracker: ScenarioInstrument) -> Instrument:
    """Declared noise, prior of the instrument errors, and limits of a tracker."""
    return Instrument(
        construction="steering-mirror" if tracker.construction == "steering-mirror" else "source-in-head",
        corrected=tracker.corrected,
        noise=tracker.noise,
        prior=_declared_prior(tracker),
        limits=ElevationLimits(**tracker.limits.model_dump(include=set(ElevationLimits.model_fields))),
    )


def _declared_prior(tracker: ScenarioInstrument) -> Prior:
    """Prior that the recording declares: the tracker's prior with standard deviations times `prior_factor`."""
    kinds = tracker.prior.model_dump()
    sigma_by_parameter = {name: tracker.prior_factor * value for name, value in kinds.pop("parameters").items()}
    return Prior(**{name: tracker.prior_factor * value for name, value in kinds.items()}, parameters=sigma_by_parameter)


def _rounded_position(position: Vector, rounding_step: float) -> Vector:
    """Position with coordinates rounded to multiples of `rounding_step`, in the unit of the position."""
    x, y, z = (rounding_step * round(value / rounding_step) for value in position)
    return x, y, z


def _declared_targets(geometry: MeasurementGeometry) -> dict[str, Target]:
    """Declared nest normal, aiming and SMR of each target, by name of the target."""
    scenario, s = geometry.scenario, geometry.sightings
    table = {}
    for i, name in enumerate(s.target_names):
        reflector = scenario.targets[name].reflector if name in scenario.targets else None
        table[name] = Target(
            nest_normal=tuple(s.nest_normals[i].round(4).tolist()) if np.isfinite(s.nest_normals[i]).all() else None,
            reaimed=bool(s.is_reaimed[i]),
            reflector=reflector or scenario.smr.reflector,
        )
    return table


def _truth_of_trial(
    geometry: MeasurementGeometry, instrument: Floats, effect_values: tuple[Floats, ...], seed: int, trial: int
) -> Truth:
    """True values of a trial as the content of the truth file."""
    s, scenario = geometry.sightings, geometry.scenario
    trackers = scenario.trackers_in_use
    names = geometry.construction.instrument_parameter_names(tuple(trackers))
    nominal = None
    if scenario.cmm.measures_targets:
        nominal = measure_points_by_cmm(
            s.target_points, s.target_names, scenario.cmm, seed, *((trial,) if trial else ())
        )
    arrays = TruthArrays(
        station_positions=s.station_positions,
        station_rotations=s.station_rotations,
        target_points=s.target_points,
        instrument_values=dict(zip(names, instrument.ravel().tolist(), strict=True)),
        effects=tuple(AppliedEffect(e, v) for e, v in zip(geometry.effects, effect_values, strict=True)),
        nominal_points=nominal,
    )
    units = [p.unit for p in geometry.construction.parameters] * len(trackers)
    named = tuple(
        TrackerTruth(name=name, stations=scenario.stations_of_tracker(name), noise_factor=tracker.noise_factor)
        for name, tracker in trackers.items()
    )
    noise = {"instruments": named} if scenario.instruments else {"noise_factor": scenario.instrument.noise_factor}
    settings = {"title": scenario.title, "seed": seed, "trial": trial, "construction": geometry.construction.name}
    return Truth.from_arrays(arrays, s.station_names, s.target_names, units, **settings, **noise)


def with_exact_reference_lengths(recording: Recording, geometry: MeasurementGeometry) -> Recording:
    """Recording with declared reference lengths that equal the true distances between the reflectors."""
    scenario, points = geometry.scenario, geometry.sightings.target_points
    gauge, warm = scenario.gauge, scenario.workshop.temperature_c
    if gauge is None and not scenario.lengths:
        return recording
    lines_of_targets = [
        (line, um)
        for line, um in _declared_reference_lengths(scenario)
        if {line.from_, line.to} <= set(recording.targets)
    ]
    gauge_keys: dict[str, Any] = {}
    if gauge is not None:
        warm = warm if gauge.measured_at_c is None else gauge.measured_at_c
        gauge_keys = gauge.model_dump(include=set(LengthGauge.model_fields) - {"distance", "measured_at_c"})
    lines = tuple(line for line, _ in lines_of_targets)
    nominal = LengthGauge(measured_at_c=warm, materials=scenario.materials or None, distance=lines, **gauge_keys)
    blank = recording.replace(setup=recording.setup.model_copy(update={"gauge": nominal}))
    there = ReferenceLengths.from_recording(blank)
    certified = (
        np.linalg.norm(points[there.first_targets] - points[there.second_targets], axis=1) / there.expansion_factors
    )
    by_machine = cmm_length_sigmas(scenario.cmm, certified).tolist()
    sigma = [s if um is None else um * MICROMETRE for (_, um), s in zip(lines_of_targets, by_machine, strict=True)]
    return with_certified_reference_lengths(blank, certified, sigma)


def _declared_reference_lengths(scenario: Scenario) -> Iterator[tuple[GaugeDistance, float | None]]:
    """Declaration of each reference length (gauge and scale bars), and its standard deviation [um]; None if undeclared.

    The lengths are placeholders of 1 mm.
    """
    blank = {"length_mm": 1.0, "sigma_mm": 1.0}
    if scenario.gauge:
        for a, b in combinations(scenario.gauge.targets, 2):
            yield GaugeDistance.model_validate({"from": a, "to": b, **blank}), scenario.gauge.sigma_um
    for length in scenario.lengths:
        use = length.model_dump(include=set(LengthMaterialAndTemperature.model_fields))
        ends = {"from": length.from_, "to": length.to}
        yield GaugeDistance.model_validate(ends | use | blank), length.sigma_um


def with_certified_reference_lengths(
    recording: Recording, reference_lengths: Floats, sigma: Sequence[float] | None = None
) -> Recording:
    """Recording with new declared reference lengths at the calibration temperature, `reference_lengths` (lengths,) [m].

    `sigma` (lengths,) [m], if given, replaces the standard deviations of the lengths.
    """
    if recording.setup.gauge is None:
        return recording
    lines = []
    for i, (line, value) in enumerate(zip(recording.gauge.distance, reference_lengths.tolist(), strict=True)):
        certificate = {"length_mm": round(value / MILLIMETRE, 12)}
        if sigma is not None:
            certificate["sigma_mm"] = max(round(sigma[i] / MILLIMETRE, 6), 1e-6)
        lines.append(line.model_copy(update=certificate))
    gauge = recording.gauge.model_copy(update={"distance": tuple(lines)})
    return recording.replace(setup=recording.setup.model_copy(update={"gauge": gauge}))
