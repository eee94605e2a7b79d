"""Tables of a scenario file (ltsim-scenario/1). Keys carry their units; callers convert to SI."""

from types import MappingProxyType
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, StrictBool, model_validator

from ltsim.core.errors import ModelError, SetupError
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.smr_incidence import PAPER_TABLE, TABLE_ANGLES
from ltsim.physics.effects.verbs import Sized, effect_from, shape_of
from ltsim.recordings.setup import (
    LEAST_SIGMA,
    Finite,
    LengthUse,
    Limits,
    Noise,
    NonNegative,
    Positive,
    Prior,
    TomlSection,
    Vector,
)
from ltsim.recordings.specification import sheet_names

Angle = Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False)]
LengthSigma = Annotated[float, Field(ge=1e3 * LEAST_SIGMA, le=1e9, allow_inf_nan=False)]
"""[um] Standard deviation of a length, no smaller than that of a set-up."""
Fraction = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
Celsius = Annotated[float, Field(ge=-60, le=80, allow_inf_nan=False)]

PAPER_PRIOR = Prior(range_scale_ppm=1.4, range_offset_mm=0.007, angle_arcsec=2.0, offset_mm=0.014)
"""Errors drawn from it give about the figures of the paper's Table 3 before calibration: means of 48 and 24 um in
experiment 01, of 46 and 29 in the paper."""

