"""From pointings as a foreign file lists them to a recording."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ltsim.arrays import Ints
from ltsim.errors import RecordError
from ltsim.recording.files import check_name, check_text
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Setup

NAN = float("nan")


@dataclass(frozen=True)
class Pointing:
    """One row: names, face, range [m], azimuth and elevation [rad] (NaN: not measured), time [s]."""

    station: str
    target: str
    face: int
    distance: float = NAN
    azimuth: float = NAN
    elevation: float = NAN
    time: float = NAN
    covariates: dict[str, float] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    source: str = ""


def indices(names: Iterable[str], kind: str, file: object) -> tuple[tuple[str, ...], Ints]:
    """Distinct names in order of appearance, and each one's index.

    Raises
    ------
    RecordError
        For a name that cannot stand in tables and paths.
    """
    place: dict[str, int] = {}
    index = []
    for row, name in enumerate(names):
        if name not in place:
            place[check_name(name, kind, file=file, row=row + 1, column=kind)] = len(place)
        index.append(place[name])
    return tuple(place), np.array(index, dtype=np.int64)


def recording_of(
    pointings: Sequence[Pointing], setup: Setup, *, notes: Sequence[str] = (), file: object = None
) -> Recording:
    """A recording of pointings in the order of the file; repeats are counted.

    Raises
    ------
    RecordError
        When there is nothing, a row measures nothing, or a name cannot be used.
    """
    if not pointings:
        raise RecordError("holds no pointings", file=file)
    stations, station = indices((p.station for p in pointings), "station", file)
    targets, target = indices((p.target for p in pointings), "target", file)
    readings = np.array([[p.distance, p.azimuth, p.elevation] for p in pointings])
    empty = np.flatnonzero(np.all(np.isnan(readings), axis=1))
    if len(empty):
        raise RecordError("nothing was measured here", file=file, row=int(empty[0]) + 1)
    time = np.array([p.time for p in pointings])
    has_clock = bool(np.all(np.isfinite(time)))
    columns = dict.fromkeys(name for p in pointings for name in p.covariates)
    words = dict.fromkeys(name for p in pointings for name in p.labels)
    return Recording(
        setup=setup,
        stations=stations,
        targets=targets,
        station=station,
        target=target,
        face=np.array([p.face for p in pointings], dtype=np.int64),
        repeat=_repeats(pointings),
        time=time if has_clock else np.arange(len(pointings), dtype=np.float64),
        readings=readings,
        covariates={c: np.array([p.covariates.get(c, NAN) for p in pointings]) for c in columns},
        labels={w: tuple(check_text(p.labels.get(w, ""), file=file) for p in pointings) for w in words},
        has_clock=has_clock,
        notes=tuple(notes),
        sources=tuple(p.source for p in pointings) if all(p.source for p in pointings) else (),
    )


def _repeats(pointings: Sequence[Pointing]) -> Ints:
    """1, 2, ... for every further pointing of one station to one target on one face."""
    seen: dict[tuple[str, str, int], int] = {}
    repeat = []
    for p in pointings:
        key = (p.station, p.target, p.face)
        seen[key] = seen.get(key, 0) + 1
        repeat.append(seen[key])
    return np.array(repeat, dtype=np.int64)
