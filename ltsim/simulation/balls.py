"""Balls of several radii in a scenario: which one each pointing uses, and where its centre truly stands."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import RecordError, SetupError
from ltsim.randomness import stream
from ltsim.recording.reflectors import reference_radius, without_normal
from ltsim.scene.sightings import Sightings
from ltsim.simulation.scenario import Scenario
from ltsim.units import MILLIMETRE


def balls_of(scenario: Scenario, sightings: Sightings) -> tuple[str, ...]:
    """Name of the ball of each pointing: its station's, else its target's, else that of all; '' for none."""
    stations = [scenario.stations[name].reflector for name in sightings.station_names]
    targets = [scenario.targets[n].reflector if n in scenario.targets else None for n in sightings.target_names]
    places = zip(sightings.station, sightings.target, strict=True)
    return tuple(stations[s] or targets[t] or scenario.smr.reflector or "" for s, t in places)


def true_lift(scenario: Scenario, sightings: Sightings, seed: int, *key: str | int) -> Floats | None:
    """Where (n, 3) [m] each ball's centre stands from its target; None in a scenario of one ball.

    Raises
    ------
    SetupError
        When a pointing uses a ball without a table, one of another radius has no normal to lie along, or the reference
        is not stated.
    """
    reflectors = scenario.reflectors
    if not reflectors:
        return None
    names = balls_of(scenario, sightings)
    if "" in names:
        target = sightings.target_names[sightings.target[names.index("")]]
        raise SetupError(
            f"targets.{target}.reflector is missing: with tables [reflectors.NAME] every target, every station or "
            "[smr] names one of them"
        )
    used = tuple(dict.fromkeys(names))
    try:
        reference = reference_radius(used, reflectors, scenario.reference_radius_mm)
    except RecordError as problem:
        raise SetupError(str(problem)) from None
    known = np.isfinite(sightings.nest_normal[sightings.target, 0])
    lengths = np.zeros(len(names))
    for name in used:
        ball, mine = reflectors[name], np.array(names) == name
        error = (ball.sigma_radius_mm or 0.0) * float(stream(seed, *key, "reflector", name).standard_normal())
        lengths[mine] = (ball.radius_mm + error - reference) * MILLIMETRE
        lost = np.flatnonzero(mine & ~known)
        if len(lost) and ball.radius_mm != reference:
            target = sightings.target_names[sightings.target[lost[0]]]
            raise SetupError(without_normal(target, name, ball.radius_mm, reference))
    return lengths[:, None] * np.nan_to_num(sightings.nest_normal)[sightings.target]
