"""Injections of causes into the recordings of others, and what is right of a finding."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

import ltsim as lt
from experiments.common import RECORDINGS as DATA, Row
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.diagnosis.schema import Finding
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.recordings import Hints, Recording
from ltsim.recordings.recording import SIGMA_COLUMNS
from ltsim.simulation.injector import RecordingWithInjection

SAME = 0.5
"""Share of several stations or targets in common from which they are the same place."""
GREW = 0.01
"""Share by which what was told before has grown where it is told anew: a slip of metres moves with every micrometre."""


@cache
def background(file: str, clockwise: bool, told_noise: bool) -> tuple[Recording, Recording, tuple[Finding, ...]]:
    """A recording that is asked, the same with the noise that it has, and what is told of the first as it is."""
    recording = lt.read(DATA / file, hints=Hints(azimuth="clockwise") if clockwise else None)
    told = lt.diagnose(recording, held_out=False)
    sigma = told.final_adjustment.problem.reading_sigmas / [MILLIMETRE, ARCSECOND, ARCSECOND]
    columns = dict(zip(SIGMA_COLUMNS, sigma.T, strict=True))
    setup = recording.setup.model_copy(update={"centring": told.final_adjustment.recording.setup.centring})
    weighted = recording.replace(covariates={**recording.covariates, **columns}, setup=setup)
    if told_noise:
        recording, told = weighted, lt.diagnose(weighted, held_out=False)
    return recording, weighted, tuple(told.findings)


def place(one: Any, recording: Recording) -> tuple[set[str], set[str]]:
    """Stations and targets of a finding or a cause; everything where it is confined to none."""
    instruments = set(getattr(one, "instruments", ()))
    own = {s for s, i in zip(recording.station, recording.instrument, strict=True)
           if recording.instruments[i] in instruments}  # fmt: skip
    stations = set(one.stations) or {recording.stations[s] for s in own} or set(recording.stations)
    return stations, set(one.targets) or set(recording.targets)


def placed(cause: CandidateEffect, where: Any, recording: Recording) -> bool:
    """Stations and targets are those of the cause (several: half in common), and an observable of it is named."""
    pairs = zip(place(cause, recording), place(where, recording), strict=True)
    alike = all(a == b if len(a) < 2 else len(a & b) >= SAME * len(a | b) for a, b in pairs)
    acts = set(cause.observables)
    return alike and (not where.observables or not acts or bool(acts & set(where.observables)))


def named(cause: CandidateEffect, told: Finding) -> bool:
    """An effect by its name or among the equivalents; a law as unknown, with its carrier or its observables."""
    if not isinstance(cause, EmpiricalLaw):
        return cause.name in (told.effect, *(e.effect for e in told.equivalents))
    return not told.is_catalogued and (told.carrier == cause.response.name
                               or set(told.where.observables) == set(cause.observables))  # fmt: skip


def new(told: Finding, before: tuple[Finding, ...], strength: float) -> bool:
    """Nothing of this name, place and observables was told before, or it grew by half of what was put in."""
    same = [f.evidence.chi2_drop for f in before if (f.effect, key(f)) == (told.effect, key(told))]
    return all(told.evidence.chi2_drop - drop > max(strength / 2, GREW * drop) for drop in same)


def key(told: Finding) -> Any:
    return told.where.model_copy(update={"covariates": ()})


def injection(
    network: Row, kind: str, strength: float, trial: int, seed: int, told_noise: bool = False
) -> RecordingWithInjection:
    """A cause of a kind in the recording of a network; raises ModelError where the network shows no such cause."""
    recording, weighted, _ = background(network["file"], network.get("clockwise", False), told_noise)
    rng = np.random.default_rng([seed, *map(ord, network["file"] + kind), int(strength), trial])
    words = kind.format(station=rng.choice(recording.stations), unit=unit_of(recording))
    return lt.inject(weighted, words, noncentrality=strength, seed=int(rng.integers(2**31)))


def unit_of(recording: Recording) -> str:
    """Unit of time constants in the words of a cause."""
    return "min" if recording.has_clock else "rows"
