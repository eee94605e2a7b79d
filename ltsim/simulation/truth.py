"""True values of a simulated recording in a separate file (ltsim-truth/1) that calibration and diagnosis never read."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, PrivateAttr, model_validator
from scipy.spatial.transform import Rotation

from ltsim.adjustment.evaluation.criteria import NOMINAL_TABLE
from ltsim.core.arrays import Floats
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import LtsimError, ModelError
from ltsim.core.results import Table, number_columns, text_columns
from ltsim.core.units import MILLIMETRE, SI_PER_UNIT, permitted_units_text
from ltsim.geometry.rigid import quaternion_from_matrix
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.verbs import displayed_shape_parameters, make_effect
from ltsim.recordings.files import safe_excerpt, write_text
from ltsim.recordings.result_file import Entry, Finite, Quaternion, ResultFile, Vector, read_result

TRUE_INSTRUMENT_ERRORS_TABLE = Table(
    "instrument.csv",
    "true errors of the instruments",
    (*text_columns(parameter="name"), *number_columns(value="true value"), *text_columns(unit="unit of the value")),
)
TRUE_POINTS_TABLE = Table(
    "points.csv",
    "true positions of the targets in the hall frame",
    (
        *text_columns(target="name"),
        *number_columns("r", ".3f", x_mm="coordinate", y_mm="coordinate", z_mm="coordinate"),
    ),
)


@dataclass(frozen=True)
class AppliedEffect(ValueEquality):
    """Effect that was applied in a simulation, with the true values of its parameters."""

    effect: Effect
    """Physical effect, with the stations and targets where it acts."""
    parameter_values: Floats
    """True values of the parameters of the effect, shape (parameters,) [SI]."""


@dataclass(frozen=True)
class TruthArrays(ValueEquality):
    """True values of a simulation as arrays in SI units, in the frame of the hall."""

    station_positions: Floats
    """Positions of the stations, shape (stations, 3) [m]."""
    station_rotations: Floats
    """Rotation matrices from instrument to hall, shape (stations, 3, 3)."""
    target_points: Floats
    """Positions of the targets before effects displace them, shape (targets, 3) [m]."""
    instrument_values: Mapping[str, float]
    """True parameters of the instruments by name [SI]; ``beam-tilt@NAME`` if there are several instruments."""
    effects: tuple[AppliedEffect, ...] = ()
    """Effects that the simulation applied, in addition to the instrument's parameters."""
    nominal_points: Floats | None = None
    """Coordinates of the targets as measured by a coordinate measuring machine, shape (targets, 3) [m]; None if the
    scenario has no such machine."""


def _checked_unit(unit: str) -> str:
    """Unit `unit`, unchanged; ValueError for a text that is not a known unit."""
    if unit not in SI_PER_UNIT:
        raise ValueError(f"'{safe_excerpt(unit)}' is not a unit, expected one of {permitted_units_text()}")
    return unit


class TrackerTruth(Entry):
    """Entry of a truth file for a tracker with a name: its stations and its noise."""

    name: str
    """Name of the instrument in the set-up."""
    stations: tuple[str, ...] = ()
    """Names of the stations where the tracker stood."""
    noise_factor: Finite = 1.0
    """Ratio of the true to the declared standard deviations of the tracker's readings."""


class TrueParameterValue(Entry):
    """Entry of a truth file for a parameter of an instrument or effect, with its true value."""

    name: str
    """Name of the parameter."""
    value: Finite
    """True value of the parameter, in `unit`."""
    unit: Annotated[str, AfterValidator(_checked_unit)]
    """Unit of the value."""

    @property
    def si_value(self) -> float:
        """True value of the parameter in SI units."""
        return self.value * SI_PER_UNIT[self.unit]


class TrueInstrumentValue(TrueParameterValue):
    """Entry of a truth file for a parameter of an instrument, with its true value."""

    instrument: str = ""
    """Name of the instrument; empty for a single instrument without a name."""

    @classmethod
    def from_si(cls, parameter_name: str, si_value: float, unit: str) -> Self:
        """Entry of a parameter with the SI value `si_value`, converted to `unit`.

        `parameter_name` may be ``PARAMETER@INSTRUMENT``.
        """
        name, _, instrument = parameter_name.partition("@")
        whose = {"instrument": instrument} if instrument else {}
        return cls(name=name, value=si_value / SI_PER_UNIT[unit], unit=unit, **whose)

    @property
    def qualified_name(self) -> str:
        """Name of the parameter, with ``@`` and the name of the instrument if it has one."""
        return f"{self.name}@{self.instrument}" if self.instrument else self.name


