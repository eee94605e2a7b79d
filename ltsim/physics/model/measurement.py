"""Scene, construction and effects give predicted readings and their derivatives."""

import itertools
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError
from ltsim.core.units import DEGREE, EARTH, MILLIMETRE
from ltsim.geometry.alignment import align
from ltsim.geometry.rigid import pose_design
from ltsim.geometry.rotations import about_z, from_rotation_vector, smallest_turn
from ltsim.physics.effects.signature import Signature
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import Construction
from ltsim.physics.model.incidence import IncidenceErrors, incidence_errors, incidence_shift
from ltsim.physics.model.nuisances import HeadHeights, head_heights, refraction_of, shared_errors
from ltsim.recordings.recording import Recording
from ltsim.recordings.reflectors import excess_radii
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class State:
    """State of a network: all quantities that an adjustment can change; SI, network frame."""

    position: Floats
    """(S, 3)."""
    rotation: Floats
    """Instrument frame to network frame, (S, 3, 3)."""
    points: Floats
    """(T, 3)."""
    instrument: Floats
    """Construction parameters of each instrument, (I, p)."""
    extra: Floats = field(default_factory=lambda: np.zeros(0))
    """Parameters of the further effects, (q,)."""

    def moved(self, pose: Floats, points: Floats, instrument: Floats, extra: Floats) -> Self:
        """The state after increments; `pose` (S, 6) is translation, then rotation vector in the network frame."""
        return type(self)(
            self.position + pose[:, :3],
            from_rotation_vector(pose[:, 3:]) @ self.rotation,
            self.points + points,
            self.instrument + instrument,
            self.extra + extra,
        )


@dataclass(frozen=True)
class Prediction:
    """Predicted raw readings (n, 3) and their derivatives.

    by_pose (n, 3, 6), by_target (n, 3, 3), by_instrument (n, 3, p), by_extra (n, 3, q).
    """

    readings: Floats
    by_pose: Floats
    by_target: Floats
    by_instrument: Floats
    by_extra: Floats


def sightings_of(recording: Recording, state: State) -> Sightings:
    """The sightings of a recording's pointings with stations and targets at `state`.

    Nest normals are turned from the floor plan into the network's frame (`plan_rotation`).
    """
    return _sightings(recording, state, plan_rotation(recording, state.position, state.rotation))


def _sightings(recording: Recording, state: State, turn: Floats) -> Sightings:
    """The same with nest normals turned by `turn` (3, 3)."""
    return Sightings(
        station=recording.station,
        target=recording.target,
        instrument=recording.instrument,
        face=recording.face,
        repeat=recording.repeat,
        time=recording.time,
        position=state.position,
        rotation=state.rotation,
        points=state.points,
        nest_normal=_nest_normals(recording) @ turn.T,
        reaimed=np.array([recording.target_setup(name).reaimed for name in recording.targets], dtype=bool),
        station_names=recording.stations,
        target_names=recording.targets,
        covariates=recording.circumstances,
        lift=lift_of(recording),
    )


def _nest_normals(recording: Recording) -> Floats:
    """Stated normals (T, 3) of the nests, floor plan; NaN where unknown."""
    missing = (np.nan, np.nan, np.nan)
    return _units([recording.target_setup(name).nest_normal or missing for name in recording.targets])


def verticals(recording: Recording) -> Floats:
    """Direction of plumb (S, 3) at each station, a unit vector of the network frame."""
    return _units([recording.station_setup(name).vertical or (0.0, 0.0, 1.0) for name in recording.stations])


def with_plumb_lines(recording: Recording, position: Floats) -> Recording:
    """The recording with the plumb lines of a sphere at levelled stations (S, 3), where its set-up is `curved`."""
    if not recording.setup.curved:
        return recording
    stations = dict(recording.setup.stations)
    lean = (position - position.mean(axis=0))[:, :2] / EARTH
    for name, (x, y) in zip(recording.stations, lean.tolist(), strict=True):
        station = recording.station_setup(name)
        if station.levelled and station.vertical is None:
            stations[name] = station.model_copy(update={"vertical": (x, y, 1.0)})
    return recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))


