"""Truth of a simulated recording, in a separate file (ltsim-truth/1) that no calibrator opens."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from ltsim.adjustment.evaluation.criteria import NOMINAL
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, RecordError, SetupError
from ltsim.core.results import Columns, Result
from ltsim.core.units import FACTOR, MILLIMETRE
from ltsim.core.values import ValueEquality
from ltsim.geometry.rotations import quaternion
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.verbs import shape_of
from ltsim.recordings.files import write_text
from ltsim.recordings.result_file import read_json
from ltsim.recordings.settings import checked
from ltsim.recordings.setup import Finite, TomlSection, Vector
from ltsim.simulation.sections import PlacedEffect


@dataclass(frozen=True)
class AppliedEffect(ValueEquality):
    """An effect that was at work, with the true values (q,) [SI] of its parameters."""

    effect: Effect
    values: Floats


class TrackerTruth(TomlSection):
    """An instrument with a name."""

    name: str
    """Name of the instrument in the set-up."""
    stations: tuple[str, ...] = ()
    """Stations where it stood."""
    noise_factor: Finite = 1.0
    """Ratio of its true noise to the declared noise."""


@dataclass(frozen=True, repr=False)
class Truth(Result):
    """True values from which a recording was simulated; SI units, the workshop's frame."""

    title: str
    seed: int
    stations: tuple[str, ...]
    position: Floats
    """(S, 3) [m]."""
    rotation: Floats
    """Instrument frame to workshop, (S, 3, 3)."""
    targets: tuple[str, ...]
    points: Floats
    """Positions without the displacements of effects, (T, 3) [m]."""
    construction: str
    instrument: Mapping[str, float]
    """[SI]: true values of the construction's parameters, ``beam-tilt@NAME`` where there are several instruments."""
    units: Mapping[str, str]
    """Display unit of each parameter."""
    effects: tuple[AppliedEffect, ...] = field(default_factory=tuple)
    """Applied effects, in addition to the instrument's parameters."""
    noise_factor: float = 1.0
    """Ratio of the drawn noise to the declared noise, of an instrument without a name."""
    trackers: tuple[TrackerTruth, ...] = ()
    """Named instruments; empty for an instrument without a name."""
    nominal: Floats | None = None
    """The targets as a measuring machine gave them, (T, 3) [m]."""
    trial: int = 0
    """Number of the trial among those of its seed."""

    def _lines(self) -> list[str]:
        title = f"{self.title}: " if self.title else ""
        effects = ", ".join(applied.effect.name for applied in self.effects) or "no effects"
        return [f"Truth: {title}seed {self.seed}, {len(self.instrument)} instrument parameters, {effects}"]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        return {"instrument": self._instrument, "targets": self._targets}

    def _instrument(self) -> Columns:
        return {
            "parameter": list(self.instrument),
            "value": [value / FACTOR[self.units[name]] for name, value in self.instrument.items()],
            "unit": list(self.units.values()),
        }

    def _targets(self) -> Columns:
        x, y, z = (self.points / MILLIMETRE).T
        return {"target": list(self.targets), "x_mm": x.tolist(), "y_mm": y.tolist(), "z_mm": z.tolist()}

    def to_json(self) -> dict[str, Any]:
        """The contents of a truth file."""
        trackers = {"instruments": [tracker.model_dump(mode="json") for tracker in self.trackers]}
        content: dict[str, Any] = {
            "format": TruthFile.model_fields["format"].default,
            "title": self.title,
            "seed": self.seed,
            "trial": self.trial,
            "construction": self.construction,
            "parameters": [_number(name, value, self.units[name]) for name, value in self.instrument.items()],
            "effects": [_effect_to_json(applied) for applied in self.effects],
            **(trackers if self.trackers else {"noise_factor": self.noise_factor}),
            "stations": [
                _point(name, place) | {"rotation_quaternion": quaternion(turn).tolist()}
                for name, place, turn in zip(self.stations, self.position, self.rotation, strict=True)
            ],
            "targets": [_point(*target) for target in zip(self.targets, self.points, strict=True)],
        }
        if self.nominal is not None:
            content["nominal"] = [_point(*target) for target in zip(self.targets, self.nominal, strict=True)]
        return content

    @classmethod
    def from_json(cls, content: Mapping[str, Any], file: object = "truth") -> Self:
        """The truth of a truth file's contents; raises RecordError."""
        table = checked(content, TruthFile, "truth file", file)
        unknown = {p.unit for p in table.parameters} - set(FACTOR)
        if unknown:
            raise RecordError(f"'{unknown.pop()}' is no unit, expected one of {', '.join(FACTOR)}", file=file)
        targets = [p.position_mm for p in table.targets]
        nominal = [p.position_mm for p in table.nominal or ()]
        if nominal and [p.name for p in table.nominal or ()] != [p.name for p in table.targets]:
            raise RecordError("the nominal points are not those of the targets, in their order", file=file)
        return cls(
            title=table.title,
            seed=table.seed,
            trial=table.trial,
            stations=tuple(s.name for s in table.stations),
            position=np.array([s.position_mm for s in table.stations]).reshape(-1, 3) * MILLIMETRE,
            rotation=Rotation.from_quat([s.rotation_quaternion for s in table.stations]).as_matrix(),
            targets=tuple(p.name for p in table.targets),
            points=np.array(targets).reshape(-1, 3) * MILLIMETRE,
            construction=table.construction,
            instrument={p.flat_name: p.value * FACTOR[p.unit] for p in table.parameters},
            units={p.flat_name: p.unit for p in table.parameters},
            effects=tuple(_effect_from_json(e, file) for e in table.effects),
            noise_factor=table.noise_factor,
            trackers=table.instruments,
            nominal=np.array(nominal) * MILLIMETRE if nominal else None,
        )


