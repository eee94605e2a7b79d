"""The simulator: a scenario and a seed give a recording, and apart from it the truth.

Every draw has its own stream, keyed by what it is for: adding an effect, a station's twin or a worker changes no
other draw.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Mistake, NoiseEffect
from ltsim.effects.resolution import quantised
from ltsim.errors import SetupError
from ltsim.geometry.polar import wrap
from ltsim.randomness import stream
from ltsim.recording.lengths import KnownLengths
from ltsim.recording.recording import OBSERVABLES, REFLECTOR_COLUMN, Recording
from ltsim.recording.setup import Instrument, Limits, Setup, Station, Target
from ltsim.simulation.balls import balls_of
from ltsim.simulation.fieldwork import Fieldwork, fieldwork
from ltsim.simulation.gauge import nominal_points
from ltsim.simulation.lengths import with_lengths, with_stated
from ltsim.simulation.physics import effect_values, instrument_values, resolution_of, stated_noise
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.sections import Instrument as Tracker
from ltsim.simulation.truth import AppliedEffect, TrackerTruth, Truth


def simulate(scenario: Scenario, seed: int) -> tuple[Recording, Truth]:
    """Measure a scenario once; raises SetupError when the scenario asks for something impossible."""
    return measure(fieldwork(scenario, seed), seed)


def measure(work: Fieldwork, seed: int, *key: str | int) -> tuple[Recording, Truth]:
    """Draw the instrument's errors, the gauge's calibration and the noise anew on a fixed geometry.

    Parameters
    ----------
    work : Fieldwork
    seed : int
    *key : str or int
        What tells this trial from others with the same seed.
    """
    instrument = instrument_values(work.scenario, work.construction, seed, *key)
    values = effect_values(work.scenario, work.effects, seed, *key)
    readings = simulate_readings(work, instrument, values, seed, *key)
    truth = _truth(work, instrument, values, seed, *key)
    return _recording(work, readings, values, seed, *key), truth


def simulate_readings(
    work: Fieldwork, instrument: Floats, values: tuple[Floats, ...], seed: int, *key: str | int
) -> Floats:
    """Raw readings (n, 3) of the fieldwork: exact, with noise, rounded; NaN for what is not recorded.

    Parameters
    ----------
    work : Fieldwork
    instrument : (I, p) float, [SI]
        Of the trackers of the scenario.
    values : tuple of (q,) float, [SI]
        One an effect of `work.effects`.
    seed, *key
        Of the noise.
    """
    readings = exact_readings(work, instrument, values) + drawn_noise(work, values, seed, *key)
    readings[:, 1] = wrap(readings[:, 1])
    readings = quantised(readings, resolution_of(work.scenario)[work.sightings.instrument])
    for mistake in _mistakes(work, values):
        readings = mistake.written(work.sightings, readings)
    recorded = [[name in tracker.observables for name in OBSERVABLES] for tracker in work.scenario.trackers.values()]
    return np.where(np.array(recorded)[work.sightings.instrument], readings, np.nan)


def exact_readings(work: Fieldwork, instrument: Floats, values: tuple[Floats, ...]) -> Floats:
    """Raw readings (n, 3) before noise of what was really measured: the exact construction, then effects by stage.

    `instrument` and `values` as of `simulate_readings`.
    """
    sightings = work.sightings
    for mistake in _mistakes(work, values):
        sightings = mistake.done(sightings)
    errors = instrument[0] if len(instrument) == 1 else instrument[sightings.instrument]
    readings = work.construction.readings(sightings.local, sightings.face, errors)
    for k in sorted(range(len(work.effects)), key=lambda k: work.effects[k].stage):
        if not isinstance(work.effects[k], Mistake):
            readings = readings + work.effects[k].shift(sightings, values[k])
    return readings


def _mistakes(work: Fieldwork, values: tuple[Floats, ...]) -> list[Mistake]:
    """Blunders that were made: their one parameter is not 0."""
    pairs = zip(work.effects, values, strict=True)
    return [effect for effect, made in pairs if isinstance(effect, Mistake) and made[0]]


def noise_sigma(work: Fieldwork, values: tuple[Floats, ...]) -> Floats:
    """True standard deviation (n, 3) of the noise: the stated one, changed by effects on the noise.

    Raises
    ------
    SetupError
        When an effect leaves a variance below zero.
    """
    sigma = stated_noise(work.scenario, work.sightings)
    for effect, amount in zip(work.effects, values, strict=True):
        if isinstance(effect, NoiseEffect):
            variance = effect.variance(work.sightings, sigma, amount)
            if not np.all(variance >= 0.0):
                raise SetupError(f"effects: {effect.name} takes away more noise than there is; give larger values")
            sigma = np.sqrt(variance)
    return sigma


def drawn_noise(work: Fieldwork, values: tuple[Floats, ...], seed: int, *key: str | int) -> Floats:
    """White noise (n, 3), a stream an observable."""
    count = len(work.sightings)
    draws = [stream(seed, *key, "noise", name).standard_normal(count) for name in OBSERVABLES]
    return np.stack(draws, axis=1) * noise_sigma(work, values)


def _recording(work: Fieldwork, readings: Floats, values: tuple[Floats, ...], seed: int, *key: str | int) -> Recording:
    found = with_lengths(_without_lengths(work, readings), work, values, seed, *key)
    return found.replace(notes=(*work.notes, *idle_effects(work)))


def _without_lengths(work: Fieldwork, readings: Floats) -> Recording:
    s = work.sightings
    return Recording(
        setup=_setup(work),
        stations=s.station_names,
        targets=s.target_names,
        station=s.station,
        target=s.target,
        face=s.face,
        repeat=s.repeat,
        time=s.time,
        readings=readings,
        covariates=s.covariates,
        labels=_balls(work),
    )


def _balls(work: Fieldwork) -> dict[str, tuple[str, ...]]:
    """The column of balls, where they have radii or a station carries its own."""
    scenario = work.scenario
    if not scenario.reflectors and not any(station.reflector for station in scenario.stations.values()):
        return {}
    return {REFLECTOR_COLUMN: balls_of(scenario, work.sightings)}


def idle_effects(work: Fieldwork) -> Iterator[str]:
    """A note on every effect that finds nothing to act on: a column, a time, a nest that is not there."""
    still = [e for e in work.effects if not isinstance(e, NoiseEffect) and not np.any(e.design(work.sightings))]
    if not still:
        return
    known = KnownLengths.of(with_stated(_without_lengths(work, work.sightings.raw), work.scenario))
    for effect in still:
        if np.any(effect.gauge_design(known.first, known.second, work.sightings.points)):
            continue
        left = np.any(effect.shift(work.sightings, np.zeros(len(effect.parameters))))
        yield f"{effect.name} {'adds one constant to every range' if left else 'changes nothing'} here"


def _setup(work: Fieldwork) -> Setup:
    """What a person knows: the floor plan, the nests, the maker's figures."""
    scenario, step = work.scenario, work.scenario.placing
    stations = {
        name: Station(
            position_mm=_rounded(s.position_mm, step.plan_step_mm),
            yaw_deg=step.plan_step_deg * round(s.yaw_deg / step.plan_step_deg),
            levelled=s.levelled,
            levelling_sigma_arcsec=s.levelling_sigma_arcsec,
            instrument=s.instrument,
        )
        for name, s in scenario.stations.items()
    }
    return Setup(
        title=scenario.title,
        instrument=_data_sheet(scenario.instrument) if "" in scenario.trackers else Instrument(),
        instruments={name: _data_sheet(tracker) for name, tracker in scenario.instruments.items()},
        stations=stations,
        targets=_targets(work),
        reflectors=scenario.reflectors,
        reference_radius_mm=scenario.reference_radius_mm,
    )