class TrueEffect(Entry):
    """Entry of a truth file for a physical effect that the simulation applied."""

    name: str = Field(alias="effect")
    """Name of the effect, as listed by `ltsim effects`."""
    stations: tuple[str, ...] = ()
    """Names of the stations where the effect acts; empty for all."""
    targets: tuple[str, ...] = ()
    """Names of the targets where the effect acts; empty for all."""
    shape: dict[str, Finite | str | tuple[Finite, ...]] = Field(default_factory=dict)
    """Shape parameters of the effect (period, time constant, onset time) by name; in the units that `ltsim effects`
    lists, or in SI units for a parameter without a listed unit."""
    parameters: tuple[TrueParameterValue, ...] = ()
    """True values of the parameters of the effect."""

    @classmethod
    def from_applied_effect(cls, applied_effect: AppliedEffect) -> Self:
        """Entry of a truth file for an applied effect."""
        effect, values = applied_effect.effect, applied_effect.parameter_values.tolist()
        return cls(
            effect=effect.name,
            stations=effect.stations,
            targets=effect.targets,
            shape=displayed_shape_parameters(effect),
            parameters=tuple(
                TrueParameterValue(name=p.name, value=value / p.si_per_display_unit, unit=p.unit)
                for p, value in zip(effect.parameters, values, strict=True)
            ),
        )

    def to_applied_effect(self) -> AppliedEffect:
        """Effect object of this entry with its true parameters [SI]; raises LtsimError for an invalid entry."""
        effect = make_effect(self.name, {"stations": self.stations, "targets": self.targets}, self.shape)
        value_by_parameter = {p.name: p.value for p in self.parameters}
        return AppliedEffect(
            effect, np.array([value_by_parameter.get(p.name, 0.0) * p.si_per_display_unit for p in effect.parameters])
        )


class TruePoint(Entry):
    """Entry of a truth file for a point, with its true position."""

    name: str
    """Name of the point."""
    position_mm: Vector
    """Position in the hall frame."""


class TruePose(TruePoint):
    """Entry of a truth file for a station, with its true pose."""

    rotation_quaternion: Quaternion
    """Rotation from instrument to hall, as a unit quaternion x, y, z, w."""


