"""TOML tables of a scenario file (ltsim-scenario/1), with units in the names of their keys (`position_mm`)."""

from types import MappingProxyType
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, StrictBool, model_validator

from ltsim.core.errors import InputError, ModelError
from ltsim.core.units import MICROMETRE, MILLIMETRE
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.smr_incidence import INCIDENCE_TABLE_ANGLES, PAPER_INCIDENCE_RANGE_ERRORS
from ltsim.physics.effects.verbs import SizedEffect, displayed_shape_parameters, make_effect
from ltsim.recordings.keys import DistinctValues
from ltsim.recordings.setup import (
    MIN_SIGMA,
    ElevationLimits,
    Finite,
    LengthMaterialAndTemperature,
    Noise,
    NonNegative,
    Positive,
    Prior,
    TomlSection,
    Vector,
)
from ltsim.recordings.specification import data_sheet_names
from ltsim.scene.visibility import SightLimits

AngleDegrees = Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False)]
"""Rotation or direction [deg]."""
LengthSigma = Annotated[float, Field(ge=1e3 * MIN_SIGMA, le=1e9, allow_inf_nan=False)]
"""Standard deviation [um] of a reference length, at least the smallest value that a set-up file may contain."""
Percentage = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
"""Percentage, 0 to 100."""
Celsius = Annotated[float, Field(ge=-60, le=80, allow_inf_nan=False)]
"""Temperature [deg C] of a hall or of a reference length."""

PAPER_PRIOR = Prior(range_scale_ppm=1.4, range_offset_mm=0.007, angle_arcsec=2.0, offset_mm=0.014)
"""Prior standard deviations of the instrument errors of the tracker in Sensors 2021, 21, 7479. With these values the
simulated disagreement of the stations before calibration resembles Table 3 of the paper."""

TRACKER_PRESETS: MappingProxyType[str, dict[str, Any]] = MappingProxyType(
    {
        "paper": {},
        "modern": {
            "noise": {"distance_mm": 0.002, "distance_ppm": 0.15, "azimuth_arcsec": 0.2, "elevation_arcsec": 0.2},
            "prior": {"range_scale_ppm": 0.5, "range_offset_mm": 0.005, "angle_arcsec": 1.0, "offset_mm": 0.005},
            "limits": {"range_min_mm": 100.0, "range_max_mm": 35_000.0},
        },
        "after-transport": {
            "prior": {"range_scale_ppm": 2.0, "range_offset_mm": 0.03, "angle_arcsec": 8.0, "offset_mm": 0.06},
        },
    }
)
"""Values of the table `[instrument]` that differ from its defaults, by name of the preset. `paper`: the tracker of
Sensors 2021, 21, 7479; its angle noise is half of the specified 3.5 um/m across the beam, its ADM better than 15 um.
`modern`: a current tracker with half of its maker's limits and the measuring range of a FARO Vantage E (0.1 to 35 m,
rated conditions of its calibration certificates). `after-transport`: `paper` after a mechanical shock."""


def _existing_preset(preset_name: str) -> str:
    if preset_name not in TRACKER_PRESETS and preset_name not in data_sheet_names():
        raise ValueError(f"it should be {', '.join(TRACKER_PRESETS)}, or a data sheet such as {data_sheet_names()[0]}")
    return preset_name


