"""Candidates for further measurements: pointings, set-ups, other procedures, a reference length, near reflectors.

A calibration selects those that determine a combination of parameters. A diagnosis and a plan select those that decide
between possible causes of a misfit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, Self, get_args

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.network import PlannedNetwork
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import MIN_POINTS_FOR_POSE, rotation_about_z
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import ElevationLimits, Setup
from ltsim.scene.visibility import SightLimits, compute_visibility

VisibilityFunction = Callable[[Floats, Floats], Bools]
"""Function from N instrument positions (N, 3) and T targets (T, 3) on a floor plan [m] to flags (N, T), True
for targets in sight from a position. All flags are False at a position where no tripod may stand."""
CandidateKind = Literal["pointings", "return", "station", "survey", "length", "reflectors"]
"""Kind of a further measurement: `pointings` at the last station, `return` a repeated set-up, `station` a new set-up,
`survey` another procedure at all stations, `length` a calibrated length, `reflectors` near reflectors."""
CANDIDATE_KINDS_BY_EFFORT: tuple[CandidateKind, ...] = get_args(CandidateKind)
"""Kinds of further measurements, in order of increasing effort."""
CANDIDATE_KINDS_WITH_SETUP = ("return", "station")
"""Kinds of further measurements that need another set-up."""

N_ADDITIONAL_ROUNDS = 4
"""Number of proposed additional rounds (pointings to all targets) at the last station."""
N_POINTINGS_TO_SUSPECT_TARGET = 3
"""Number of proposed additional pointings to a target that may have moved."""
MAX_REPEATED_SETUPS = 12
"""Largest number of set-ups whose repetition is evaluated; of more set-ups, evenly spaced ones in the list are used."""
N_GRID_POSITIONS_PER_SIDE = 5
"""Number of candidate positions of an additional station along each side of the floor."""
N_CANDIDATE_YAWS = 4
"""Number of candidate yaws at each position of an additional station."""
REPEATED_SETUP_BASE_ROTATION = math.tau / N_CANDIDATE_YAWS
"""Proposed rotation [rad] of the tracker's base if it is set up again at a previous position."""
MAX_SETUPS_FOR_ADDITION = 30
"""Smallest number of set-ups in a recording for which no additional station is evaluated, to limit the time."""
MIN_PROPOSED_SPACING = 0.8
"""Smallest distance [m] of a proposed station or target from all other stations and targets."""
REFERENCE_BAR_LENGTH = 2.0
"""Assumed length [m] of a reference bar that a workshop can have calibrated."""
REFERENCE_BAR_SIGMA_MM = 0.002
"""Assumed standard deviation [mm] of the calibrated length of a reference bar."""
BAR_CALIBRATION_TIME = 7200.0
"""Assumed time [s] for the calibration of a reference bar."""
NEAR_REFLECTOR_COORDINATES = np.array(
    [[1.2, a * DEGREE, e * DEGREE] for a, e in ((0, 40), (90, -30), (180, 40), (270, -30))]
)
"""Range [m], azimuth [rad] and elevation [rad] of four proposed reflectors near a station, (4, 3)."""
NEST_MOUNTING_TIME = 300.0
"""Assumed time [s] to mount the nest of a reflector."""
ADVICE_SENTENCES = {
    # measurements at the last station
    "other face here": "measure all targets from {station} in the other face as well",
    "close here": "measure the first {count} targets of {station} again before leaving it",
    "reverse here": "measure all targets of {station} again in the reverse order",
    "look again": "measure {targets} from {station} {count} more times, without touching the reflector",
    "to and fro": "measure all targets of {station} {count} more times, forward and backward",
    "unmeasured": "measure from {station} the targets it has not measured ({targets})",
    # additional set-ups
    "turned": "set up once more at {station}, with the base turned by {turn:.0f} degrees, and measure all targets",
    "new station": "add station {station} at ({place[0]:.2f}, {place[1]:.2f}, {place[2]:.2f}) m, "
    "yaw {yaw:.0f} deg ({frame}), and measure {targets}",
    # the whole survey by another procedure
    "other face": "measure every target in both faces",
    "close": "measure the first {count} targets again before leaving each station",
    "reverse": "measure every station's targets again in the reverse order",
    # reference lengths and additional targets
    "length": "calibrate a length of about {length:.0f} m, such as the distance between {targets}",
    "near": "add reflectors at 1 to 1.5 m from two stations and measure them from all stations",
    "other face and near": "measure in both faces, and add reflectors at 1 to 1.5 m from two stations",
    # expected benefit of a measurement
    "decided": "{do}: the expected chi-square difference between {first} and {others} rises from {now} to {then}",
    "left open": "; no tested measurement also separates it from {others}",
    "undecided": "no tested measurement separates {first} from {others} (expected chi-square difference {then}, "
    "{needed:.0f} needed); an independent measurement of the cause would separate them",
    "cause": "an independent measurement of the cause",
    "determined": "{do} (information on this combination rises from {now:.0f} % to {then:.0f} %)",
    "network method": "calibrate with the method network: it determines this combination from the same recording",
    "determined already": "{do} (information on this combination is {then:.0f} %)",
    "not determined": "no tested measurement determines this combination; "
    "reference points or a tighter specification may do so",
}
"""Templates of sentences of advice by key: instructions for a measurement, and sentences on its expected benefit."""