def _data_sheet(tracker: Tracker) -> Instrument:
    """What its maker states of a tracker."""
    limits = tracker.limits
    return Instrument(
        construction="steering-mirror" if tracker.construction == "steering-mirror" else "source-in-head",
        corrected=tracker.corrected,
        noise=tracker.noise,
        prior=tracker.prior,
        limits=Limits(elevation_min_deg=limits.elevation_min_deg, elevation_max_deg=limits.elevation_max_deg),
    )


def _rounded(place: tuple[float, float, float], step: float) -> tuple[float, float, float]:
    x, y, z = (step * round(value / step) for value in place)
    return x, y, z


def _targets(work: Fieldwork) -> dict[str, Target]:
    """What is known of each target that is seen: its nest, whether it is re-aimed, its reflector."""
    scenario, s = work.scenario, work.sightings
    known = {}
    for i, name in enumerate(s.target_names):
        normal = tuple(round(float(x), 4) for x in s.nest_normal[i])
        own = scenario.targets[name].reflector if name in scenario.targets else None
        known[name] = Target(
            nest_normal=(normal[0], normal[1], normal[2]) if np.all(np.isfinite(normal)) else None,
            reaimed=bool(s.reaimed[i]),
            reflector=own or scenario.smr.reflector,
        )
    return known


def _truth(work: Fieldwork, instrument: Floats, values: tuple[Floats, ...], seed: int, *key: str | int) -> Truth:
    s, scenario = work.sightings, work.scenario
    trackers = scenario.trackers
    names = work.construction.names_of(tuple(trackers))
    nominal = None
    if scenario.cmm.nominal:
        nominal = nominal_points(s.points, s.target_names, scenario.cmm, seed, *key)
    return Truth(
        title=scenario.title,
        seed=seed,
        stations=s.station_names,
        position=s.position,
        rotation=s.rotation,
        targets=s.target_names,
        points=s.points,
        construction=work.construction.name,
        instrument=dict(zip(names, instrument.ravel().tolist(), strict=True)),
        units=dict(zip(names, [p.unit for p in work.construction.parameters] * len(trackers), strict=True)),
        effects=tuple(AppliedEffect(e, v) for e, v in zip(work.effects, values, strict=True)),
        noise_factor=scenario.instrument.noise_factor,
        trackers=tuple(
            TrackerTruth(name, scenario.stations_of(name), tracker.noise_factor)
            for name, tracker in trackers.items()
            if scenario.instruments
        ),
        nominal=nominal,
    )
