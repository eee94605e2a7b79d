"""Measurements that a person could add to a recording: pointings from the last station, or a further station."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.arrays import Floats, Ints
from ltsim.errors import NetworkError
from ltsim.geometry.alignment import align
from ltsim.geometry.rotations import about_z
from ltsim.model.measurement import MeasurementModel, State
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Limits, Station
from ltsim.scene.visibility import SightLimits, visibility
from ltsim.units import DEGREE, MILLIMETRE

CLOSING = 3
"""Targets measured again before leaving a station."""
ROUNDS, AGAIN = 4, 3
"""Further rounds at the last station, and pointings at a target worth another look."""
GRID, TURNS = 5, 4
"""Places along each side of the floor, and turns at each, that are tried for a further station."""
NEAR = 0.8
"""[m] how near to another station, and to a target, a further one is not put."""


@dataclass(frozen=True)
class Extension:
    """A measurement that could be added.

    Attributes
    ----------
    kind : str
        `pointings` or `station`.
    words : str
        What to do, for a person.
    seconds : float, [s]
    recording : Recording
        The recording with these pointings, as the adjusted network predicts them.
    state : State
    place : (3,) float or None, [m]
        Of a further station, in the frame `frame` says.
    yaw : float or None, [rad]
    """

    kind: str
    words: str
    seconds: float
    recording: Recording
    state: State
    place: Floats | None = None
    yaw: float | None = None

    def adjustment(self, like: Adjustment) -> Adjustment:
        """The adjustment that the extended recording would have."""
        return Adjustment.planned(self.recording, self.state, like.construction)


@dataclass(frozen=True)
class FloorPlan:
    """From the network's frame to the floor plan's; the identity where no plan is known.

    Attributes
    ----------
    rotation : (3, 3), translation : (3,) float
    known : bool
    """

    rotation: Floats
    translation: Floats
    known: bool

    @classmethod
    def of(cls, recording: Recording, state: State) -> FloorPlan:
        """By at least three stations whose places on the plan the set-up states."""
        stated = [recording.station_setup(name).position_mm for name in recording.stations]
        known = [i for i, place in enumerate(stated) if place is not None]
        try:
            goal = np.array([stated[i] for i in known], dtype=np.float64).reshape(-1, 3) * MILLIMETRE
            rotation, translation = align(state.position[known], goal)
        except NetworkError:
            return cls(np.eye(3), np.zeros(3), known=False)
        return cls(rotation, translation, known=True)

    def place(self, position: Floats) -> Floats:
        """Positions (..., 3) on the plan."""
        moved: Floats = position @ self.rotation.T + self.translation
        return moved

    def yaw(self, rotation: Floats) -> float:
        """Turn [rad] on the plan of an instrument's rotation (3, 3)."""
        turned = self.rotation @ rotation
        return float(np.arctan2(turned[1, 0], turned[0, 0]))


def appended(
    adjustment: Adjustment, state: State, station: Ints, target: Ints, face: Ints, start: float, name: str = ""
) -> Recording:
    """The adjusted recording with further pointings, one every `seconds_per_pointing`; `name` is a new station's."""
    recording = adjustment.recording
    count, step = len(station), seconds_per_pointing(recording)
    if name:
        first = recording.station_setup(recording.stations[0])
        known = {**recording.setup.stations, name: Station(instrument=first.instrument)}
        setup = recording.setup.model_copy(update={"stations": known})
        recording = recording.replace(setup=setup, stations=(*recording.stations, name))
    filler = np.full(count, np.nan)
    labels = {key: (*column, *([""] * count)) for key, column in recording.labels.items()}
    whole = recording.replace(
        station=np.concatenate([recording.station, station]),
        target=np.concatenate([recording.target, target]),
        face=np.concatenate([recording.face, face]),
        repeat=np.concatenate([recording.repeat, np.full(count, recording.repeat.max(initial=0) + 1)]),
        time=np.concatenate([recording.time, start + step * np.arange(count)]),
        readings=np.concatenate([recording.readings, np.full((count, 3), np.nan)]),
        covariates={key: np.concatenate([column, filler]) for key, column in recording.covariates.items()},
        labels=labels,
    )
    predicted = MeasurementModel(whole, adjustment.construction).predict(state)
    readings = np.concatenate([recording.readings, predicted[len(recording) :]])
    return whole.with_readings(readings)


def seconds_per_pointing(recording: Recording) -> float:
    """[s] usual time between pointings; 15 where the recording has no clock."""
    if not recording.has_clock or len(recording) < 2:
        return 15.0
    return float(np.median(np.diff(np.sort(recording.time)))) or 15.0


