"""The tables of a scenario file (ltsim-scenario/1). Keys carry their units; whoever needs SI converts at the door."""

from __future__ import annotations

from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import Field, StrictBool, model_validator

from ltsim.effects.resolution import PAPER_ANGLE_ARCSEC, PAPER_DISTANCE_UM
from ltsim.effects.smr_incidence import PAPER_TABLE, TABLE_ANGLES
from ltsim.recording.setup import Finite, Noise, NonNegative, Positive, Prior, Section, Vector
from ltsim.recording.setup import Limits as ElevationLimits
from ltsim.units import MICROMETRE

Angle = Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
Celsius = Annotated[float, Field(ge=-60, le=80, allow_inf_nan=False)]

PAPER_PRIOR = Prior(range_scale_ppm=1.4, range_offset_mm=0.007, angle_arcsec=2.0, offset_mm=0.014)
"""Errors drawn from it give the paper's figures before calibration (Table 3): means of 46 and 29 um."""

PRESETS: MappingProxyType[str, dict[str, Any]] = MappingProxyType(
    {
        "paper": {},
        "modern": {
            "noise": {"distance_mm": 0.002, "distance_ppm": 0.15, "azimuth_arcsec": 0.2, "elevation_arcsec": 0.2},
            "prior": {"range_scale_ppm": 0.5, "range_offset_mm": 0.005, "angle_arcsec": 1.0, "offset_mm": 0.005},
        },
        "after-transport": {
            "prior": {"range_scale_ppm": 2.0, "range_offset_mm": 0.03, "angle_arcsec": 8.0, "offset_mm": 0.06},
        },
    }
)
"""Instruments by name, as changes to the defaults below.

`paper`: half of the specified 3.5 um/m across the beam, an ADM better than 15 um, the resolutions of section
2.1.1; `modern`: a current tracker, half of its maker's limits; `after-transport`: the paper's instrument with the
misalignments that a knock leaves.
"""


class Obstacle(Section):
    """Something that stands in the workshop: a CAD file, or a box that stands on its place."""

    name: str = ""
    file: str | None = None
    unit: Literal["mm", "m"] = "mm"
    box_mm: tuple[Positive, Positive, Positive] | None = None
    position_mm: Vector = (0.0, 0.0, 0.0)
    yaw_deg: Angle = 0.0

    @model_validator(mode="after")
    def _one_shape(self) -> Obstacle:
        if (self.file is None) == (self.box_mm is None):
            raise ValueError("it should have either file or box_mm")
        return self


class Workshop(Section):
    """The room and its air; the air is the same everywhere, its temperature may rise."""

    size_mm: tuple[Positive, Positive, Positive] = (6000.0, 6000.0, 6000.0)
    temperature_c: Celsius = 20.0
    temperature_rise_c_per_h: Finite = 0.0
    pressure_hpa: Annotated[float, Field(ge=300, le=1200)] = 1013.2
    humidity_pct: Fraction = 50.0
    shadow_cone_deg: Annotated[float, Field(gt=0, lt=180)] | None = None
    obstacles: tuple[Obstacle, ...] = ()


class Placing(Section):
    """How far things truly stand from the plan, one standard deviation, and how finely the plan is read."""

    station_mm: NonNegative = 15.0
    yaw_deg: NonNegative = 0.4
    tilt_deg: NonNegative = 0.05
    target_mm: NonNegative = 4.0
    gauge_mm: NonNegative = 10.0
    plan_step_mm: Positive = 100.0
    plan_step_deg: Positive = 1.0


class Resolution(Section):
    """Smallest steps of the readings; 0 for none."""

    distance_um: NonNegative = PAPER_DISTANCE_UM
    angle_arcsec: NonNegative = PAPER_ANGLE_ARCSEC


class Limits(ElevationLimits):
    """Travel of the elevation axis and the ranges that can be measured."""

    range_min_mm: NonNegative = 500.0
    range_max_mm: Positive = 20_000.0