class _Number(TomlSection):
    """A parameter."""

    name: str
    """Name of the effect."""
    value: Finite
    """True value."""
    unit: str
    """Unit of the value."""


class _InstrumentNumber(_Number):
    """A parameter of an instrument."""

    instrument: str = ""
    """Name of the instrument, where there are several."""

    @property
    def flat_name(self) -> str:
        """Name of the parameter with its instrument, as of `Construction.names_of`."""
        return f"{self.name}@{self.instrument}" if self.instrument else self.name


class _Effect(PlacedEffect):
    """An effect of the catalogue."""

    name: str = Field(alias="effect")
    """Name of the effect in the catalogue."""
    parameters: tuple[_Number, ...] = ()
    """True values of its parameters."""


class _TruePoint(TomlSection):
    """A point."""

    name: str
    """Name of the effect."""
    position_mm: Vector
    """True position in the workshop's frame."""


class _Pose(_TruePoint):
    """A station."""

    rotation_quaternion: tuple[Finite, Finite, Finite, Finite]
    """Rotation from instrument to workshop, as a unit quaternion x, y, z, w."""


class TruthFile(TomlSection):
    """`truth.json`: from `simulate --truth`."""

    format: Literal["ltsim-truth/1"] = "ltsim-truth/1"
    """Format and version of this file."""
    title: str = ""
    """Free text."""
    seed: int = 0
    """Root of the random draws."""
    trial: int = 0
    """Number of the trial among those of its seed."""
    construction: str
    """Construction whose model made the readings."""
    parameters: tuple[_InstrumentNumber, ...] = ()
    """True errors of the instruments."""
    effects: tuple[_Effect, ...] = ()
    """Effects beyond the errors of the instruments."""
    noise_factor: Finite = 1.0
    """Ratio of the true noise to the declared noise, of an instrument without a name."""
    instruments: tuple[TrackerTruth, ...] = ()
    """The instruments, where they have names."""
    stations: tuple[_Pose, ...] = Field(min_length=1)
    """True poses of the stations."""
    targets: tuple[_TruePoint, ...] = Field(min_length=1)
    """True positions of the targets."""
    nominal: tuple[_TruePoint, ...] | None = None
    """Positions of the targets measured by a coordinate measuring machine."""


def _number(flat_name: str, value: float, unit: str) -> dict[str, Any]:
    """A parameter [SI] in its unit; `flat_name` as of `Construction.names_of`."""
    name, _, instrument = flat_name.partition("@")
    whose = {"instrument": instrument} if instrument else {}
    return {"name": name, "value": value / FACTOR[unit], "unit": unit, **whose}


def _point(name: str, position: Floats) -> dict[str, Any]:
    return {"name": name, "position_mm": (position / MILLIMETRE).tolist()}


def _effect_to_json(applied: AppliedEffect) -> dict[str, Any]:
    effect, values = applied.effect, applied.values.tolist()
    return {
        "effect": effect.name,
        "stations": list(effect.stations),
        "targets": list(effect.targets),
        "shape": shape_of(effect),
        "parameters": [_number(p.name, v, p.unit) for p, v in zip(effect.parameters, values, strict=True)],
    }


def _effect_from_json(entry: _Effect, file: object) -> AppliedEffect:
    try:
        effect = entry.effect("effects")
    except SetupError as problem:
        raise RecordError(str(problem), file=file) from None
    values = {p.name: p.value for p in entry.parameters}
    return AppliedEffect(effect, np.array([values.get(p.name, 0.0) * p.factor for p in effect.parameters]))


def write_truth(truth: Truth, path: Path) -> None:
    """Write a truth file at once."""
    write_text(path, json.dumps(truth.to_json(), indent=1) + "\n")


def read_truth(path: Path) -> Truth:
    """Read a truth file; raises RecordError."""
    return Truth.from_json(read_json(path, "truth file"), path)


def nominal_csv(truth: Truth) -> str:
    """The table ``target,x_mm,y_mm,z_mm`` of the measuring machine's points, which verification reads.

    Raises ModelError when the scenario has no measuring machine.
    """
    if truth.nominal is None:
        raise ModelError("the scenario measured no nominal points; set nominal = true in its table [cmm]")
    rows = ([name, *p] for name, p in zip(truth.targets, truth.nominal / MILLIMETRE, strict=True))
    return NOMINAL.filled(rows).csv()