def further_pointings(adjustment: Adjustment, suspects: Iterable[str] = ()) -> Iterator[Extension]:
    """What can be done from the last station before it is left; `suspects` are targets worth another look."""
    recording, state = adjustment.recording, adjustment.state
    last = int(recording.station[np.argmax(recording.time)])
    name, step = recording.stations[last], seconds_per_pointing(recording)
    here = np.flatnonzero(recording.station == last)
    here = here[np.argsort(recording.time[here], kind="stable")]
    order = np.array(list(dict.fromkeys(recording.target[here].tolist())), dtype=np.int64)
    used = np.unique(recording.face[here])
    usual = int(recording.face[here[0]])
    unseen = np.setdiff1d(np.arange(len(recording.targets)), order)

    def extension(words: str, target: Ints, face: int) -> Extension:
        count, start = len(target), float(recording.time.max()) + step
        whole = appended(adjustment, state, np.full(count, last), target, np.full(count, face), start)
        return Extension("pointings", words, count * step, whole, state)

    if len(used) == 1:
        yield extension(f"measure all targets from {name} in the other face as well", order[::-1], 3 - usual)
    yield extension(f"measure the first {CLOSING} targets of {name} again before leaving it", order[:CLOSING], usual)
    yield extension(f"measure all targets of {name} again in the reverse order", order[::-1], usual)
    again = [recording.targets.index(t) for t in dict.fromkeys(suspects) if t in recording.targets]
    again = [t for t in again if t in order]
    if again:
        listed = " and ".join(recording.targets[t] for t in again)
        repeated = np.tile(np.array(again, dtype=np.int64), AGAIN)
        words = f"measure {listed} from {name} {AGAIN} more times, without touching the reflector"
        yield extension(words, repeated, usual)
    rounds = np.tile(np.r_[order[::-1], order], ROUNDS // 2)
    yield extension(f"measure all targets of {name} {ROUNDS} more times, to and fro", rounds, usual)
    if len(unseen):
        listed = ", ".join(recording.targets[t] for t in unseen[:6])
        yield extension(f"measure from {name} the targets it has not measured ({listed})", unseen, usual)


def further_stations(adjustment: Adjustment, seconds_per_move: float) -> Iterator[Extension]:
    """A further station on a grid between and around the others, and a return to each with its base turned."""
    recording, state = adjustment.recording, adjustment.state
    plan = FloorPlan.of(recording, state)
    faces = np.unique(recording.face)
    start = float(recording.time.max()) + seconds_per_move
    name = next(f"S{i}" for i in range(1, 10_000) if f"S{i}" not in recording.stations)
    for position, rotation, words in _set_ups(adjustment, plan, name):
        seen = np.flatnonzero(visibility(position[None], state.points, _limits(recording)).visible[0])
        if len(seen) < 3:
            continue
        target, face = np.tile(seen, len(faces)), np.repeat(faces, len(seen))
        grown = replace(
            state,
            position=np.vstack([state.position, position]),
            rotation=np.concatenate([state.rotation, rotation[None]]),
            extra=np.zeros(0),
        )
        station = np.full(len(target), len(recording.stations))
        whole = appended(adjustment, grown, station, target, face, start, name)
        seconds = seconds_per_move + len(target) * seconds_per_pointing(recording)
        yield Extension("station", words, seconds, whole, grown, place=plan.place(position), yaw=plan.yaw(rotation))


def _set_ups(adjustment: Adjustment, plan: FloorPlan, name: str) -> Iterator[tuple[Floats, Floats, str]]:
    """Positions (3,), rotations (3, 3) in the network's frame, and words."""
    recording, state = adjustment.recording, adjustment.state
    for s, station in enumerate(recording.stations):
        words = f"set up once more at {station}, the base turned by 90 degrees, and measure all targets"
        yield state.position[s], state.rotation[s] @ about_z(np.pi / 2), words
    low, high = state.position.min(axis=0), state.position.max(axis=0)
    margin = 0.2 * (high - low) + 0.2
    frame = "floor plan" if plan.known else f"frame of {recording.stations[0]}"
    axes = [np.linspace(low[k] - margin[k], high[k] + margin[k], GRID) for k in range(2)]
    for x in axes[0]:
        for y in axes[1]:
            position = np.array([x, y, float(state.position[:, 2].mean())])
            others = np.concatenate([state.position, state.points])
            if np.linalg.norm(others - position, axis=1).min() < NEAR:
                continue
            for turn in range(TURNS):
                rotation = state.rotation[0] @ about_z(turn * 2 * np.pi / TURNS)
                a, yaw = plan.place(position), plan.yaw(rotation)
                words = (
                    f"add station {name} at ({a[0]:.2f}, {a[1]:.2f}, {a[2]:.2f}) m, yaw {yaw / DEGREE % 360:.0f} deg "
                    f"({frame}), and measure all targets"
                )
                yield position, rotation, words


def _limits(recording: Recording) -> SightLimits:
    travel = recording.instrument_of(recording.stations[0]).limits or Limits()
    return SightLimits(travel.elevation_min_deg * DEGREE, travel.elevation_max_deg * DEGREE)
