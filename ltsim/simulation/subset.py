"""The part of a scenario that is in use: the first stations of the file, reflectors spread over the room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import SetupError

if TYPE_CHECKING:
    from ltsim.simulation.scenario import Scenario

LEAST = 3
"""Targets, those of the gauge among them."""


def in_use(scenario: Scenario, file: Path) -> Scenario:
    """The scenario without the stations and reflectors that ``work.stations`` and ``work.targets`` leave out.

    Effects lose the places that are left out, trackers that then stand nowhere go too.

    Raises
    ------
    SetupError
        When more is asked for than there is, or fewer than three targets are left.
    """
    work = scenario.work
    for key, wanted, there in (
        ("stations", work.stations, scenario.stations),
        ("targets", work.targets, scenario.targets),
    ):
        if wanted is not None and wanted > len(there):
            raise SetupError(
                f"{file}: work.{key} is {wanted}, but the scenario holds {len(there)}: add some, or ask for fewer"
            )
    stations = dict(list(scenario.stations.items())[: work.stations])
    targets = scenario.targets if work.targets is None else _spread(scenario.targets, work.targets)
    gauge = scenario.gauge.targets if scenario.gauge else ()
    if len(targets) + len(gauge) < LEAST:
        raise SetupError(
            f"{file}: work.targets is {work.targets}, expected at least {LEAST - len(gauge)} of the reflectors"
        )
    if len(stations) == len(scenario.stations) and len(targets) == len(scenario.targets):
        return scenario
    used = {station.instrument for station in stations.values()}
    return scenario.model_copy(
        update={
            "stations": stations,
            "targets": targets,
            "instruments": {name: i for name, i in scenario.instruments.items() if name in used},
            "lengths": tuple(bar for bar in scenario.lengths if {bar.from_, bar.to} <= {*targets}),
            "effects": tuple(_effects(scenario.effects, {*stations}, {*targets, *gauge})),
        }
    )


def _effects(entries: Sequence[Any], stations: set[str], targets: set[str]) -> list[Any]:
    """The entries at places that are in use."""
    kept = []
    for entry in entries:
        here = {"stations": _left(entry.stations, stations), "targets": _left(entry.targets, targets)}
        if all(bool(left) == bool(getattr(entry, kind)) for kind, left in here.items()):
            kept.append(entry.model_copy(update=here))
    return kept


def _left(names: Sequence[str], known: set[str]) -> tuple[str, ...]:
    return tuple(name for name in names if name in known)


def _spread(targets: Mapping[str, Any], count: int) -> dict[str, Any]:
    """So many targets in the file's order: each next one is that farthest from those taken (Gonzalez 1985)."""
    places = np.array([t.position_mm for t in targets.values()], dtype=np.float64).reshape(-1, 3)
    taken = set(spread_order(places)[:count])
    return {name: target for i, (name, target) in enumerate(targets.items()) if i in taken}


def spread_order(places: Floats) -> list[int]:
    """Places (n, 3) in the order in which they fill the room, the one farthest from their middle first."""
    order: list[int] = []
    gap = np.linalg.norm(places - places.mean(axis=0), axis=1) if len(places) else np.zeros(0)
    for _ in range(len(places)):
        order.append(int(np.argmax(gap)))
        reach = np.linalg.norm(places - places[order[-1]], axis=1)
        gap = reach if len(order) == 1 else np.minimum(gap, reach)
        gap[order] = -1.0
    return order
