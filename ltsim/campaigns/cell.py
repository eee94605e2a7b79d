"""From a cell's scenario to the truth that its trials share, and to the calibrators that are compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ltsim.arrays import Floats
from ltsim.campaigns.spec import Method
from ltsim.campaigns.truth import Truth
from ltsim.effects.effect import Effect
from ltsim.errors import ModelError, SetupError
from ltsim.model.construction import Construction, construction, dh
from ltsim.model.measurement import State
from ltsim.recording.recording import OBSERVABLES, Recording
from ltsim.simulation.fieldwork import Fieldwork, fieldwork
from ltsim.simulation.physics import effect_from, resolution_of, stated_noise
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import error_free, population_of
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
        Of the geometry; without it that of the recording which `simulate` makes.
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
    if like is not None and not scenario.lengths and _same_names(work, like):
        there = replace(like.population, sightings=work.sightings, noise=stated_noise(scenario, work.sightings))
        state = _start_frame(work, there.mean)
        return replace(like, recording=_like(work, like), state=state, population=there, work=work)
    recording = error_free(work)
    population = population_of(work, recording)
    return Truth(
        recording=recording,
        state=_start_frame(work, population.mean),
        population=population,
        step=resolution_of(scenario),
        recorded=np.isin(OBSERVABLES, [*next(iter(read))]),
        work=work,
    )


def _start_frame(work: Fieldwork, mean: Floats) -> State:
    """The true geometry in the frame of the first station, or in the workshop's where levels define the vertical."""
    s = work.sightings
    if any(station.levelled for station in work.scenario.stations.values()):
        return State(s.position, s.rotation, s.points, mean)
    origin, turn = s.position[0], s.rotation[0]
    return State((s.position - origin) @ turn, turn.T @ s.rotation, (s.points - origin) @ turn, mean)


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
