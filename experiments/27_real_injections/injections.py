"""Injections of causes into recordings of other authors, and scoring rules for findings."""

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

MIN_COMMON_FRACTION = 0.5
"""Fraction of common stations or targets from which two groups of several count as the same place."""
MIN_GROWTH = 0.01
"""Relative growth of the chi-square decrease from which a finding of the background counts as new.

The decrease by a blunder of metres changes with every micrometre of the network."""


@cache
def background(file: str, clockwise: bool, estimates_noise: bool) -> tuple[Recording, Recording, tuple[Finding, ...]]:
    """Recording to be diagnosed, the same recording with its estimated noise, and the findings of its diagnosis."""
    recording = lt.read(DATA / file, hints=Hints(azimuth="clockwise") if clockwise else None)
    diagnosis = lt.diagnose(recording, held_out=False)
    sigma = diagnosis.final_adjustment.problem.reading_sigmas / [MILLIMETRE, ARCSECOND, ARCSECOND]
    columns = dict(zip(SIGMA_COLUMNS, sigma.T, strict=True))
    setup = recording.setup.model_copy(update={"centring": diagnosis.final_adjustment.recording.setup.centring})
    weighted = recording.replace(covariates={**recording.covariates, **columns}, setup=setup)
    if estimates_noise:
        recording, diagnosis = weighted, lt.diagnose(weighted, held_out=False)
    return recording, weighted, tuple(diagnosis.findings)


def place(finding_or_cause: Any, recording: Recording) -> tuple[set[str], set[str]]:
    """Stations and targets of a finding or a cause; all of them if it is not confined."""
    instruments = set(getattr(finding_or_cause, "instruments", ()))
    stations_of_instruments = {s for s, i in zip(recording.station, recording.instrument, strict=True)
           if recording.instruments[i] in instruments}  # fmt: skip
    stations = (
        set(finding_or_cause.stations)
        or {recording.stations[s] for s in stations_of_instruments}
        or set(recording.stations)
    )
    return stations, set(finding_or_cause.targets) or set(recording.targets)


def is_located(cause: CandidateEffect, finding_place: Any, recording: Recording) -> bool:
    """True if a finding has the stations and targets of the cause, and an observable in common.

    Of several stations or targets, half in common are enough.
    """
    pairs = zip(place(cause, recording), place(finding_place, recording), strict=True)
    agree = all(a == b if len(a) < 2 else len(a & b) >= MIN_COMMON_FRACTION * len(a | b) for a, b in pairs)
    acts = set(cause.observables)
    return agree and (not finding_place.observables or not acts or bool(acts & set(finding_place.observables)))


def is_named_correctly(cause: CandidateEffect, finding: Finding) -> bool:
    """True if the finding, or an equivalent, has the name of the effect.

    A law is named correctly if the finding is not in the catalogue and has the response or the observables of the law.
    """
    if not isinstance(cause, EmpiricalLaw):
        return cause.name in (finding.effect, *(e.effect for e in finding.equivalents))
    return not finding.is_catalogued and (finding.carrier == cause.response.name
                               or set(finding.where.observables) == set(cause.observables))  # fmt: skip


def is_new(finding: Finding, background_findings: tuple[Finding, ...], strength: float) -> bool:
    """True if no finding of the background has this name and place, or only with a smaller chi-square decrease."""
    same = [f.evidence.chi2_drop for f in background_findings if (f.effect, key(f)) == (finding.effect, key(finding))]
    return all(finding.evidence.chi2_drop - drop > max(strength / 2, MIN_GROWTH * drop) for drop in same)


def key(finding: Finding) -> Any:
    """Place and observables of a finding, without its covariates."""
    return finding.where.model_copy(update={"covariates": ()})


def injection(
    network: Row, kind: str, strength: float, trial: int, seed: int, estimates_noise: bool = False
) -> RecordingWithInjection:
    """Recording with an injected cause; raises ModelError if the recording cannot show a cause of this kind."""
    recording, weighted, _ = background(network["file"], network.get("clockwise", False), estimates_noise)
    rng = np.random.default_rng([seed, *map(ord, network["file"] + kind), int(strength), trial])
    cause = kind.format(station=rng.choice(recording.stations), unit=unit_of(recording))
    return lt.inject(weighted, cause, noncentrality=strength, seed=int(rng.integers(2**31)))


def unit_of(recording: Recording) -> str:
    """Unit of time constants in the text form of a cause."""
    return "min" if recording.has_clock else "rows"
