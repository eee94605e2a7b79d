"""From a cell's scenario to the truth that its trials share, and to the calibrators that are compared."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from ltsim.arrays import Floats
from ltsim.campaigns.spec import Method
from ltsim.campaigns.truth import TrueEffect, Truth
from ltsim.effects.effect import Effect
from ltsim.errors import ModelError, SetupError
from ltsim.model.construction import Construction, construction, dh
from ltsim.model.measurement import State
from ltsim.recording.lengths import KnownLengths
from ltsim.recording.recording import OBSERVABLES, Recording
from ltsim.simulation.fieldwork import Fieldwork, fieldwork
from ltsim.simulation.lengths import certified_by, true_lengths
from ltsim.simulation.physics import effect_from, instrument_law, resolution_of, stated_noise
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import measure
from ltsim.simulation.workshop import Layout


def truth_of(
    scenario: Scenario, seed: int, *key: str | int, like: Truth | None = None, plan: Layout | None = None
) -> Truth:
    """The truth of a scenario with its geometry drawn once.

    Parameters
    ----------
    scenario : Scenario
    seed : int
    *key : str or int
        Of the geometry.
    like : Truth, optional
        Of the same scenario with another geometry; saves stating the set-up anew where the same targets are seen.
    plan : Layout, optional
        The scenario's, `ltsim.simulation.workshop.planned`.

    Raises
    ------
    SetupError
        When the scenario asks for something impossible.
    """
    read = {frozenset(tracker.observables) for tracker in scenario.trackers.values()}
    if len(read) > 1:
        raise SetupError("instruments: observables differ between the trackers; trials want the same of all")
    work = fieldwork(scenario, seed, *key, plan=plan)
    if work.sightings.lift is not None and np.any(work.sightings.lift):
        raise SetupError("reflectors: trials in batch measure with one ball; give all balls of the scenario one radius")
    if like is not None and _same_names(work, like):
        state, noise = _start_frame(work, like.mean), stated_noise(scenario, work.sightings)
        return replace(like, recording=_like(work, like), state=state, sightings=work.sightings, noise=noise)
    recording, known = _template(work, seed, *key)
    mean, sigma = instrument_law(scenario, work.construction)
    effects = _true_effects(work, known)
    return Truth(
        recording=recording,
        state=_start_frame(work, mean),
        sightings=work.sightings,
        construction=work.construction,
        mean=mean,
        sigma=sigma,
        noise=stated_noise(scenario, work.sightings),
        gauge_sigma=scenario.cmm.noise_factor * known.factor * known.certificate,
        recorded=np.isin(OBSERVABLES, [*next(iter(read))]),
        gauge_shared=np.array([*known.shared.values()]).T,
        effects=effects,
        step=resolution_of(scenario),
    )


def _start_frame(work: Fieldwork, mean: Floats) -> State:
    """The true geometry in the frame of the first station, or in the workshop's where levels define the vertical."""
    s = work.sightings
    if any(station.levelled for station in work.scenario.stations.values()):
        return State(s.position, s.rotation, s.points, mean)
    origin, turn = s.position[0], s.rotation[0]
    return State((s.position - origin) @ turn, turn.T @ s.rotation, (s.points - origin) @ turn, mean)


def _template(work: Fieldwork, seed: int, *key: str | int) -> tuple[Recording, KnownLengths]:
    """The recording with nominal readings and error-free lengths, and these."""
    recording = measure(work, seed, *key)[0].with_readings(work.sightings.raw)
    stated = KnownLengths.of(recording)
    exact = certified_by(recording, true_lengths(work, stated) / stated.factor)
    return exact, KnownLengths.of(exact)


def _same_names(work: Fieldwork, known: Truth) -> bool:
    """Whether the same stations see the same targets, between them all."""
    s, recording = work.sightings, known.recording
    return (s.station_names, s.target_names) == (recording.stations, recording.targets)


def _like(work: Fieldwork, known: Truth) -> Recording:
    """The recording of another geometry: the same set-up, other pointings."""
    s = work.sightings
    return known.recording.replace(
        station=s.station,
        target=s.target,
        face=s.face,
        repeat=s.repeat,
        time=s.time,
        readings=s.raw,
        covariates=s.covariates,
        notes=work.notes,
    )


def _true_effects(work: Fieldwork, known: KnownLengths) -> tuple[TrueEffect, ...]:
    """The scenario's effects with the law of their values; entries and effects are in the same order."""
    entries, seen, found = work.scenario.effects, Counter[tuple[str, str]](), []
    for i, effect in enumerate(work.effects):
        entry = entries[i] if i < len(entries) else None
        place = effect.place
        seen[effect.name, place] += 1
        given = {} if entry is None else entry.values
        mean = np.array([given.get(p.name, 0.0) * p.factor for p in effect.parameters])
        free = [entry is not None and entry.draw and p.name not in given for p in effect.parameters]
        sigma = np.where(free, np.array([p.prior_sigma for p in effect.parameters]), 0.0)
        key = f"{place} {seen[effect.name, place]}"
        by_length = effect.gauge_design(known.first, known.second, work.sightings.points)
        found.append(TrueEffect(effect, mean, sigma, key, by_length))
    return tuple(found)


def fitted_construction(method: Method) -> Construction:
    """The construction whose parameters a method estimates."""
    if method.construction == "dh":
        return dh(method.harmonics, method.degree)
    return construction(method.construction)


def fitted_effects(method: Method) -> tuple[Effect, ...]:
    """The further effects that a method estimates.

    Raises
    ------
    SetupError
        Naming the method's entry and what would be right.
    """
    found = []
    for number, entry in enumerate(method.effects):
        places = {"stations": entry.stations, "targets": entry.targets}
        try:
            found.append(effect_from(entry.name, places, entry.shape))
        except (ModelError, ValueError, TypeError, KeyError) as problem:
            raise SetupError(f"methods.{method.title}.effects.{number + 1}: {problem}") from None
    return tuple(found)