class Instrument(Section):
    """The tracker: construction, what its maker states, and the errors it truly has.

    `errors` holds values in the parameters' display units; ``draw = true`` draws all others from the prior,
    `error_factor` times as large. The drawn noise is `noise_factor` times the stated one.
    """

    preset: Literal["paper", "modern", "after-transport"] = "paper"
    construction: Literal["misalignment", "dh"] = "misalignment"
    harmonics: Annotated[int, Field(ge=0, le=4)] = 2
    degree: Annotated[int, Field(ge=0, le=4)] = 2
    corrected: bool = False
    noise: Noise = Noise()
    noise_factor: NonNegative = 1.0
    resolution: Resolution = Resolution()
    prior: Prior = PAPER_PRIOR
    limits: Limits = Limits()
    errors: dict[str, StrictBool | Finite] = Field(default_factory=dict)
    error_factor: NonNegative = 1.0

    @model_validator(mode="after")
    def _draw_is_a_switch(self) -> Instrument:
        for name, value in self.errors.items():
            if isinstance(value, bool) != (name == "draw"):
                raise ValueError("it should hold numbers, and true or false for draw only")
        return self

    @property
    def draws(self) -> bool:
        """Errors that are not given are drawn."""
        return self.errors.get("draw") is True


class Smr(Section):
    """The reflectors: how their nests are used, and their error against incidence.

    `table_um` is the range error at -30, -22.5, ... +30 deg, used where `incidence_error` is set;
    `direction_deg` says where around the nest its positive side looks, 0 along the horizontal.
    """

    nests: Literal["re-aimed", "fixed"] = "re-aimed"
    acceptance_deg: Annotated[float, Field(gt=0, le=90)] = 30.0
    reflector: str | None = None
    incidence_error: bool = False
    table_um: Annotated[tuple[Finite, ...], Field(min_length=len(TABLE_ANGLES), max_length=len(TABLE_ANGLES))] = tuple(
        round(x / MICROMETRE, 6) for x in PAPER_TABLE
    )
    direction_deg: Angle = 0.0


class Cmm(Section):
    """The coordinate measuring machine: largest error constant_um + L / length_divisor_mm [um].

    One standard deviation is that divided by `coverage`. Where `nominal` is set, the targets were measured on it.
    """

    constant_um: NonNegative = 2.3
    length_divisor_mm: Positive = 300.0
    coverage: Positive = 2.0
    noise_factor: NonNegative = 1.0
    nominal: bool = False


class Work(Section):
    """The order and the clock of the measurements."""

    order: Literal["by-station-random", "level-by-level", "as-listed"] = "by-station-random"
    faces: Literal[1, 2] = 1
    face_order: Literal["per-target", "per-station"] = "per-target"
    repeats: Annotated[int, Field(ge=1, le=100)] = 1
    seconds_per_pointing: Positive = 15.0
    minutes_per_move: NonNegative = 20.0


class GaugeLength(Section):
    """A length of the gauge as it is, at the temperature of its calibration."""

    from_: str = Field(alias="from")
    to: str
    length_mm: Positive


class Gauge(Section):
    """A rigid frame with reflectors: lengths at `calibrated_at_c`, and where it stands.

    Without `distance` it is the paper's, Table 2 read by columns or by rows. The frame's own axes follow its
    two longest extents; it is turned by roll, pitch and yaw about x, y and z in this order.
    """

    targets: tuple[str, ...] = ("T25", "T26", "T27", "T28")
    reading: Literal["columns", "rows"] = "columns"
    distance: tuple[GaugeLength, ...] = ()
    position_mm: Vector
    yaw_deg: Angle = 0.0
    pitch_deg: Angle = 0.0
    roll_deg: Angle = 0.0
    nest_normal: Vector | None = None
    calibrated_at_c: Celsius = 20.0
    measured_at_c: Celsius | None = None
    expansion_per_k: Finite = 23.2e-6
    sigma_um: Positive | None = None


class Station(Section):
    """One set-up of the instrument: the middle of its head, and how it is turned."""

    position_mm: Vector
    yaw_deg: Angle
    roll_deg: Angle = 0.0
    pitch_deg: Angle = 0.0
    levelled: bool = False
    levelling_sigma_arcsec: Positive = 1.0


class Target(Section):
    """One reflector position. Without `nest_normal` a fixed nest is aimed at the middle of the stations."""

    position_mm: Vector
    nest_normal: Vector | None = None
    reaimed: bool | None = None
    reflector: str | None = None


class EffectEntry(Section):
    """Physics beyond the instrument's errors: an effect of the catalogue, its place, constants and values.

    `values` in display units, others 0; ``draw = true`` draws all others at their plausible size. `shape` holds the
    effect's constants, in display units where it declares one and in SI otherwise.
    """

    name: str
    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    draw: bool = False
    values: dict[str, Finite] = Field(default_factory=dict)
    shape: dict[str, Finite | str | tuple[Finite, ...]] = Field(default_factory=dict)