class Obstacle(TomlSection):
    """Obstacle in the workshop: a CAD file, a box, or an upright cylinder, at a position in the hall."""

    name: str = ""
    """Name of the obstacle in messages and pictures."""
    file: str | None = None
    """Path of an STL, OBJ, PLY, GLB, glTF, STEP or IGES file, relative to the scenario's folder."""
    unit: Literal["mm", "m", "in"] | None = None
    """Unit of the CAD file's coordinates; default metres for glTF, the declared unit for STEP and IGES, else
    millimetres."""
    up: Literal["y", "z"] | None = None
    """Axis of the CAD file that points up; default y for glTF, else z."""
    beyond_room: bool = False
    """True if the obstacle may extend beyond the hall or below its floor; if false, an obstacle outside is an error."""
    box_mm: tuple[Positive, Positive, Positive] | None = None
    """Width, depth and height of a box, in place of a CAD file."""
    cylinder_mm: tuple[Positive, Positive] | None = None
    """Diameter and height of an upright cylinder, in place of a CAD file."""
    position_mm: Vector = (0.0, 0.0, 0.0)
    """Position of the CAD file's origin; for a box or cylinder, position of the centre of its base."""
    yaw_deg: AngleDegrees = 0.0
    """Rotation of the obstacle's axes against those of the hall about the vertical, counter-clockwise from above."""

    @model_validator(mode="after")
    def _check_single_shape(self) -> Self:
        if sum(shape is not None for shape in (self.file, self.box_mm, self.cylinder_mm)) != 1:
            raise ValueError("an obstacle should have exactly one of file, box_mm and cylinder_mm")
        return self


class Workshop(TomlSection):
    """Hall, its obstacles and its air. The air is homogeneous; its temperature may rise with time."""

    size_mm: tuple[Positive, Positive, Positive] = (6000.0, 6000.0, 6000.0)
    """Width, depth and height of the hall; a corner is the origin, z is up."""
    temperature_c: Celsius = 20.0
    """Temperature of the air at the start of the recording."""
    temperature_rise_c_per_h: Finite = 0.0
    """Rate [deg C per hour] at which the temperature of the air rises."""
    pressure_hpa: Annotated[float, Field(ge=300, le=1200)] = 1013.2
    """Pressure of the air."""
    humidity_pct: Percentage = 50.0
    """Relative humidity of the air."""
    shadow_cone_deg: Annotated[float, Field(gt=0, lt=180)] | None = None
    """Full angle of the vertical cone under each station in which the tracker sees no target; default the cone below
    its lower elevation limit.
    """
    obstacles: tuple[Obstacle, ...] = ()
    """Obstacles in the workshop, tables `[[workshop.obstacles]]`."""


class PlacingSigmas(TomlSection):
    """Standard deviations of true minus planned positions, and steps to which the recording's plan is rounded."""

    station_mm: NonNegative = 15.0
    """Standard deviation of each coordinate of a station."""
    yaw_deg: NonNegative = 0.4
    """Standard deviation of the rotation about the vertical, of each station and of the gauge."""
    tilt_deg: NonNegative = 0.05
    """Standard deviation of a station's tilt about each horizontal axis."""
    target_mm: NonNegative = 4.0
    """Standard deviation of each coordinate of a reflector."""
    gauge_mm: NonNegative = 10.0
    """Standard deviation of each coordinate of the gauge, which moves as a rigid body."""
    plan_step_mm: Positive = 100.0
    """Step [mm] to which the recording's floor plan rounds the coordinates of stations and reflectors."""
    plan_step_deg: Positive = 1.0
    """Step [deg] to which the recording's floor plan rounds the rotations of stations about the vertical."""


class Resolution(TomlSection):
    """Resolution of the readings; 0 means no rounding. Default: Sensors 2021, 21, 7479, section 2.1.1."""

    distance_um: NonNegative = 0.1
    """Step to which a range is rounded."""
    angle_arcsec: NonNegative = 0.018
    """Step to which azimuth and elevation are rounded."""


class PointingLimits(ElevationLimits):
    """Limits of elevation and range within which a tracker can point."""

    range_min_mm: NonNegative = SightLimits.range_min / MILLIMETRE
    """Shortest range that can be measured."""
    range_max_mm: Positive = SightLimits.range_max / MILLIMETRE
    """Longest range that can be measured."""

    @model_validator(mode="after")
    def _check_limit_order(self) -> Self:
        if self.range_min_mm >= self.range_max_mm:
            raise ValueError("range_min_mm should be below range_max_mm")
        return self


