"""Set-ups as surveyors' tables hold them: over marks that are targets too, with a circle that each round turns anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ltsim.arrays import Floats
from ltsim.recording.setup import EXACT_LEVEL_ARCSEC, Setup, Station
from ltsim.recording.tables.rows import Table

TURNED = 1e-3
"""[rad] By which a round's directions differ from another's where the circle was turned between them."""


def split_rounds(table: Table, readings: Floats) -> list[str]:
    """Rounds of one station whose circle was turned become set-ups of their own, in place; what is said of it."""
    if table.column(("round",)) is None:
        return []
    keys = [(p.station, p.round) for p in table.pointings]
    first: dict[tuple[str, str, int | None], tuple[str, float]] = {}
    gaps = []
    for p, (_, key), azimuth in zip(table.pointings, keys, readings[:, 1].tolist(), strict=True):
        other, before = first.setdefault((p.station, p.target, p.face), (key, azimuth))
        if other != key and np.isfinite(azimuth - before):
            gaps.append(abs(np.remainder(azimuth - before + np.pi, 2 * np.pi) - np.pi))
    if not gaps or max(gaps) < TURNED:
        return []
    names: dict[tuple[str, str], str] = {}
    for both in dict.fromkeys(keys):
        count = sum(station == both[0] for station, _ in names)
        names[both] = both[0] if not count else f"{both[0]}#{count + 1}"
    table.marks = {name: both[0] for both, name in names.items()}
    table.pointings = [replace(p, station=names[both]) for p, both in zip(table.pointings, keys, strict=True)]
    return [f"the circle was turned between rounds: {len(names)} rounds are set-ups of their own over their marks"]


def over_marks(table: Table, setup: Setup) -> tuple[Setup, list[str]]:
    """Stations of a table that states their heights: levelled, and over the target of their name."""
    if table.column(("instrument_height_mm",)) is None:
        return setup, []
    targets = {p.target for p in table.pointings}
    names = dict.fromkeys(p.station for p in table.pointings)
    marks = {name: table.marks.get(name, name) for name in names}
    shared = {mark for mark in marks.values() if mark in targets or list(marks.values()).count(mark) > 1}
    stations = {
        name: Station(levelled=True, levelling_sigma_arcsec=EXACT_LEVEL_ARCSEC, over=mark if mark in shared else None)
        for name, mark in marks.items()
        if name not in setup.stations
    }
    if not stations:
        return setup, []
    over = f", {len(shared)} marks are targets too" if shared else ""
    said = f"set-ups with heights over their marks are taken as levelled{over} (setup.toml can say otherwise)"
    return setup.model_copy(update={"stations": {**setup.stations, **stations}}), [said]