def advice_sentence(template_key: str, **values: object) -> str:
    """Sentence of advice: template `template_key` of `ADVICE_SENTENCES`, with its placeholders replaced by `values`."""
    return ADVICE_SENTENCES[template_key].format(**values)


def list_text(names: list[str] | tuple[str, ...]) -> str:
    """Names joined by the word "and"."""
    return " and ".join(names)


@dataclass(frozen=True)
class CandidateMeasurement:
    """Candidate for a further measurement: instruction, duration, and the network with its predicted readings."""

    kind: CandidateKind
    """Kind of the measurement."""
    instruction: str
    """Instruction to the user who makes the measurement."""
    duration: float
    """Duration of the measurement [s]."""
    network: PlannedNetwork
    """Network that includes the proposed measurement, with predicted readings."""

    def make_adjustment(self) -> Adjustment | None:
        """Adjustment of the network with the proposed measurement; None if a pose remains undetermined.

        A pose is undetermined if an additional set-up measures too few targets.
        """
        try:
            return self.network.make_adjustment()
        except NetworkError:
            return None

    @property
    def added_setup_on_floor_plan(self) -> tuple[Floats, float] | None:
        """Position (3,) [m] and yaw [rad] of an additional set-up on the floor plan; None without such a set-up."""
        state, plan = self.network.state, FloorPlanTransform.from_recording(self.network.recording, self.network.state)
        return (
            (plan.positions_on_plan(state.station_positions[-1]), plan.yaw_on_plan(state.station_rotations[-1]))
            if self.kind in CANDIDATE_KINDS_WITH_SETUP
            else None
        )


@dataclass(frozen=True)
class FloorPlanTransform:
    """Transformation from the frame of the network to the floor plan; the identity if there is no floor plan.

    The transformation rotates only about the vertical, because levels are more accurate than positions on a floor plan.
    """

    rotation_to_plan: Floats
    """Rotation matrix (3, 3) from the frame of the network to the axes of the floor plan."""
    translation_to_plan: Floats
    """Translation (3,) [m] after the rotation to the axes of the floor plan."""
    has_plan: bool
    """True if `setup.toml` declares positions of stations on a floor plan."""

    @classmethod
    def from_recording(cls, recording: Recording, state: NetworkState) -> Self:
        """Transformation to the floor plan, from the station poses in `state` and their declared positions."""
        return cls.from_positions(recording.setup, recording.stations, state.station_positions, state.station_rotations)

    @classmethod
    def from_positions(cls, setup: Setup, stations: Sequence[str], position: Floats, rotation: Floats) -> Self:
        """Transformation to the floor plan, from network positions (S, 3) [m] and rotations (S, 3, 3) of S stations."""
        setups = {i: setup.stations[name] for i, name in enumerate(stations) if name in setup.stations}
        station_indices = [i for i, station in setups.items() if station.position_mm is not None]
        if not station_indices:
            return cls(np.eye(3), np.zeros(3), has_plan=False)
        here, there = position[station_indices], np.array([setups[i].position_mm for i in station_indices]) * MILLIMETRE
        yaws = [i for i in station_indices if setups[i].yaw_deg is not None]
        if yaws:
            yaw = np.arctan2(rotation[yaws, 1, 0], rotation[yaws, 0, 0])
            turns = np.exp(1j * (np.array([setups[i].yaw_deg for i in yaws]) * DEGREE - yaw))
        else:
            away, goal = here - here.mean(axis=0), there - there.mean(axis=0)
            turns = (goal[:, 0] + 1j * goal[:, 1]) * (away[:, 0] - 1j * away[:, 1])
        turn = rotation_about_z(float(np.angle(turns.sum())))
        return cls(turn, there.mean(axis=0) - turn @ here.mean(axis=0), has_plan=True)

    def positions_on_plan(self, position: Floats) -> Floats:
        """Positions (..., 3) [m] on the floor plan of positions (..., 3) [m] in the frame of the network."""
        return position @ self.rotation_to_plan.T + self.translation_to_plan

    def yaw_on_plan(self, rotation: Floats) -> float:
        """Yaw [rad] from x on the floor plan of an instrument with the rotation `rotation` (3, 3) in the network."""
        plan_rotation = self.rotation_to_plan @ rotation
        return float(np.arctan2(plan_rotation[1, 0], plan_rotation[0, 0]))