class ScenarioInstrument(TomlSection):
    """Tracker in a scenario: design, specification and true errors."""

    preset: Annotated[str, AfterValidator(_existing_preset)] = "paper"
    """Source of the default values of this table: `paper`, `modern`, `after-transport`, or the name of a built-in data
    sheet.
    """
    construction: Literal["misalignment", "dh", "steering-mirror"] = "misalignment"
    """Instrument model that generates the readings: misalignments, Denavit-Hartenberg chain, or steering mirror."""
    harmonics: Annotated[int, Field(ge=0, le=4)] = 2
    """Number of harmonics in the error of each rotary axis of the `dh` chain."""
    degree: Annotated[int, Field(ge=0, le=4)] = 2
    """Degree of the polynomials in the range that describe the errors of the range axis of the `dh` chain."""
    corrected: bool = False
    """True if the recording declares that the instrument corrects its readings for its errors."""
    noise: Noise = Noise()
    """Specified standard deviations of the readings, which the recording declares."""
    noise_factor: NonNegative = 1.0
    """Ratio of the true to the specified standard deviations of the readings."""
    resolution: Resolution = Resolution()
    """Steps to which the readings are rounded."""
    prior: Prior = PAPER_PRIOR
    """Specified (prior) standard deviations of the instrument's errors; times `error_factor` for drawn true errors."""
    limits: PointingLimits = PointingLimits()
    """Limits of elevation and range within which the tracker can point."""
    observables: Annotated[tuple[Literal["distance", "azimuth", "elevation"], ...], Field(min_length=1)] = (
        "distance",
        "azimuth",
        "elevation",
    )
    """Observables of each pointing; `["distance"]` alone is multilateration."""
    errors: dict[str, StrictBool | Finite] = Field(default_factory=dict)
    """True errors by parameter name, in the units that `ltsim effects` lists; `draw = true` draws all other errors."""
    error_factor: NonNegative = 1.0
    """Ratio of the standard deviations with which the true errors are drawn to those in `prior`."""
    prior_factor: Positive = 1.0
    """Ratio of the standard deviations that the recording declares to those in `prior`; not 1 for a wrong prior."""

    @model_validator(mode="after")
    def _check_error_value_types(self) -> Self:
        for name, value in self.errors.items():
            if isinstance(value, bool) != (name == "draw"):
                raise ValueError("errors should be numbers; only the entry draw is true or false")
        return self

    @property
    def draws_errors(self) -> bool:
        """True if the instrument errors without a declared value are drawn."""
        return self.errors.get("draw") is True


class Smr(TomlSection):
    """Reflectors: orientation of their nests, and their range error as a function of the incidence angle."""

    nest_orientation: Literal["re-aimed", "fixed"] = "re-aimed"
    """Orientation of the nests: turned towards each station in turn (`re-aimed`), or equal for all stations
    (`fixed`)."""
    acceptance_deg: Annotated[float, Field(gt=0, le=90)] = 30.0
    """Largest incidence angle at which the reflector returns the beam."""
    reflector: str | None = None
    """Name of the SMR for all pointings for which neither the station nor the target names one."""
    incidence_error: bool = False
    """True if the range error of the reflectors depends on the incidence angle, as in `range_error_table_um`."""
    range_error_table_um: Annotated[
        tuple[Finite, ...], Field(min_length=len(INCIDENCE_TABLE_ANGLES), max_length=len(INCIDENCE_TABLE_ANGLES))
    ] = tuple(round(x / MICROMETRE, 6) for x in PAPER_INCIDENCE_RANGE_ERRORS)
    """Range errors (reading minus true range) at the incidence angles -30, -22.5, ... +30 deg (nine values)."""
    direction_deg: AngleDegrees = 0.0
    """Direction, around the nest's normal, of positive incidence angles in the table: 0 horizontal, 90 upward."""


class CoordinateMeasuringMachine(TomlSection):
    """Coordinate measuring machine; its maximum permissible error is constant_um + L / length_divisor_mm [um]."""

    constant_um: NonNegative = 2.3
    """Constant part of the maximum permissible error."""
    length_divisor_mm: Positive = 300.0
    """Divisor of the measured length L in the maximum permissible error."""
    coverage_factor: Positive = 2.0
    """Ratio of the maximum permissible error to the standard deviation of a measured length."""
    noise_factor: NonNegative = 1.0
    """Ratio of the true to the specified standard deviation of a measured length."""
    measures_targets: bool = False
    """True if the machine also measured the targets; `ltsim simulate --nominal FILE` writes these coordinates."""