PRESETS: MappingProxyType[str, dict[str, Any]] = MappingProxyType(
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
"""Instruments by name, as changes to the defaults below.

`paper`: half of the specified 3.5 um/m across the beam, an ADM better than 15 um, the resolutions of section
2.1.1; `modern`: a current tracker, half of its maker's limits, with the ranges of the rated conditions of a FARO
Vantage E (0.1 to 35 m, as its calibration certificates state them); `after-transport`: the paper's instrument with the
misalignments that a knock leaves.
"""


def _existing_preset(name: str) -> str:
    if name not in PRESETS and name not in sheet_names():
        raise ValueError(f"it should be {', '.join(PRESETS)}, or a data sheet such as {sheet_names()[0]}")
    return name


class Obstacle(TomlSection):
    """Obstacle in the workshop: a CAD file, or a box or an upright cylinder at a place."""

    name: str = ""
    """Name in messages and pictures."""
    file: str | None = None
    """STL, OBJ, PLY, GLB, glTF, STEP or IGES file, named from the scenario's folder."""
    unit: Literal["mm", "m", "in"] | None = None
    """Unit of the file's coordinates; without it metres for glTF, their own for STEP and IGES, else millimetres."""
    up: Literal["y", "z"] | None = None
    """Axis of the file that points up; without it y for glTF, else z."""
    beyond_room: bool = False
    """Flag: it may reach beyond the room or below its floor; otherwise that is an error for a CAD file."""
    box_mm: tuple[Positive, Positive, Positive] | None = None
    """Width, depth and height of a box, in place of a file."""
    cylinder_mm: tuple[Positive, Positive] | None = None
    """Diameter and height of an upright cylinder, in place of a file."""
    position_mm: Vector = (0.0, 0.0, 0.0)
    """Position of the file's origin; of a box or a cylinder, that of the middle of its base."""
    yaw_deg: Angle = 0.0
    """Turn about the vertical."""

    @model_validator(mode="after")
    def _single_shape(self) -> Self:
        if sum(shape is not None for shape in (self.file, self.box_mm, self.cylinder_mm)) != 1:
            raise ValueError("it should have one of file, box_mm and cylinder_mm")
        return self


class Workshop(TomlSection):
    """The room and its air; the air is the same everywhere, its temperature may rise."""

    size_mm: tuple[Positive, Positive, Positive] = (6000.0, 6000.0, 6000.0)
    """Width, depth and height; the corner is the origin, z is up."""
    temperature_c: Celsius = 20.0
    """Temperature of the air at the start."""
    temperature_rise_c_per_h: Finite = 0.0
    """Rate at which the temperature of the air rises."""
    pressure_hpa: Annotated[float, Field(ge=300, le=1200)] = 1013.2
    """Pressure of the air."""
    humidity_pct: Fraction = 50.0
    """Relative humidity of the air."""
    shadow_cone_deg: Annotated[float, Field(gt=0, lt=180)] | None = None
    """Opening of the cone under each station where nothing may stand; without it, the cone that the elevation limit
    hides."""
    obstacles: tuple[Obstacle, ...] = ()
    """Obstacles in the workshop, tables `[[workshop.obstacles]]`."""


class Placing(TomlSection):
    """Standard deviations of the true places about the plan, and steps to which the recording rounds the plan."""

    station_mm: NonNegative = 15.0
    """Standard deviation of each coordinate of a station."""
    yaw_deg: NonNegative = 0.4
    """Standard deviation of a station's rotation about the vertical, and of the gauge's rotation."""
    tilt_deg: NonNegative = 0.05
    """Standard deviation of a station's tilt about each horizontal axis."""
    target_mm: NonNegative = 4.0
    """Standard deviation of each coordinate of a reflector."""
    gauge_mm: NonNegative = 10.0
    """Standard deviation of each coordinate of the gauge, which moves as a rigid body."""
    plan_step_mm: Positive = 100.0
    """Step to which the recording's floor plan rounds positions."""
    plan_step_deg: Positive = 1.0
    """Step to which the recording's floor plan rounds yaws."""


class Resolution(TomlSection):
    """Smallest steps of the readings; 0 for none, by default the paper's (section 2.1.1)."""

    distance_um: NonNegative = 0.1
    """Smallest step of a range."""
    angle_arcsec: NonNegative = 0.018
    """Smallest step of both angles."""


class PointingLimits(Limits):
    """Travel of the elevation axis and the ranges that can be measured."""

    range_min_mm: NonNegative = 500.0
    """Shortest range that can be measured."""
    range_max_mm: Positive = 20_000.0
    """Longest range that can be measured."""

    @model_validator(mode="after")
    def _outward(self) -> Self:
        if self.range_min_mm >= self.range_max_mm:
            raise ValueError("it should have range_min_mm below range_max_mm")
        return self


class ScenarioInstrument(TomlSection):
    """The tracker: construction, its maker's specifications, and its true errors."""

    preset: Annotated[str, AfterValidator(_existing_preset)] = "paper"
    """Source of all values that are not given: `paper`, `modern`, `after-transport`, or a built-in data sheet."""
    construction: Literal["misalignment", "dh", "steering-mirror"] = "misalignment"
    """Kinematic chain that makes the readings: geometric misalignments, or the paper's Denavit-Hartenberg chain."""
    harmonics: Annotated[int, Field(ge=0, le=4)] = 2
    """Harmonics of each joint error of the `dh` chain."""
    degree: Annotated[int, Field(ge=0, le=4)] = 2
    """Degree of its polynomials in the range."""
    corrected: bool = False
    """Flag of the recording: the instrument's own corrections are in the readings."""
    noise: Noise = Noise()
    """Standard deviations of the readings that the maker specifies and the recording repeats."""
    noise_factor: NonNegative = 1.0
    """Ratio of the true noise to the specified one."""
    resolution: Resolution = Resolution()
    """Smallest steps of the readings."""
    prior: Prior = PAPER_PRIOR
    """Prior standard deviations of the instrument's errors, guaranteed by the maker; errors are drawn from them."""
    limits: PointingLimits = PointingLimits()
    """Limits of elevation and range within which the tracker can point."""
    observables: Annotated[tuple[Literal["distance", "azimuth", "elevation"], ...], Field(min_length=1)] = (
        "distance",
        "azimuth",
        "elevation",
    )
    """Observables recorded for each pointing: `["distance"]` alone is multilateration."""
    errors: dict[str, StrictBool | Finite] = Field(default_factory=dict)
    """True errors by parameter name, in display units (`ltsim effects`); `draw = true` draws the others."""
    error_factor: NonNegative = 1.0
    """Ratio of the drawn errors' standard deviations to the prior's."""
    prior_factor: Positive = 1.0
    """Ratio of the prior that the recording declares to the prior: not 1 for a maker's figures that are wrong."""

    @model_validator(mode="after")
    def _draw_is_a_switch(self) -> Self:
        for name, value in self.errors.items():
            if isinstance(value, bool) != (name == "draw"):
                raise ValueError("it should hold numbers, and true or false for draw only")
        return self

    @property
    def draws(self) -> bool:
        """Errors that are not given are drawn."""
        return self.errors.get("draw") is True


class Smr(TomlSection):
    """The reflectors: how their nests are used, and their error against incidence."""

    nests: Literal["re-aimed", "fixed"] = "re-aimed"
    """Orientation of the nests: turned toward each station before it points, or fixed."""
    acceptance_deg: Annotated[float, Field(gt=0, le=90)] = 30.0
    """Largest angle of incidence that returns the beam."""
    reflector: str | None = None
    """Name of the SMR, where station and target name no other."""
    incidence_error: bool = False
    """Flag: the reflectors have the incidence error of `table_um`."""
    table_um: Annotated[tuple[Finite, ...], Field(min_length=len(TABLE_ANGLES), max_length=len(TABLE_ANGLES))] = tuple(
        round(x / MICROMETRE, 6) for x in PAPER_TABLE
    )
    """Range error at -30, -22.5, ... +30 deg of incidence."""
    direction_deg: Angle = 0.0
    """Direction of the table's positive side about the nest's normal, 0 along the horizontal."""


class Cmm(TomlSection):
    """The coordinate measuring machine: largest error constant_um + L / length_divisor_mm [um]."""

    constant_um: NonNegative = 2.3
    """Constant part of the largest permitted error."""
    length_divisor_mm: Positive = 300.0
    """The length L adds L / length_divisor_mm micrometres."""
    coverage: Positive = 2.0
    """Largest permitted error over standard deviation."""
    noise_factor: NonNegative = 1.0
    """Ratio of the true error to the specified one."""
    nominal: bool = False
    """Flag: it measured the targets too, and `ltsim simulate --nominal FILE` writes them for `ltsim verify`."""


class Work(TomlSection):
    """Numbers of stations and reflectors that are used of those below, order and clock of the measurements."""

    stations: Annotated[int, Field(ge=1)] | None = None
    """Number of stations that are set up, the first of the file; all where it is not given."""
    targets: Annotated[int, Field(ge=0)] | None = None
    """Number of reflectors that are measured in addition to the gauge's, spread as widely as they can be; those of a
    smaller number are among those of every larger one; all where it is not given."""

    order: Literal["by-station-random", "level-by-level", "as-listed"] = "by-station-random"
    """Order in which each station points at the reflectors; levels go from the highest to the lowest."""
    faces: Literal[1, 2] = 1
    """Number of faces in which each target is measured."""
    face_order: Literal["per-target", "per-station"] = "per-target"
    """Order of the faces: both target by target, or all targets in one face and then in the other."""
    repeats: Annotated[int, Field(ge=1, le=100)] = 1
    """Number of rounds."""
    seconds_per_pointing: Positive = 15.0
    """Time from one pointing to the next."""
    minutes_per_move: NonNegative = 20.0
    """Time to carry the instrument to the next station."""


class GaugeLength(TomlSection):
    """A length of the gauge as it is, at the temperature of its calibration."""

    from_: str = Field(alias="from")
    """Target at one end."""
    to: str
    """Target at the other end."""
    length_mm: Positive
    """Length between the two targets."""


class ScenarioGauge(TomlSection):
    """A rigid frame with reflectors: lengths at `calibrated_at_c`, and where it stands.

    Without `distance` it is the paper's, Table 2 read by columns or by rows. The frame's own axes follow its
    two longest extents; it is turned by roll, pitch and yaw about x, y and z in this order.
    """

    targets: tuple[str, ...] = ("T25", "T26", "T27", "T28")
    """Names of its reflectors."""
    reading: Literal["columns", "rows"] = "columns"
    """Reading direction of the paper's Table 2, which lost its alignment in print."""
    distance: tuple[GaugeLength, ...] = ()
    """Lengths of another gauge, tables `[[gauge.distance]]`: all that fix its shape."""
    position_mm: Vector
    """Position of its middle."""
    yaw_deg: Angle = 0.0
    """Turn about z."""
    pitch_deg: Angle = 0.0
    """Turn about y."""
    roll_deg: Angle = 0.0
    """Turn about x."""
    nest_normal: Vector | None = None
    """Direction in which its fixed nests face."""
    calibrated_at_c: Celsius = 20.0
    """Temperature of its calibration."""
    measured_at_c: Celsius | None = None
    """Temperature that the recording declares; the air's where it is not given."""
    expansion_per_k: Finite = 23.2e-6
    """Coefficient of thermal expansion that the recording declares."""
    sigma_expansion_per_k: NonNegative | None = None
    """Standard deviation of the coefficient: the true one is drawn."""
    sigma_temperature_k: NonNegative | None = None
    """Standard deviation of the declared temperature: the true one is drawn."""
    sigma_um: LengthSigma | None = None
    """Standard deviation of each length; by the measuring machine's where it is not given."""


class Length(LengthUse):
    """A known length between two reflectors of the mesh: a scale bar, or one that an interferometer measured."""

    from_: str = Field(alias="from")
    """Reflector at one end."""
    to: str
    """Reflector at the other end."""
    sigma_um: LengthSigma
    """Standard deviation of the declared length."""


class PlannedStation(TomlSection):
    """Planned set-up of an instrument: centre and orientation of its head."""

    position_mm: Vector
    """Planned place of the head."""
    yaw_deg: Angle
    """Planned direction of azimuth zero, counter-clockwise from the x axis."""
    roll_deg: Angle = 0.0
    """Planned turn about x."""
    pitch_deg: Angle = 0.0
    """Planned turn about y."""
    levelled: bool = False
    """Flag: a level aligns the standing axis with the vertical."""
    levelling_sigma_arcsec: Positive = 1.0
    """Standard deviation of the level."""
    instrument: str | None = None
    """Name of the tracker that stands here, a table `[instruments.NAME]`; that of `[instrument]` where it is not
    given."""
    reflector: str | None = None
    """Name of the SMR that is carried to all targets from here; where it is not given, each target's own."""


class PlannedTarget(TomlSection):
    """Reflector position. Without `nest_normal` a fixed nest points to the centre of the stations."""

    position_mm: Vector
    """Planned place."""
    nest_normal: Vector | None = None
    """Direction in which its fixed nest faces."""
    reaimed: bool | None = None
    """Flag: turned toward each station; as declared by `smr.nests` where it is not given."""
    reflector: str | None = None
    """Name of the SMR."""


class PlacedEffect(TomlSection):
    """An effect of the catalogue: its place and constants."""

    name: str
    """Name of the effect, as listed by `ltsim effects`."""
    stations: tuple[str, ...] = ()
    """Stations where it acts; empty for all."""
    targets: tuple[str, ...] = ()
    """Targets where it acts; empty for all."""
    shape: dict[str, Finite | str | tuple[Finite, ...]] = Field(default_factory=dict)
    """Constants by name, in display units where the effect declares one and in SI otherwise."""

    def effect(self, where: str) -> Effect:
        """The effect itself; raises SetupError, naming `where` it is asked for and what would be right."""
        try:
            return effect_from(self.name, {"stations": self.stations, "targets": self.targets}, self.shape)
        except (ModelError, ValueError, TypeError, KeyError) as problem:
            raise SetupError(f"{where}: {problem}") from None


class EffectEntry(PlacedEffect):
    """Physics beyond the instrument's errors: an effect of the catalogue, its place, constants and values."""

    draw: bool = False
    """Draw what `values` does not give, at its plausible size; 0 otherwise."""
    values: dict[str, Finite] = Field(default_factory=dict)
    """Parameters by name, in display units."""

    @classmethod
    def of(cls, given: Effect | Sized) -> Self:
        """An effect with its places and constants, and the sizes of its parameters; drawn where none is given."""
        effect, sizes = (given.effect, dict(given.sizes)) if isinstance(given, Sized) else (given, {})
        places = {"stations": effect.stations, "targets": effect.targets}
        return cls(name=effect.name, **places, draw=not sizes, values=sizes, shape=shape_of(effect))