def _units(directions: list[tuple[float, float, float]]) -> Floats:
    vectors = np.array(directions, dtype=np.float64).reshape(-1, 3)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def lift_of(recording: Recording) -> Floats | None:
    """Lift (n, 3) [m] of each pointing's reflector over the target's mark; None where all stand on it.

    An instrument height stated for single pointings counts here, less the one of the set-up, which is part of the
    station's position.
    """
    instrument, target = recording.heights()
    usual = [recording.station_setup(name).instrument_height_mm * MILLIMETRE for name in recording.stations]
    height = target - (instrument - np.array(usual)[recording.station])
    lift = height[:, None] * verticals(recording)[recording.station] if np.any(height) else None
    off = smr_lift(recording)
    return off if lift is None else lift if off is None else lift + off


def smr_lift(recording: Recording) -> Floats | None:
    """The part (n, 3) [m] that SMRs of other radii than the reference have in it, along the normals of their nests.

    These are those of the set-up: `adjust` refuses a network that is not held in that frame.
    """
    excess = excess_radii(recording)
    return None if excess is None else excess[:, None] * np.nan_to_num(_nest_normals(recording))[recording.target]


@dataclass(frozen=True)
class MeasurementModel:
    """The forward model of a recording: which pointings, which construction, which further effects."""

    recording: Recording
    construction: Construction
    effects: tuple[Signature, ...] = ()

    @cached_property
    def heads(self) -> tuple[HeadHeights, ...]:
        """The heights of heads, where the set-up states how well they are known."""
        return head_heights(self.recording, verticals(self.recording))

    @cached_property
    def incidence(self) -> tuple[IncidenceErrors, ...]:
        """Incidence errors of reflectors in fixed nests; none where `effects` estimate them without a prior."""
        free = any(isinstance(effect, SmrIncidence) and not effect.place for effect in self.effects)
        return () if free or not has_plan(self.recording) else incidence_errors(self.recording)

    @property
    def incidence_columns(self) -> tuple[slice, ...]:
        """The values of each of `incidence` among the parameters (q,) beside network and instrument."""
        first = self.effects_size + sum(len(heads.parameters) for heads in self.heads)
        ends = first + np.cumsum([0, *(len(error.parameters) for error in self.incidence)])
        return tuple(slice(int(begin), int(end)) for begin, end in itertools.pairwise(ends))

    def reflectors(self, extra: Floats) -> dict[str, Floats]:
        """Parameters (p, ...) [SI] of `smr-incidence` of each reflector at values (q, ...), by its name."""
        columns = zip(self.incidence, self.incidence_columns, strict=True)
        return {error.reflector: error.law_values(extra[at]) for error, at in columns}

    @cached_property
    def nuisances(self) -> tuple[Signature, ...]:
        """Nuisance errors with a prior: heights of heads, reflectors, errors shared by readings, refraction."""
        return *self.heads, *self.incidence, *shared_errors(self.recording), *refraction_of(self.recording)

    @property
    def extra_effects(self) -> tuple[Signature, ...]:
        """All that is estimated beside network and instrument: the further effects, then errors of a stated size."""
        return *self.effects, *self.nuisances

    @property
    def extra_size(self) -> int:
        """Number of parameters q of all that."""
        return sum(len(effect.parameters) for effect in self.extra_effects)

    @property
    def effects_size(self) -> int:
        """Number of those of the further effects, which come first."""
        return sum(len(effect.parameters) for effect in self.effects)

    def _instrument_values(self, state: State) -> Floats:
        if len(state.instrument) == 1:
            return state.instrument[0]
        return state.instrument[self.recording.instrument]

    @cached_property
    def _nowhere(self) -> Sightings:
        """The pointings without their geometry, gathered once; nest normals of the floor plan."""
        stations, targets = len(self.recording.stations), len(self.recording.targets)
        none = np.zeros((stations, 3)), np.tile(np.eye(3), (stations, 1, 1)), np.zeros((targets, 3))
        return _sightings(self.recording, State(*none, np.zeros((0, 0))), np.eye(3))

    @cached_property
    def _horizontal(self) -> Bools | None:
        """Mask of horizontal distances; None where there are none."""
        flat = self.recording.is_horizontal
        return flat if flat.any() else None

    def sightings(self, state: State) -> Sightings:
        """The sightings of the pointings with stations, targets and instruments at `state`."""
        geometry = self.geometry(state)
        return self._completed(geometry, state, self._instrument_readings(geometry, state))

    def _completed(self, geometry: Sightings, state: State, raw: Floats) -> Sightings:
        """Sightings with the data that effects need: nest normals in the network frame, the instrument's readings."""
        turn = plan_rotation(self.recording, state.position, state.rotation)
        return replace(geometry, nest_normal=geometry.nest_normal @ turn.T, encoder=raw)

    def _instrument_readings(self, geometry: Sightings, state: State) -> Floats:
        return self.construction.readings(geometry.local, geometry.face, self._instrument_values(state))

    def geometry(self, state: State) -> Sightings:
        """The same as far as no effect is concerned."""
        return self._nowhere.at(state.position, state.rotation, state.points)

    def extra_design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, q) of the readings per unit of all that is estimated beside network and instrument."""
        if not self.extra_effects:
            return np.zeros((len(sightings), 3, 0))
        return np.concatenate([effect.design(sightings) for effect in self.extra_effects], axis=2)

    def extra_shift(self, sightings: Sightings, extra: Floats) -> Floats:
        """Change (n, 3) of the readings by all that, at values (q,)."""
        return self._shift(self.extra_effects, sightings, extra)

    def effects_shift(self, sightings: Sightings, extra: Floats) -> Floats:
        """The same by the further effects alone."""
        return self._shift(self.effects, sightings, extra)

    def incidence_shift(self, sightings: Sightings, extra: Floats) -> Floats:
        """The same by the incidence errors of reflectors alone."""
        return incidence_shift(self.recording, sightings, self.reflectors(extra))

    def _shift(self, signatures: tuple[Signature, ...], sightings: Sightings, extra: Floats) -> Floats:
        """Change (n, 3) by the first of all that is estimated beside network and instrument."""
        change = np.zeros((len(sightings), 3))
        for signature, values in zip(signatures, self._split(extra), strict=False):
            change += signature.shift(sightings, values)
        return change

    def predict(self, state: State) -> Floats:
        """Predicted raw readings (n, 3)."""
        sightings = self.geometry(state)
        raw = self._instrument_readings(sightings, state)
        if self.extra_effects:
            sightings = self._completed(sightings, state, raw)
            raw = raw + self.extra_shift(sightings, state.extra)
        if self._horizontal is not None:
            raw[self._horizontal, 0] *= np.abs(np.cos(raw[self._horizontal, 2]))
        return raw

    def _split(self, extra: Floats) -> list[Floats]:
        """The values of each effect; those that a state does not hold are 0."""
        sizes = [len(effect.parameters) for effect in self.extra_effects]
        whole = np.pad(extra, (0, sum(sizes) - len(extra)))
        return np.split(whole, np.cumsum(sizes)[:-1]) if sizes else []

    def linearised(self, state: State) -> Prediction:
        """Predicted readings and their derivatives by poses, targets, instrument and further effects."""
        sightings = self.geometry(state)
        values = self._instrument_values(state)
        raw, by_point, by_instrument = self.construction.readings_and_design(sightings.local, sightings.face, values)
        if self.extra_effects:
            sightings = self._completed(sightings, state, raw)
        by_target = by_point @ np.swapaxes(state.rotation, 1, 2)[sightings.station]
        by_pose = pose_design(by_target, sightings.arm)
        by_extra = np.zeros((len(sightings), 3, 0))
        if self.extra_effects:
            extra = zip(self.extra_effects, self._split(state.extra), strict=True)
            parts = [effect.linearised(sightings, values) for effect, values in extra]
            raw = raw + np.sum([part.shift for part in parts], axis=0)
            by_extra = np.concatenate([part.by_values for part in parts], axis=2)
            for further in (part.by_geometry for part in parts if part.by_geometry is not None):
                by_target, by_pose = by_target + further[0], by_pose + further[1]
        derivatives = by_pose, by_target, by_instrument, by_extra
        if self._horizontal is not None:
            reduce_to_horizontal(raw, derivatives, self._horizontal)
        return Prediction(raw, *derivatives)


def reduce_to_horizontal(raw: Floats, derivatives: tuple[Floats, ...], flat: Bools) -> None:
    """Turn the slope distances `flat` (n,) of readings (n, 3) and their derivatives into horizontal ones, in place."""
    range_, level = raw[flat, 0], raw[flat, 2]
    cosine = np.cos(level)
    sign = np.sign(cosine)
    for by in derivatives:
        by[flat, 0] = (sign * cosine)[:, None] * by[flat, 0] - (sign * range_ * np.sin(level))[:, None] * by[flat, 2]
    raw[flat, 0] = range_ * np.abs(cosine)


UPRIGHT = 5 * DEGREE
"""Largest spread of the axes of instruments on tripods [rad]; its cosine is compared with the length of their mean."""
PLACES = 3
"""Rough places of stations that turn the floor plan into the network's frame."""
ROUGH = 3 * DEGREE
"""Accuracy of directions on a floor plan [rad]: frames that agree within it are one frame."""