class MeasurementProcedure(TomlSection):
    """Numbers of stations and reflectors in use, and order and timing of the measurements."""

    stations: Annotated[int, Field(ge=1)] | None = None
    """Number of stations in use, in the order of the file; default all."""
    targets: Annotated[int, Field(ge=0)] | None = None
    """Number of measured reflectors, without those of the gauge, which are always measured; default all. The selected
    reflectors are as widely distributed as possible, and include every smaller selection."""

    order: Literal["by-station-random", "level-by-level", "as-listed"] = "by-station-random"
    """Order of the reflectors at each station: random, by height from the highest level down, or as in the file."""
    faces: Literal[1, 2] = 1
    """Number of faces in which each target is measured."""
    face_order: Literal["per-target", "per-station"] = "per-target"
    """Order of the faces: both faces target by target, or all targets in one face and then in the other."""
    repeats: Annotated[int, Field(ge=1, le=100)] = 1
    """Number of rounds at each station; each round points once at every target in each face."""
    seconds_per_pointing: Positive = 15.0
    """Time from the start of a pointing to the start of the next."""
    minutes_per_move: NonNegative = 20.0
    """Time to move the instrument to the next station."""


class GaugeLength(TomlSection):
    """True length between two targets of the gauge, at the temperature `calibrated_at_c` of the gauge."""

    from_: str = Field(alias="from")
    """Target at the first end."""
    to: str
    """Target at the second end."""
    length_mm: Positive
    """Length between the two targets."""


class ScenarioGauge(TomlSection):
    """Gauge, a rigid frame of reflectors at known distances: its lengths and its pose in the hall.

    By default the gauge is that of Sensors 2021, 21, 7479 (Table 2). The x and y axes of the frame are along the two
    longest extents of the gauge. The frame is rotated by roll, pitch and yaw in this order.
    """

    targets: tuple[str, ...] = ("T25", "T26", "T27", "T28")
    """Names of the reflectors of the gauge (rigid frame of reflectors at known distances)."""
    table_reading_order: Literal["columns", "rows"] = "columns"
    """Order in which Table 2 of Sensors 2021, 21, 7479 is read; the printed table is misaligned and permits both."""
    distance: tuple[GaugeLength, ...] = ()
    """Lengths that determine the gauge's shape, tables `[[gauge.distance]]`; default the lengths of Sensors 2021, 21,
    7479."""
    position_mm: Vector
    """Planned position of the centre of the gauge in the hall."""
    yaw_deg: AngleDegrees = 0.0
    """Right-handed rotation of the gauge about the z axis of the hall, after `roll_deg` and `pitch_deg`."""
    pitch_deg: AngleDegrees = 0.0
    """Right-handed rotation of the gauge about the y axis of the hall, after `roll_deg` and before `yaw_deg`."""
    roll_deg: AngleDegrees = 0.0
    """Right-handed rotation of the gauge about the x axis of the hall, before `pitch_deg` and `yaw_deg`."""
    nest_normal: Vector | None = None
    """Normal of the fixed nests of the gauge, pointing outwards, in the axes of the hall."""
    calibrated_at_c: Celsius = 20.0
    """Temperature at which the gauge was calibrated."""
    measured_at_c: Celsius | None = None
    """Temperature of the gauge during the measurements, as the recording declares it; default the temperature of the
    air."""
    expansion_per_k: Finite = 23.2e-6
    """Coefficient of thermal expansion of the gauge, as the recording declares it."""
    sigma_expansion_per_k: NonNegative | None = None
    """Standard deviation of the true minus the declared expansion coefficient."""
    sigma_temperature_k: NonNegative | None = None
    """Standard deviation of the true minus the declared temperature of the gauge."""
    sigma_um: LengthSigma | None = None
    """Standard deviation of each certified length; default from the maximum permissible error in the table `[cmm]`."""


