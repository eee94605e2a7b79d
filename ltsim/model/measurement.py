"""Scene, construction and effects give predicted readings and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect
from ltsim.geometry.rotations import cross_matrix, from_rotation_vector
from ltsim.model.construction import Construction
from ltsim.model.floor_plan import plan_rotation
from ltsim.recording.recording import Recording
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class State:
    """Everything an adjustment can change; SI, network frame.

    Attributes
    ----------
    position : (S, 3) float
    rotation : (S, 3, 3) float
        Instrument frame to network frame.
    points : (T, 3) float
    instrument : (I, p) float
        Construction parameters of each instrument.
    extra : (q,) float
        Parameters of the further effects.
    """

    position: Floats
    rotation: Floats
    points: Floats
    instrument: Floats
    extra: Floats = field(default_factory=lambda: np.zeros(0))

    def moved(self, pose: Floats, points: Floats, instrument: Floats, extra: Floats) -> State:
        """The state after increments; `pose` (S, 6) is translation, then rotation vector in the network frame."""
        return State(
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

    Nest normals are turned from the floor plan into the network's frame (`floor_plan.plan_rotation`).
    """
    known = [recording.target_setup(name) for name in recording.targets]
    missing = (np.nan, np.nan, np.nan)
    normal = np.array([t.nest_normal or missing for t in known], dtype=np.float64).reshape(-1, 3)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal @ plan_rotation(recording, state.position, state.rotation).T
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
        nest_normal=normal,
        reaimed=np.array([t.reaimed for t in known], dtype=bool),
        station_names=recording.stations,
        target_names=recording.targets,
        covariates=recording.covariates,
    )


@dataclass(frozen=True)
class MeasurementModel:
    """The forward model of a recording: which pointings, which construction, which further effects."""

    recording: Recording
    construction: Construction
    effects: tuple[Effect, ...] = ()

    @property
    def extra_size(self) -> int:
        """Number of parameters q of the further effects."""
        return sum(len(effect.parameters) for effect in self.effects)

    def with_effects(self, effects: tuple[Effect, ...]) -> MeasurementModel:
        """The same model with other further effects."""
        return replace(self, effects=effects)

    def _instrument_values(self, state: State) -> Floats:
        if len(state.instrument) == 1:
            return state.instrument[0]
        values: Floats = state.instrument[self.recording.instrument]
        return values

    def _extra_design(self, sightings: Sightings) -> Floats:
        if not self.effects:
            return np.zeros((len(sightings), 3, 0))
        return np.concatenate([effect.design(sightings) for effect in self.effects], axis=2)

    def predict(self, state: State) -> Floats:
        """Predicted raw readings (n, 3)."""
        sightings = sightings_of(self.recording, state)
        ideal = self.construction.readings(sightings.local, sightings.face, self._instrument_values(state))
        for effect, values in zip(self.effects, self._split(state.extra), strict=True):
            ideal = ideal + effect.shift(sightings, values)
        return ideal

    def _split(self, extra: Floats) -> list[Floats]:
        sizes = [len(effect.parameters) for effect in self.effects]
        return np.split(extra, np.cumsum(sizes)[:-1]) if sizes else []

    def linearised(self, state: State) -> Prediction:
        """Predicted readings and their derivatives by poses, targets, instrument and further effects."""
        sightings = sightings_of(self.recording, state)
        values = self._instrument_values(state)
        raw = self.construction.readings(sightings.local, sightings.face, values)
        by_point, by_instrument = self.construction.reading_design(raw, values)
        by_target = by_point @ np.swapaxes(state.rotation[sightings.station], 1, 2)
        arm = state.points[sightings.target] - state.position[sightings.station]
        by_pose = np.concatenate([-by_target, by_target @ cross_matrix(arm)], axis=2)
        by_extra = self._extra_design(sightings)
        for effect, extra in zip(self.effects, self._split(state.extra), strict=True):
            raw = raw + effect.shift(sightings, extra)
        return Prediction(raw, by_pose, by_target, by_instrument, by_extra)