def has_plan(recording: Recording) -> bool:
    """True when the set-up turns directions on the floor plan into the network's frame (`plan_rotation`)."""
    stations = [recording.station_setup(name) for name in recording.stations]
    has_control = any(recording.target_setup(name).known_mm is not None for name in recording.targets)
    placed = sum(station.position_mm is not None for station in stations)
    return has_control or placed >= PLACES or any(station.yaw_deg is not None for station in stations)


def plan_rotation(recording: Recording, position: Floats, rotation: Floats) -> Floats:
    """Rotation (3, 3) from the set-up's frame to the network's.

    The stations' rough positions (three or more, off one line) say it; otherwise their yaws. With control points both
    frames are one, and nothing better is known where the set-up is silent: then it is the identity.
    Stations stand at `position` (S, 3) [m], `rotation` (S, 3, 3) turns their frames into the network's.
    """
    if any(recording.target_setup(name).known_mm is not None for name in recording.targets):
        return np.eye(3)
    setups = [recording.station_setup(name) for name in recording.stations]
    turn = _by_positions([s.position_mm for s in setups], position, rotation)
    if turn is None:
        turn = _by_yaws([s.yaw_deg for s in setups], rotation)
    if turn is None or np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)) < ROUGH:
        return np.eye(3)
    return turn