class ReferenceLengthEntry(LengthMaterialAndTemperature):
    """Reference length between reflectors that are not on the gauge: a scale bar, or an interferometer length."""

    from_: str = Field(alias="from")
    """Reflector at the first end."""
    to: str
    """Reflector at the second end."""
    sigma_um: LengthSigma
    """Standard deviation of the declared length."""


class PlannedStation(TomlSection):
    """Planned set-up of an instrument: position and orientation of its head."""

    position_mm: Vector
    """Planned position of the head."""
    yaw_deg: AngleDegrees
    """Planned direction of azimuth zero, counter-clockwise (seen from above) from the x axis of the hall."""
    roll_deg: AngleDegrees = 0.0
    """Planned right-handed rotation about the x axis of the hall, before `pitch_deg` and `yaw_deg`."""
    pitch_deg: AngleDegrees = 0.0
    """Planned right-handed rotation about the y axis of the hall, after `roll_deg` and before `yaw_deg`."""
    levelled: bool = False
    """True if the tracker's standing axis is levelled to the vertical."""
    levelling_sigma_arcsec: Positive = 1.0
    """Standard deviation, after levelling, of the tilt of the standing axis about each horizontal axis."""
    instrument: str | None = None
    """Name of the tracker at this station, a table `[instruments.NAME]`; default `[instrument]`."""
    reflector: str | None = None
    """Name of the SMR with which all targets are measured from this station; default the SMR of each target."""


class PlannedTarget(TomlSection):
    """Planned position of a reflector, and its nest."""

    position_mm: Vector
    """Planned position of the reflector's centre."""
    nest_normal: Vector | None = None
    """Outward normal of the target's fixed nest in the axes of the hall; default towards the centre of the stations."""
    reaimed: bool | None = None
    """True if the reflector is turned towards each station before its pointing; default by `smr.nest_orientation`."""
    reflector: str | None = None
    """Name of the SMR at this target, a table `[reflectors.NAME]`; default `smr.reflector`."""


class PlacedEffect(TomlSection):
    """Physical effect with the stations and targets where it acts, and with its shape parameters."""

    name: str
    """Name of the effect, as listed by `ltsim effects`."""
    stations: DistinctValues[str] = ()
    """Names of the stations where the effect acts; empty for all."""
    targets: DistinctValues[str] = ()
    """Names of the targets where the effect acts; empty for all."""
    shape: dict[str, Finite | str | tuple[Finite, ...]] = Field(default_factory=dict)
    """Shape parameters of the effect (period, time constant, onset time) by name; in the units that `ltsim effects`
    lists, or in SI units for a parameter without a listed unit."""

    def effect(self, error_location: str) -> Effect:
        """Effect object of this entry; InputError beginning with `error_location` for an invalid value."""
        try:
            return make_effect(self.name, {"stations": self.stations, "targets": self.targets}, self.shape)
        except (ModelError, ValueError, TypeError, KeyError) as problem:
            raise InputError(f"{error_location}: {problem}") from None


class EffectEntry(PlacedEffect):
    """Effect in a scenario, in addition to the instrument's errors: name, stations, targets and parameter values."""

    draw: bool = False
    """True if the parameters without a given value are drawn from their prior distributions; if false they are 0."""
    values: dict[str, Finite] = Field(default_factory=dict)
    """Values of the effect's parameters by name, in the units that `ltsim effects` lists."""

    @classmethod
    def from_effect(cls, source: Effect | SizedEffect) -> Self:
        """Entry of an effect object; its parameters are drawn if the object has no parameter values."""
        sized = source if isinstance(source, SizedEffect) else SizedEffect(source, {})
        effect, sizes = sized.effect, dict(sized.parameter_values_in_display_units)
        places = {"stations": effect.stations, "targets": effect.targets}
        return cls(name=effect.name, **places, draw=not sizes, values=sizes, shape=displayed_shape_parameters(effect))