def pointing_candidates(
    network: PlannedNetwork, suspect_targets: Iterable[str] = (), visibility_function: VisibilityFunction | None = None
) -> Iterator[CandidateMeasurement]:
    """Candidates for further pointings at the last station, before the tracker is dismantled.

    `suspect_targets` may have moved and are measured again; `visibility_function` states what is in sight.
    """
    recording = network.recording
    last_index = int(recording.station[np.argmax(recording.time)])
    station, here = recording.stations[last_index], _setup_rows(recording, last_index)
    order = _targets_in_measurement_order(recording.target[here])
    usual_face = int(recording.face[here[0]])

    def candidate_at_station(key: str, target: Ints, face: int = usual_face, **values: object) -> CandidateMeasurement:
        seconds = len(target) * network.seconds_per_pointing
        words = advice_sentence(key, station=station, **values)
        return CandidateMeasurement("pointings", words, seconds, network.with_pointings(last_index, target, face))

    if len(np.unique(recording.face[here])) == 1:
        yield candidate_at_station("other face here", order[::-1], 3 - usual_face)
    yield candidate_at_station("close here", order[:MIN_POINTS_FOR_POSE], count=min(MIN_POINTS_FOR_POSE, len(order)))
    yield candidate_at_station("reverse here", order[::-1])
    repeat_targets = [t for t in order.tolist() if recording.targets[t] in set(suspect_targets)]
    if repeat_targets:
        names = list_text([recording.targets[t] for t in repeat_targets])
        yield candidate_at_station(
            "look again",
            np.tile(np.array(repeat_targets, dtype=np.int64), N_POINTINGS_TO_SUSPECT_TARGET),
            targets=names,
            count=N_POINTINGS_TO_SUSPECT_TARGET,
        )
    yield candidate_at_station(
        "to and fro", np.tile(np.r_[order[::-1], order], N_ADDITIONAL_ROUNDS // 2), count=N_ADDITIONAL_ROUNDS
    )
    unseen = np.setdiff1d(np.arange(len(recording.targets)), order)
    distances = np.linalg.norm(
        network.state.target_points[unseen] - network.state.station_positions[last_index], axis=1
    )
    unseen = unseen[distances > MIN_PROPOSED_SPACING]  # the mark under the tripod cannot be measured
    if visibility_function is not None:
        places = network.state.station_positions[[last_index]], network.state.target_points[unseen]
        plan = FloorPlanTransform.from_recording(recording, network.state)
        unseen = unseen[visibility_function(*map(plan.positions_on_plan, places))[0]]
    if len(unseen):
        yield candidate_at_station("unmeasured", unseen, targets=", ".join(recording.targets[t] for t in unseen[:6]))


def repeated_setup_candidates(
    network: PlannedNetwork, seconds_per_move: float, stations: Iterable[int] | None = None
) -> Iterator[CandidateMeasurement]:
    """Candidates for repeated set-ups at stations (indices `stations`, default all), with rotated base."""
    recording, state = network.recording, network.state
    n_stations = len(recording.stations)
    indices = np.unique(
        np.linspace(0, n_stations - 1, min(n_stations, MAX_REPEATED_SETUPS)).round().astype(int)
    ).tolist()
    for s in indices if stations is None else stations:
        target = _targets_in_measurement_order(recording.target[_setup_rows(recording, s)])
        if len(target):
            words = advice_sentence("turned", station=recording.stations[s], turn=REPEATED_SETUP_BASE_ROTATION / DEGREE)
            grown = network.with_station(
                _unused_station_name(recording),
                s,
                state.station_positions[s],
                state.station_rotations[s] @ rotation_about_z(REPEATED_SETUP_BASE_ROTATION),
            )
            yield _setup_candidate("return", words, grown, target, seconds_per_move)


def station_candidates(
    network: PlannedNetwork, seconds_per_move: float, visibility_function: VisibilityFunction | None = None
) -> Iterator[CandidateMeasurement]:
    """Candidates for additional stations, on a grid between and around the present stations, each with several yaws."""
    recording, state = network.recording, network.state
    if len(recording.stations) >= MAX_SETUPS_FOR_ADDITION:
        return
    plan, name = FloorPlanTransform.from_recording(recording, state), _unused_station_name(recording)
    frame = "floor plan" if plan.has_plan else f"frame of {recording.stations[0]}"
    travel = recording.instrument_of(recording.stations[0]).limits or ElevationLimits()
    limits = SightLimits(travel.elevation_min_deg * DEGREE, travel.elevation_max_deg * DEGREE)
    low, high = state.station_positions.min(axis=0), state.station_positions.max(axis=0)
    margin = 0.2 * (high - low) + 0.2
    x, y = (np.linspace(low[k] - margin[k], high[k] + margin[k], N_GRID_POSITIONS_PER_SIDE) for k in range(2))
    places = np.array([(a, b, state.station_positions[:, 2].mean()) for a in x for b in y])
    occupied_places = np.concatenate([state.station_positions, state.target_points])
    is_visible = compute_visibility(places, state.target_points, limits).is_visible
    if visibility_function is not None:
        is_visible = is_visible & visibility_function(*map(plan.positions_on_plan, (places, state.target_points)))
    for position, sights in zip(places, is_visible, strict=True):
        if sights.sum() < 3 or np.linalg.norm(occupied_places - position, axis=1).min() < MIN_PROPOSED_SPACING:
            continue
        for turn in range(N_CANDIDATE_YAWS):
            rotation = state.station_rotations[0] @ rotation_about_z(turn * 2 * np.pi / N_CANDIDATE_YAWS)
            place, yaw = plan.positions_on_plan(position), plan.yaw_on_plan(rotation) / DEGREE % 360
            targets = "all targets" if sights.all() else f"the {sights.sum()} targets in sight"
            words = advice_sentence("new station", station=name, place=place, yaw=yaw, frame=frame, targets=targets)
            grown = network.with_station(name, 0, position, rotation)
            yield _setup_candidate("station", words, grown, np.flatnonzero(sights), seconds_per_move)


def _setup_candidate(
    kind: CandidateKind, instruction: str, network: PlannedNetwork, target: Ints, seconds_per_move: float
) -> CandidateMeasurement:
    """Candidate for an additional set-up, the last station of `network`, that measures the targets `target` (k,)."""
    recording, faces = network.recording, np.unique(network.recording.face)
    targets, face = np.tile(target, len(faces)), np.repeat(faces, len(target))
    start_time = float(recording.time.max()) + seconds_per_move
    seconds = seconds_per_move + len(targets) * network.seconds_per_pointing
    return CandidateMeasurement(
        kind, instruction, seconds, network.with_pointings(len(recording.stations) - 1, targets, face, start_time)
    )


def procedure_candidates(network: PlannedNetwork) -> Iterator[CandidateMeasurement]:
    """Candidates for additional pointings at all stations by another procedure, such as both faces or another order."""
    recording = network.recording
    step, work = network.seconds_per_pointing, float(np.ptp(recording.time))
    for key in ("other face", "close", "reverse"):
        made = []
        for s in np.unique(recording.station):
            rows = _setup_rows(recording, s)
            last = recording.time[rows[-1]]
            made += [
                (s, t, f, last + step * i) for i, (t, f) in enumerate(_pointings_by_procedure(recording, rows, key), 1)
            ]
        if made:
            station, targets, faces, time = (np.array(column) for column in zip(*made, strict=True))
            grown = network.with_pointings(station, targets, faces, time)
            yield CandidateMeasurement(
                "survey", advice_sentence(key, count=MIN_POINTS_FOR_POSE), work + len(made) * step, grown
            )


def _pointings_by_procedure(recording: Recording, pointing_indices: Ints, procedure: str) -> list[tuple[int, int]]:
    """Target index and face of each additional pointing from one set-up by `procedure`, a key of `ADVICE_SENTENCES`."""
    existing = list(
        zip(recording.target[pointing_indices].tolist(), recording.face[pointing_indices].tolist(), strict=True)
    )
    if procedure == "other face":
        return sorted({(t, 3 - f) for t, f in existing} - set(existing))
    if procedure == "close":
        return [
            (t, existing[0][1])
            for t in _targets_in_measurement_order(recording.target[pointing_indices])[:MIN_POINTS_FOR_POSE].tolist()
        ]
    return existing[::-1]


def second_face_candidate(network: PlannedNetwork) -> CandidateMeasurement | None:
    """Candidate for additional pointings at each station in the face that was not used; None if both were used."""
    first_remedy = next(procedure_candidates(network), None)
    return first_remedy if first_remedy and first_remedy.instruction == advice_sentence("other face") else None


def calibrated_length_candidates(
    network: PlannedNetwork, suspect_targets: Iterable[str] = ()
) -> Iterator[CandidateMeasurement]:
    """Candidate for a calibrated length of about 2 m between two targets that are not among `suspect_targets`."""
    points, names = network.state.target_points, network.recording.targets
    usable = np.flatnonzero([name not in set(suspect_targets) for name in names])
    first, second = (usable[ends] for ends in np.triu_indices(len(usable), k=1))
    lengths = np.linalg.norm(points[first] - points[second], axis=1)
    is_distinct = lengths > REFERENCE_BAR_SIGMA_MM * MILLIMETRE
    if not is_distinct.any():
        return
    best_index = int(np.argmin(np.where(is_distinct, np.abs(lengths - REFERENCE_BAR_LENGTH), np.inf)))
    i, j = int(first[best_index]), int(second[best_index])
    words = advice_sentence("length", length=REFERENCE_BAR_LENGTH, targets=list_text([names[i], names[j]]))
    yield CandidateMeasurement("length", words, BAR_CALIBRATION_TIME, network.with_length(i, j, REFERENCE_BAR_SIGMA_MM))


def near_reflector_candidates(network: PlannedNetwork) -> Iterator[CandidateMeasurement]:
    """Candidates for four additional reflectors near each of the first two stations, measured from all stations."""
    two_face_remedy = second_face_candidate(network)
    for key, start in [
        ("near", network),
        *([("other face and near", two_face_remedy.network)] if two_face_remedy else []),
    ]:
        recording, state = start.recording, start.state
        centres = state.station_positions[:2]
        points = np.concatenate([centre + from_polar(NEAR_REFLECTOR_COORDINATES) for centre in centres])
        axes = (
            np.arange(len(recording.stations)),
            len(state.target_points) + np.arange(len(points)),
            np.unique(recording.face),
        )
        station, target, face = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        wider = start.with_targets([f"near-{i + 1}" for i in range(len(points))], points)
        grown = wider.with_pointings(station, target, face)
        added = len(grown.recording) - len(network.recording)
        seconds = NEST_MOUNTING_TIME * len(points) + float(np.ptp(recording.time)) + added * start.seconds_per_pointing
        yield CandidateMeasurement("reflectors", advice_sentence(key), seconds, grown)


def _setup_rows(recording: Recording, station: int) -> Ints:
    """Indices of the pointings from one set-up, in the order of measurement."""
    station_rows = np.flatnonzero(recording.station == station)
    return station_rows[np.argsort(recording.time[station_rows], kind="stable")]


def _targets_in_measurement_order(target: Ints) -> Ints:
    """Distinct target indices in the order of their first pointings, from the target `target` (n,) of each pointing."""
    return np.array(list(dict.fromkeys(target.tolist())), dtype=np.int64)


def _unused_station_name(recording: Recording) -> str:
    """Station name that the recording does not contain, such as `S5`."""
    return next(f"S{i}" for i in range(1, len(recording.stations) + 2) if f"S{i}" not in recording.stations)