def _by_positions(places: list[tuple[float, float, float] | None], position: Floats, rotation: Floats) -> Floats | None:
    """Rotation from approximate coordinates of three or more stations; levels determine the vertical far better."""
    given = [i for i, p in enumerate(places) if p is not None]
    if len(given) < PLACES:
        return None
    plan = np.array([places[i] for i in given], dtype=np.float64) * MILLIMETRE
    axis = rotation[given, :, 2].mean(axis=0)
    level, here = np.eye(3), position[given]
    if np.linalg.norm(axis) > np.cos(UPRIGHT):
        level = smallest_turn(axis / np.linalg.norm(axis), np.array([0.0, 0.0, 1.0]))
        here, plan = here @ level.T * [1.0, 1.0, 0.0], plan * [1.0, 1.0, 0.0]
    try:
        turn, _ = align(plan, here)
    except NetworkError:
        return None
    return level.T @ turn


def _by_yaws(yaws: list[float | None], rotation: Floats) -> Floats | None:
    """Mean of the rotations that upright stations with these yaws ask for."""
    asked = [r @ about_z(yaw * DEGREE).T for yaw, r in zip(yaws, rotation, strict=True) if yaw is not None]
    if not asked:
        return None
    u, _, vt = np.linalg.svd(np.sum(asked, axis=0))
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
