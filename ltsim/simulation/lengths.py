"""What a person states of known lengths: the gauge's as a measuring machine gave them, and those of scale bars."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import Any

import numpy as np

from ltsim.arrays import Floats
from ltsim.recording.lengths import KnownLengths
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Gauge, GaugeDistance, LengthUse
from ltsim.simulation.fieldwork import Fieldwork
from ltsim.simulation.gauge import length_sigma
from ltsim.simulation.scenario import Scenario
from ltsim.units import MICROMETRE, MILLIMETRE


def exact_lengths(recording: Recording, work: Fieldwork) -> Recording:
    """The recording with certificates that are free of error: the lengths between the reflectors where they stand."""
    blank = with_stated(recording, work.scenario)
    known, points = KnownLengths.of(blank), work.sightings.points
    certified = np.linalg.norm(points[known.first] - points[known.second], axis=1) / known.factor
    return certified_by(blank, certified, _sigmas(blank, work.scenario, certified))


def certified_by(recording: Recording, length: Floats, sigma: Floats | None = None) -> Recording:
    """The recording with other certificates: lengths (g,) [m] at calibration, and their sigmas [m] if they change."""
    if recording.setup.gauge is None:
        return recording
    lines = []
    for i, (line, value) in enumerate(zip(recording.gauge.distance, length.tolist(), strict=True)):
        stated = {"length_mm": round(value / MILLIMETRE, 12)}
        if sigma is not None:
            stated["sigma_mm"] = max(round(float(sigma[i]) / MILLIMETRE, 6), 1e-6)
        lines.append(line.model_copy(update=stated))
    gauge = recording.gauge.model_copy(update={"distance": tuple(lines)})
    return recording.replace(setup=recording.setup.model_copy(update={"gauge": gauge}))


def with_stated(recording: Recording, scenario: Scenario) -> Recording:
    """The recording with what is stated of its known lengths besides the lengths themselves, which are 1 mm."""
    gauge, warm = scenario.gauge, scenario.workshop.temperature_c
    if gauge is None and not scenario.lengths:
        return recording
    lines = tuple(line for line in _lines(scenario) if {line.from_, line.to} <= set(recording.targets))
    own: dict[str, Any] = {}
    if gauge is not None:
        warm = warm if gauge.measured_at_c is None else gauge.measured_at_c
        own = gauge.model_dump(include={"calibrated_at_c", "expansion_per_k", *OPTIONAL})
    stated = Gauge(measured_at_c=warm, materials=scenario.materials or None, distance=lines, **own)
    return recording.replace(setup=recording.setup.model_copy(update={"gauge": stated}))


OPTIONAL = ("sigma_expansion_per_k", "sigma_temperature_k")


def _lines(scenario: Scenario) -> Iterator[GaugeDistance]:
    """One line a length, its length and sigma 1 mm: the pairs of the gauge, then the scale bars."""
    blank = {"length_mm": 1.0, "sigma_mm": 1.0}
    for a, b in combinations(scenario.gauge.targets if scenario.gauge else (), 2):
        yield GaugeDistance.model_validate({"from": a, "to": b, **blank})
    for length in scenario.lengths:
        use = length.model_dump(include=set(LengthUse.model_fields))
        yield GaugeDistance.model_validate({"from": length.from_, "to": length.to, **use, **blank})


def _sigmas(recording: Recording, scenario: Scenario, certified: Floats) -> Floats:
    """Standard deviations (g,) [m] of the certificates."""
    bars = {frozenset((bar.from_, bar.to)): bar.sigma_um for bar in scenario.lengths}
    gauge = scenario.gauge.sigma_um if scenario.gauge else None
    stated = [bars.get(frozenset((line.from_, line.to)), gauge) for line in recording.gauge.distance]
    by_machine = length_sigma(scenario.cmm, certified)
    return np.array(
        [own if um is None else um * MICROMETRE for um, own in zip(stated, by_machine.tolist(), strict=True)]
    )
