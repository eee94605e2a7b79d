"""The workshop of a scenario, as planned: nothing is drawn and nothing measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ltsim.errors import SetupError
from ltsim.pages.workshop import Sights, Workshop
from ltsim.scene.cad import read_mesh, size_question
from ltsim.scene.visibility import Reason, Visibility
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.workshop import Layout, obstacles_of, planned, visibility_of
from ltsim.units import DEGREE, MILLIMETRE


def from_scenario(scenario: Scenario) -> Workshop:
    """Stations, targets, the room's corner and what stands in it; lines of sight where stations see targets.

    Raises
    ------
    SetupError
        When the scenario's gauge or one of its CAD files is impossible.
    """
    layout = planned(scenario)
    table = visibility_of(scenario, layout)
    obstacles = obstacles_of(scenario)
    hidden = int((~table.visible).sum())
    lost = (f"{hidden} of {table.visible.size} pairs do not see each other.",) if hidden else ()
    x, y, z = np.array(scenario.workshop.size_mm) * MILLIMETRE
    gauge = range(len(scenario.targets), len(layout.targets))
    return Workshop(
        title=scenario.title,
        stations=layout.stations,
        position=layout.position,
        rotation=layout.rotation,
        targets=layout.targets,
        points=layout.points,
        nest_normal=np.where(layout.reaimed[:, None], np.nan, layout.nest_normal),
        floor=np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]]),
        walls=np.array(
            [
                [[0.0, 0.0, 0.0], [0.0, y, 0.0], [0.0, y, z], [0.0, 0.0, z]],
                [[0.0, 0.0, 0.0], [x, 0.0, 0.0], [x, 0.0, z], [0.0, 0.0, z]],
            ]
        ),
        gauge=tuple((i, j) for i in gauge for j in gauge if i < j),
        elevation_min=max(t.limits.elevation_min_deg for t in scenario.trackers.values()) * DEGREE,
        sights=_sights(layout, table),
        obstacles=np.zeros((0, 3, 3)) if obstacles is None else obstacles.triangles,
        hidden=np.argwhere(table.reason == Reason.OBSTACLE),
        notes=lost,
    )


def with_cad(workshop: Workshop, file: Path, unit: str | None = None, up: str | None = None) -> Workshop:
    """The workshop with a CAD file standing in it; `unit` and `up` where its format's convention does not hold.

    Raises
    ------
    SetupError
        When it cannot be read, or its size has to be asked about.
    """
    cad = read_mesh(file, unit, up)
    if asked := size_question(cad, np.ptp(workshop.floor, axis=0)):
        raise SetupError(asked)
    return replace(workshop, obstacles=np.concatenate([workshop.obstacles, cad.triangles]))


def _sights(layout: Layout, table: Visibility) -> Sights:
    """Pairs that see each other, with the elevation of the beam."""
    station, target = np.nonzero(table.visible)
    elevation = table.elevation[station, target] / DEGREE
    return Sights(station.astype(np.int64), target.astype(np.int64), elevation, "elevation of the beam [°]")
