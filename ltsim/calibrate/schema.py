"""calibration.json, history.json and the tables beside them: what stands in them, for writers and readers."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from ltsim.evaluate.schema import CriterionEntry
from ltsim.recording.result_file import Entry, Finite, Known, ResultFile, Vector
from ltsim.recording.result_table import ResultTable, numbers, texts

NotNegative = Annotated[Finite, Field(ge=0)]
Positive = Annotated[Finite, Field(gt=0)]

COORDINATES = (
    *texts(target="name"),
    *numbers(".6f", x_mm="coordinate", y_mm="coordinate", z_mm="coordinate"),
    *numbers(".6f", sigma_x_mm="its standard deviation", sigma_y_mm="as sigma_x_mm", sigma_z_mm="as sigma_x_mm"),
)
TARGETS = ResultTable(
    "targets.csv", "adjusted targets; those that the readings do not determine have no row", COORDINATES
)
RESIDUALS = ResultTable(
    "residuals.csv",
    "one row an observation that was used",
    (
        *numbers(row="of the recording's table, from 1"),
        *texts(station="name", target="name"),
        *numbers(face="1 or 2", repeat="round, from 1"),
        *texts(observable="distance, azimuth or elevation"),
        *numbers(".6g", residual="observed minus adjusted, in `unit`"),
        *texts(unit="of the residual"),
        *numbers(".4f", redundancy="share of the observation that others check, 0 to 1", w="normalised residual"),
    ),
)


class FitEntry(Entry):
    """Agreement of readings and model; the test is null without redundancy."""

    chi2: Finite = 0.0
    dof: int = 0
    sigma0: Known = None
    p_value: Known = None
    iterations: int = 0
    status: str = "not stated"
    sentence: str = ""


class ParameterEntry(Entry):
    """One estimate in the unit a person reads."""

    name: str
    value: Finite
    sigma: NotNegative | None = None
    unit: str
    prior_sigma: Positive | None = None
    instrument: str = Field("", description="Where there are several.")


class HarmonicEntry(Entry):
    """A cosine and a sine together, as amplitude and phase; no phase where the amplitude drowns in its sigma."""

    name: str
    amplitude: Finite
    sigma: NotNegative
    unit: str
    phase_deg: Known = None
    sigma_phase_deg: Known = None
    instrument: str = ""


class CombinationEntry(Entry):
    """A combination of parameters, in prior sigmas, that is not determined; `gain` is the share told of it."""

    combination: dict[str, Finite]
    gain: Known = None
    cure: str = ""


class StationEntry(Entry):
    """Pose of a station: mm, quaternion x y z w from instrument to network."""

    name: str
    position_mm: Vector
    rotation_quaternion: tuple[Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 1.0)
    sigma_position_mm: tuple[Known, Known, Known] | None = None
    sigma_rotation_arcsec: tuple[Known, Known, Known] | None = None


class OutlierEntry(Entry):
    """A reading that does not belong; `gross`: the largest of a whole pointing that was left out."""

    row: int
    station: str
    target: str
    observable: str
    size: Finite
    unit: str
    w: Finite
    gross: bool = False
    left_out: bool = False


class NoiseEntry(Entry):
    """Noise that was found from the readings; no `factor_sigma`: too little redundancy, the factor is as stated."""

    observable: str
    instrument: str = ""
    factor: Finite
    factor_sigma: Known = None
    redundancy: Finite
    typical: Finite
    unit: str = ""


class VerdictEntry(Entry):
    """Which test to trust where they disagree."""

    case: str = ""
    sentence: str = ""
    scale_by_sigma0: bool = False


class CalibrationFile(ResultFile):
    """`calibration.json`: from `calibrate` and `adjust`; name, value and unit of parameters are enough to apply it."""

    FILE: ClassVar[str] = "calibration.json"
    format: Literal["ltsim-calibration/1"] = "ltsim-calibration/1"
    method: str = "network"
    construction: str
    fit: FitEntry = FitEntry()
    frame: str = ""
    parameters: tuple[ParameterEntry, ...]
    covariance: tuple[tuple[Finite, ...], ...] = ()
    harmonics: tuple[HarmonicEntry, ...] = ()
    undetermined: tuple[CombinationEntry, ...] = ()
    stations: tuple[StationEntry, ...] = ()
    criteria: dict[str, CriterionEntry] = Field(default_factory=dict)
    outliers: tuple[OutlierEntry, ...] = ()
    robust: bool = False
    noise: tuple[NoiseEntry, ...] = ()
    noise_estimated: bool = False
    verdict: VerdictEntry = VerdictEntry()
    lost_targets: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _covariance_is_square(self) -> Self:
        count = len(self.parameters)
        if self.covariance and {len(self.covariance), *map(len, self.covariance)} != {count}:
            raise ValueError(f"the covariance is not a square of {count} x {count} numbers")
        return self


class ChiSquareEntry(Entry):
    """A chi-square test."""

    chi2: Finite
    dof: int
    p_value: Finite


class DifferenceEntry(Entry):
    """Later minus earlier estimate of one parameter."""

    name: str
    difference: Finite
    sigma: Finite
    unit: str
    p_value: Finite


class ChangeEntry(ChiSquareEntry):
    """From one calibration to another."""

    from_: str = Field(alias="from")
    to: str
    changed: tuple[str, ...] = ()
    parameters: tuple[DifferenceEntry, ...] = ()


class CourseEntry(Entry):
    """One parameter over the calibrations, in the unit a person reads."""

    name: str
    unit: str = ""
    values: tuple[Finite, ...]
    sigmas: tuple[NotNegative, ...]
    prior_sigma: Known = None
    mean: Finite
    spread: Finite
    constant: ChiSquareEntry


class EventEntry(Entry):
    """A step of one parameter that stands out of how it moves from one calibration to the next."""

    from_: str = Field(alias="from")
    to: str
    name: str
    difference: Finite
    sigma: NotNegative
    usual: NotNegative
    unit: str
    p_value: Finite


class CalibrationOf(Entry):
    """One calibration of a history."""

    label: str
    fit: FitEntry


class HistoryFile(ResultFile):
    """`history.json`: from `history`."""

    FILE: ClassVar[str] = "history.json"
    format: Literal["ltsim-history/1"] = "ltsim-history/1"
    construction: str = ""
    calibrations: tuple[CalibrationOf, ...]
    parameters: tuple[CourseEntry, ...] = ()
    constant: ChiSquareEntry | None = None
    changes: tuple[ChangeEntry, ...] = ()
    events: tuple[EventEntry, ...] = ()
    since_first: ChangeEntry

    @model_validator(mode="after")
    def _one_value_a_calibration(self) -> Self:
        count = len(self.calibrations)
        for course in self.parameters:
            if len(course.values) != count or len(course.sigmas) != count:
                raise ValueError(f"the parameter {course.name} has not one value and one sigma a calibration")
        return self
