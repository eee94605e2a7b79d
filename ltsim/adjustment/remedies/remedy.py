"""Possible additional measurements: pointings, set-ups, other procedures, a reference length, near reflectors.

Calibration selects those that determine a combination of parameters, diagnosis and planning those that decide between
explanations.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ltsim.adjustment.remedies.network import Network
from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rotations import about_z
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Limits, Setup
from ltsim.scene.visibility import SightLimits, visibility

Kind = Literal["pointings", "return", "station", "survey", "length", "reflectors"]
EFFORT: tuple[Kind, ...] = get_args(Kind)
"""Kinds of remedies in the order of effort."""
SET_UPS = ("return", "station")

CLOSING = 3
"""Number of targets that are measured again before a station is left."""
ROUNDS = 4
AGAIN = 3
"""Number of additional rounds at the last station, and of pointings to a suspect target."""
TURN = 90.0 * DEGREE
"""Rotation of the base at a position that an instrument has already had."""
RETURNS = 12
"""Largest number of set-ups that are tried again, distributed evenly."""
GRID = 5
TURNS = 4
"""Number of positions along each side of the floor, and of yaws at each, that are tried for an additional station."""
CROWDED = 30
"""Number of set-ups from which no additional one is tried."""
CLEARANCE = 0.8
"""Smallest distance [m] of a proposed station from other stations and targets, and of a proposed target."""
BAR_LENGTH = 2.0
BAR_SIGMA_MM = 0.002
CALIBRATION = 7200.0
"""Length that a workshop can have calibrated [m], its standard deviation [mm], and the time [s] for it."""
NEAR = np.array([[1.2, a * DEGREE, e * DEGREE] for a, e in ((0, 40), (90, -30), (180, 40), (270, -30))])
"""Range [m], azimuth, elevation [rad] of near reflectors."""
NEST = 300.0
"""Time [s] to mount a nest."""
ADVICE = {
    # from the last station, before it is left
    "other face here": "measure all targets from {station} in the other face as well",
    "close here": "measure the first {count} targets of {station} again before leaving it",
    "reverse here": "measure all targets of {station} again in the reverse order",
    "look again": "measure {targets} from {station} {count} more times, without touching the reflector",
    "to and fro": "measure all targets of {station} {count} more times, forward and backward",
    "unmeasured": "measure from {station} the targets it has not measured ({targets})",
    # a further set-up
    "turned": "set up once more at {station}, the base turned by {turn:.0f} degrees, and measure all targets",
    "new station": "add station {station} at ({place[0]:.2f}, {place[1]:.2f}, {place[2]:.2f}) m, "
    "yaw {yaw:.0f} deg ({frame}), and measure all targets",
    # the whole work in another way
    "other face": "measure every target in both faces",
    "close": "measure the first {count} targets again before leaving each station",
    "reverse": "measure every station's targets again in the reverse order",
    # other things than pointings
    "length": "calibrate a length of about {length:.0f} m, such as that between {targets}",
    "near": "add reflectors at 1 to 1.5 m from two stations and measure them from all",
    "other face and near": "measure in both faces, and add reflectors at 1 to 1.5 m from two stations",
    # what it brings
    "decided": "{do}: expected chi-square between {first} and {others} from {now} to {then}",
    "left open": "; no tested measurement also separates it from {others}",
    "undecided": "no tested measurement separates {first} from {others} (chi-square {then}, {needed:.0f} needed); "
    "an independent measurement of the cause would",
    "cause": "an independent measurement of its cause",
    "determined": "{do} (gain {now:.2f} to {then:.2f})",
    "determined already": "use the network method: it determines this from the same recording (gain {then:.2f})",
    "not determined": "no tested measurement determines it; only a tighter specification does",
}
"""Sentences of advice by kind of remedy: the action, and its benefit."""


def advice(key: str, **values: object) -> str:
    """Sentence of advice with its values."""
    return ADVICE[key].format(**values)


def listed(names: list[str] | tuple[str, ...]) -> str:
    """Names joined by commas and `and`."""
    return " and ".join(names)


@dataclass(frozen=True)
class Remedy:
    """Remedy: a measurement that could be added."""

    kind: Kind
    words: str
    """Instruction to the user."""
    seconds: float
    """Duration of the measurement [s]."""
    network: Network
    """Network with the proposed measurement, with predicted readings."""

    @property
    def is_determined(self) -> bool:
        """True if every pose is determined with the proposed measurement.

        An additional set-up may see too few targets.
        """
        try:
            _ = self.network.adjustment
        except NetworkError:
            return False
        return True

    @property
    def set_up(self) -> tuple[Floats, float] | None:
        """Position (3,) [m] and yaw [rad] of an additional set-up, on the floor plan; None for another remedy."""
        state, plan = self.network.state, FloorPlan.of(self.network.recording, self.network.state)
        return (
            (plan.place(state.station_positions[-1]), plan.yaw(state.station_rotations[-1]))
            if self.kind in SET_UPS
            else None
        )


@dataclass(frozen=True)
class FloorPlan:
    """Transformation from the network frame to the floor plan; the identity without a plan.

    Plans are approximate, but levels are accurate: only the rotation about the vertical follows from the plan.
    """

    rotation: Floats
    """Rotation (3, 3) and translation (3,) [m]."""
    translation: Floats
    on_plan: bool

    @classmethod
    def of(cls, recording: Recording, state: NetworkState) -> FloorPlan:
        """Floor plan from the stations of an adjusted network."""
        return cls.by(recording.setup, recording.stations, state.station_positions, state.station_rotations)

    @classmethod
    def by(cls, setup: Setup, stations: Sequence[str], position: Floats, rotation: Floats) -> FloorPlan:
        """Floor plan from the positions (and directions of azimuth zero) of stations in a set-up."""
        setups = {i: setup.stations[name] for i, name in enumerate(stations) if name in setup.stations}
        placed = [i for i, station in setups.items() if station.position_mm is not None]
        if not placed:
            return cls(np.eye(3), np.zeros(3), on_plan=False)
        here, there = position[placed], np.array([setups[i].position_mm for i in placed]) * MILLIMETRE
        yaws = [i for i in placed if setups[i].yaw_deg is not None]
        if yaws:
            yaw = np.arctan2(rotation[yaws, 1, 0], rotation[yaws, 0, 0])
            turns = np.exp(1j * (np.array([setups[i].yaw_deg for i in yaws]) * DEGREE - yaw))
        else:
            away, goal = here - here.mean(axis=0), there - there.mean(axis=0)
            turns = (goal[:, 0] + 1j * goal[:, 1]) * (away[:, 0] - 1j * away[:, 1])
        turn = about_z(float(np.angle(turns.sum())))
        return cls(turn, there.mean(axis=0) - turn @ here.mean(axis=0), on_plan=True)

    def place(self, position: Floats) -> Floats:
        """Positions (..., 3) on the plan."""
        return position @ self.rotation.T + self.translation

    def yaw(self, rotation: Floats) -> float:
        """Yaw [rad] on the plan of an instrument with rotation (3, 3)."""
        turned = self.rotation @ rotation
        return float(np.arctan2(turned[1, 0], turned[0, 0]))


def further_pointings(network: Network, suspects: Iterable[str] = ()) -> Iterator[Remedy]:
    """Remedies at the last station before it is dismantled; `suspects` are targets that should be measured again."""
    recording = network.recording
    last = int(recording.station[np.argmax(recording.time)])
    station, here = recording.stations[last], _visit(recording, last)
    order = _first_visits(recording.target[here])
    usual = int(recording.face[here[0]])

    def remedy(key: str, target: Ints, face: int = usual, **values: object) -> Remedy:
        seconds = len(target) * network.seconds_per_pointing
        words = advice(key, station=station, **values)
        return Remedy("pointings", words, seconds, network.with_pointings(last, target, face))

    if len(np.unique(recording.face[here])) == 1:
        yield remedy("other face here", order[::-1], 3 - usual)
    yield remedy("close here", order[:CLOSING], count=min(CLOSING, len(order)))
    yield remedy("reverse here", order[::-1])
    again = [t for t in order.tolist() if recording.targets[t] in set(suspects)]
    if again:
        names = listed([recording.targets[t] for t in again])
        yield remedy("look again", np.tile(np.array(again, dtype=np.int64), AGAIN), targets=names, count=AGAIN)
    yield remedy("to and fro", np.tile(np.r_[order[::-1], order], ROUNDS // 2), count=ROUNDS)
    unseen = np.setdiff1d(np.arange(len(recording.targets)), order)
    away = np.linalg.norm(network.state.target_points[unseen] - network.state.station_positions[last], axis=1)
    unseen = unseen[away > CLEARANCE]  # nobody aims at the mark that the tripod stands on
    if len(unseen):
        yield remedy("unmeasured", unseen, targets=", ".join(recording.targets[t] for t in unseen[:6]))


def returns(network: Network, seconds_per_move: float, stations: Iterable[int] | None = None) -> Iterator[Remedy]:
    """Remedies with another set-up at each position of an instrument, with rotated base, for the same targets."""
    recording, state = network.recording, network.state
    count = len(recording.stations)
    chosen = np.unique(np.linspace(0, count - 1, min(count, RETURNS)).round().astype(int)).tolist()
    for s in chosen if stations is None else stations:
        target = _first_visits(recording.target[_visit(recording, s)])
        if len(target):
            words = advice("turned", station=recording.stations[s], turn=TURN / DEGREE)
            grown = network.with_station(
                _fresh(recording), s, state.station_positions[s], state.station_rotations[s] @ about_z(TURN)
            )
            yield _set_up("return", words, grown, target, seconds_per_move)


def further_stations(network: Network, seconds_per_move: float) -> Iterator[Remedy]:
    """Remedies with an additional station on a grid between and around the others, with several yaws."""
    recording, state = network.recording, network.state
    if len(recording.stations) >= CROWDED:
        return
    plan, name = FloorPlan.of(recording, state), _fresh(recording)
    frame = "floor plan" if plan.on_plan else f"frame of {recording.stations[0]}"
    travel = recording.instrument_of(recording.stations[0]).limits or Limits()
    limits = SightLimits(travel.elevation_min_deg * DEGREE, travel.elevation_max_deg * DEGREE)
    low, high = state.station_positions.min(axis=0), state.station_positions.max(axis=0)
    margin = 0.2 * (high - low) + 0.2
    x, y = (np.linspace(low[k] - margin[k], high[k] + margin[k], GRID) for k in range(2))
    places = np.array([(a, b, state.station_positions[:, 2].mean()) for a in x for b in y])
    taken = np.concatenate([state.station_positions, state.target_points])
    visible = visibility(places, state.target_points, limits).visible
    for position, sights in zip(places, visible, strict=True):
        if sights.sum() < 3 or np.linalg.norm(taken - position, axis=1).min() < CLEARANCE:
            continue
        for turn in range(TURNS):
            rotation = state.station_rotations[0] @ about_z(turn * 2 * np.pi / TURNS)
            place, yaw = plan.place(position), plan.yaw(rotation) / DEGREE % 360
            words = advice("new station", station=name, place=place, yaw=yaw, frame=frame)
            grown = network.with_station(name, 0, position, rotation)
            yield _set_up("station", words, grown, np.flatnonzero(sights), seconds_per_move)


def _set_up(kind: Kind, words: str, grown: Network, target: Ints, seconds_per_move: float) -> Remedy:
    """Remedy with targets measured from an additional set-up, the last one of a network."""
    recording, faces = grown.recording, np.unique(grown.recording.face)
    targets, face = np.tile(target, len(faces)), np.repeat(faces, len(target))
    start = float(recording.time.max()) + seconds_per_move
    seconds = seconds_per_move + len(targets) * grown.seconds_per_pointing
    return Remedy(kind, words, seconds, grown.with_pointings(len(recording.stations) - 1, targets, face, start))


def other_ways(network: Network) -> Iterator[Remedy]:
    """Remedies with a changed procedure at all stations: both faces if one is used, then another order."""
    recording = network.recording
    step, work = network.seconds_per_pointing, float(np.ptp(recording.time))
    for key in ("other face", "close", "reverse"):
        made = []
        for s in np.unique(recording.station):
            rows = _visit(recording, s)
            last = recording.time[rows[-1]]
            made += [(s, t, f, last + step * i) for i, (t, f) in enumerate(_more(recording, rows, key), 1)]
        if made:
            station, targets, faces, time = (np.array(column) for column in zip(*made, strict=True))
            grown = network.with_pointings(station, targets, faces, time)
            yield Remedy("survey", advice(key, count=CLOSING), work + len(made) * step, grown)


def _more(recording: Recording, rows: Ints, key: str) -> list[tuple[int, int]]:
    """Target and face of the additional pointings of a visit under another procedure."""
    made = list(zip(recording.target[rows].tolist(), recording.face[rows].tolist(), strict=True))
    if key == "other face":
        return sorted({(t, 3 - f) for t, f in made} - set(made))
    if key == "close":
        return [(t, made[0][1]) for t in _first_visits(recording.target[rows])[:CLOSING].tolist()]
    return made[::-1]


def other_face(network: Network) -> Remedy | None:
    """Remedy with both faces at each station; None if they are already used."""
    first = next(other_ways(network), None)
    return first if first and first.words == advice("other face") else None


def calibrated_length(network: Network) -> Iterator[Remedy]:
    """Remedy with a calibrated length between the pair of targets with a distance nearest to 2 m."""
    points, names = network.state.target_points, network.recording.targets
    if len(points) < 2:
        return
    first, second = np.triu_indices(len(points), k=1)
    best = int(np.argmin(np.abs(np.linalg.norm(points[first] - points[second], axis=1) - BAR_LENGTH)))
    i, j = int(first[best]), int(second[best])
    words = advice("length", length=BAR_LENGTH, targets=listed([names[i], names[j]]))
    yield Remedy("length", words, CALIBRATION, network.with_length(i, j, BAR_SIGMA_MM))


def near_reflectors(network: Network) -> Iterator[Remedy]:
    """Remedies with four reflectors near each of the first two stations, measured from all stations."""
    both = other_face(network)
    for key, start in [("near", network), *([("other face and near", both.network)] if both else [])]:
        recording, state = start.recording, start.state
        points = np.concatenate([centre + from_polar(NEAR) for centre in state.station_positions[:2]])
        axes = (
            np.arange(len(recording.stations)),
            len(state.target_points) + np.arange(len(points)),
            np.unique(recording.face),
        )
        station, target, face = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        wider = start.with_targets([f"near-{i + 1}" for i in range(len(points))], points)
        grown = wider.with_pointings(station, target, face)
        added = len(grown.recording) - len(network.recording)
        seconds = NEST * len(points) + float(np.ptp(recording.time)) + added * start.seconds_per_pointing
        yield Remedy("reflectors", advice(key), seconds, grown)


def _visit(recording: Recording, station: int) -> Ints:
    """Rows of one set-up in the order of time."""
    here = np.flatnonzero(recording.station == station)
    return here[np.argsort(recording.time[here], kind="stable")]


def _first_visits(target: Ints) -> Ints:
    """Distinct targets in the order of their first pointings."""
    return np.array(list(dict.fromkeys(target.tolist())), dtype=np.int64)


def _fresh(recording: Recording) -> str:
    """Name that no set-up has."""
    return next(f"S{i}" for i in range(1, len(recording.stations) + 2) if f"S{i}" not in recording.stations)