class Truth(ResultFile):
    """True values from which a recording was simulated, with the content of `truth.json`."""

    FILE: ClassVar[str] = "truth.json"
    format: Literal["ltsim-truth/1"] = "ltsim-truth/1"
    """Format and version of this file."""
    title: str = ""
    """Title of the scenario, free text."""
    seed: int = 0
    """Seed of the random draws."""
    trial: int = 0
    """Number of the trial among the trials of its seed."""
    construction: str
    """Instrument model that generated the readings."""
    parameters: tuple[TrueInstrumentValue, ...] = ()
    """True errors of the instruments."""
    effects: tuple[TrueEffect, ...] = ()
    """Effects that the simulation applied, in addition to the errors of the instruments."""
    noise_factor: Finite = 1.0
    """Ratio of the true to the declared standard deviations of the readings, for a single tracker without a name."""
    instruments: tuple[TrackerTruth, ...] = ()
    """Trackers with names; empty for a single tracker without a name."""
    stations: tuple[TruePose, ...] = Field(min_length=1)
    """True poses of the stations."""
    targets: tuple[TruePoint, ...] = Field(min_length=1)
    """True positions of the targets."""
    nominal_points: tuple[TruePoint, ...] | None = None
    """Positions of the targets as measured by a coordinate measuring machine; null without such a machine."""
    _arrays: TruthArrays | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _check_effects_and_nominal_points(self) -> Self:
        if self.nominal_points is not None and [p.name for p in self.nominal_points] != [p.name for p in self.targets]:
            raise ValueError("the names of the nominal points differ from those of the targets, or have another order")
        try:
            for entry in self.effects:
                entry.to_applied_effect()
        except (LtsimError, TypeError, KeyError) as problem:
            raise ValueError(f"effects: {problem}") from None
        return self

    @classmethod
    def from_arrays(
        cls,
        truth_arrays: TruthArrays,
        stations: Sequence[str],
        targets: Sequence[str],
        parameter_units: Sequence[str],
        **other_fields: object,
    ) -> Self:
        """Truth from arrays of true values, names of stations and targets, and display units of instrument parameters.

        `other_fields` are values of the remaining fields, such as `seed`, by name.
        """
        nominal = (
            {}
            if truth_arrays.nominal_points is None
            else {"nominal_points": _point_entries(targets, truth_arrays.nominal_points)}
        )
        made = cls.model_validate(
            {
                **other_fields,
                "parameters": tuple(
                    TrueInstrumentValue.from_si(name, value, unit)
                    for (name, value), unit in zip(truth_arrays.instrument_values.items(), parameter_units, strict=True)
                ),
                "effects": tuple(map(TrueEffect.from_applied_effect, truth_arrays.effects)),
                "stations": tuple(
                    TruePose(
                        name=p.name,
                        position_mm=p.position_mm,
                        rotation_quaternion=quaternion_from_matrix(turn).tolist(),
                    )
                    for p, turn in zip(
                        _point_entries(stations, truth_arrays.station_positions),
                        truth_arrays.station_rotations,
                        strict=True,
                    )
                ),
                "targets": _point_entries(targets, truth_arrays.target_points),
                **nominal,
            }
        )
        made._arrays = truth_arrays
        return made

    @property
    def arrays(self) -> TruthArrays:
        """True values as arrays in SI units."""
        if self._arrays is None:
            self._arrays = TruthArrays(
                station_positions=_entry_positions(self.stations),
                station_rotations=Rotation.from_quat([s.rotation_quaternion for s in self.stations]).as_matrix(),
                target_points=_entry_positions(self.targets),
                instrument_values={p.qualified_name: p.si_value for p in self.parameters},
                effects=tuple(entry.to_applied_effect() for entry in self.effects),
                nominal_points=None if self.nominal_points is None else _entry_positions(self.nominal_points),
            )
        return self._arrays

    @property
    def station_positions(self) -> Floats:
        """True positions of the stations, shape (stations, 3) [m]."""
        return self.arrays.station_positions

    @property
    def station_rotations(self) -> Floats:
        """Rotation matrices from instrument to hall, shape (stations, 3, 3)."""
        return self.arrays.station_rotations

    @property
    def target_points(self) -> Floats:
        """True positions of the targets before effects displace them, shape (targets, 3) [m]."""
        return self.arrays.target_points

    @property
    def instrument_values(self) -> Mapping[str, float]:
        """True parameters of the instruments by name [SI]; ``beam-tilt@NAME`` if there are several instruments."""
        return self.arrays.instrument_values

    @property
    def parameter_units(self) -> dict[str, str]:
        """Display unit of each instrument parameter, by the name of the parameter."""
        return {p.qualified_name: p.unit for p in self.parameters}

    @property
    def applied_effects(self) -> tuple[AppliedEffect, ...]:
        """Effects that the simulation applied, in addition to the instrument's parameters."""
        return self.arrays.effects

    @property
    def station_names(self) -> tuple[str, ...]:
        """Names of the stations."""
        return tuple(station.name for station in self.stations)

    @property
    def target_names(self) -> tuple[str, ...]:
        """Names of the targets."""
        return tuple(target.name for target in self.targets)

    def _summary_lines(self) -> list[str]:
        title = f"{self.title}: " if self.title else ""
        effects = ", ".join(effect.name for effect in self.effects) or "no effects"
        return [f"Truth: {title}seed {self.seed}, {len(self.parameters)} instrument parameters, {effects}"]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {
            "instrument": lambda: TRUE_INSTRUMENT_ERRORS_TABLE.with_rows(
                [p.qualified_name, p.value, p.unit] for p in self.parameters
            ),
            "targets": lambda: TRUE_POINTS_TABLE.with_rows([p.name, *p.position_mm] for p in self.targets),
        }


def _point_entries(names: Sequence[str], positions: Floats) -> tuple[TruePoint, ...]:
    """Entries of a truth file for the points `names` with the coordinates `positions`, shape (points, 3) [m]."""
    places = (positions / MILLIMETRE).tolist()
    return tuple(TruePoint(name=name, position_mm=place) for name, place in zip(names, places, strict=True))


def _entry_positions(points: Sequence[TruePoint]) -> Floats:
    """Coordinates (points, 3) [m] of the points in entries of a truth file."""
    return np.array([p.position_mm for p in points]).reshape(-1, 3) * MILLIMETRE


def write_truth(truth: Truth, path: Path) -> None:
    """Atomic writing of a truth file: completely or not at all."""
    write_text(path, truth.text())


def read_truth(path: Path) -> Truth:
    """Truth read from a file; raises RecordError."""
    return read_result(path, Truth)


def nominal_points_csv(truth: Truth) -> str:
    """CSV text ``target,x_mm,y_mm,z_mm`` with the points from a coordinate measuring machine, for `ltsim verify`.

    ModelError is raised for a scenario without such a machine.
    """
    if truth.nominal_points is None:
        raise ModelError("the scenario has no nominal points; set measures_targets = true in its table [cmm]")
    return NOMINAL_TABLE.with_rows([p.name, *p.position_mm] for p in truth.nominal_points).csv_text()
