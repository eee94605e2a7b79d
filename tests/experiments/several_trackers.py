"""Several trackers on one network of many set-ups, one of them off: a scenario to calibrate and to diagnose.

A hall of 50 x 30 x 8 m with reflectors on its walls and pillars and in its floor. The set-ups stand in rows along it,
the trackers take turns, and each set-up sees what lies within its range. The errors of all trackers are corrected, but
for a small rest, and one constant of one of them is off.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ltsim.simulation.scenario import Scenario, validate_scenario

HALL = (50_000, 30_000, 8_000)
"""[mm]"""
ROWS = 5
REACH = 14_000
"""[mm] How far a set-up measures: it shares reflectors with its neighbours, not with the whole hall."""
SMALL = 0.02
"""Share of the prior that errors keep which somebody has corrected before."""


def scenario_of(
    *,
    setups: int = 100,
    trackers: int = 4,
    off: str = "C",
    errors: Mapping[str, float] | None = None,
    faces: int = 1,
) -> Scenario:
    """The hall measured by trackers A, B, C, ... in turns.

    Parameters
    ----------
    setups, trackers : int
    off : str
        The tracker whose constants are off.
    errors : mapping of str to float
        Its true errors in display units, default a beam tilt of 15 urad; the others are as small as everybody's.
    faces : int
        With one face the vertical index is known together with the encoder's cosines only, alone to 5 urad.
    """
    names = [chr(ord("A") + i) for i in range(trackers)]
    settings: dict[str, Any] = {
        name: {"corrected": True, "error_factor": SMALL, "errors": {"draw": True}} for name in names
    }
    settings[off]["errors"] |= {"beam-tilt": 15.0} if errors is None else dict(errors)
    for table in settings.values():
        table["limits"] = {"range_min_mm": 1_000, "range_max_mm": REACH}
    return validate_scenario(
        {
            "format": "ltsim-scenario/1",
            "title": f"{setups} set-ups of {trackers} trackers, {off} is off",
            "workshop": {"size_mm": HALL},
            "work": {"faces": faces, "minutes_per_move": 8.0},
            "instruments": settings,
            "stations": _stations(setups, names),
            "targets": _targets(),
        },
        Path(__file__),
    )


def _stations(count: int, trackers: list[str]) -> dict[str, dict[str, Any]]:
    """Rows along the hall, walked to and fro; heads between 1.4 and 2 m, each turned otherwise."""
    columns = -(-count // ROWS)
    stations = {}
    for i in range(count):
        row, place = divmod(i, columns)
        along = place if row % 2 == 0 else columns - 1 - place
        x, y = HALL[0] * (along + 0.5) / columns, HALL[1] * (row + 0.5) / ROWS
        stations[f"S{i + 1:03d}"] = {
            "position_mm": [x, y, 1_400 + 150 * (i % 5)],
            "yaw_deg": (137.5 * i) % 360,
            "instrument": trackers[i % len(trackers)],
        }
    return stations


def _targets() -> dict[str, dict[str, Any]]:
    """A grid of nests 5 m apart, in the floor, on pillars and under the roof by turns, and a row along each wall."""
    places: list[list[float]] = []
    heights = (100.0, 3_200.0, 7_200.0)
    for i in range(10):
        places += [
            [2_500 + 5_000 * i + 300 * k, 2_300 + 5_000 * k + 200 * i, heights[(i + 2 * k) % 3]] for k in range(6)
        ]
        places += [[2_500 + 5_000 * i, y, 1_000 + 500 * (i % 4)] for y in (50.0, HALL[1] - 50.0)]
    return {f"T{i + 1:03d}": {"position_mm": place} for i, place in enumerate(places)}
