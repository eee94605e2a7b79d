"""The JSON files of the commands as the report reads them: what it needs is checked, the rest is ignored."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ltsim.arrays import Floats
from ltsim.errors import RecordError
from ltsim.recording.files import read_text, shown
from ltsim.units import MILLIMETRE

Vector = tuple[float, float, float]


class Table(BaseModel):
    """Base: unknown keys are ignored, values cannot change."""

    model_config = ConfigDict(extra="ignore", frozen=True, populate_by_name=True)


class Spread(Table):
    """Mean and largest deviation [um]."""

    mean_um: float | None = None
    max_um: float | None = None


class CriterionEntry(Table):
    """A criterion before and after."""

    before: Spread = Spread()
    after: Spread = Spread()
    improvement_percent: float | None = None


class FitEntry(Table):
    """Agreement of readings and model."""

    chi2: float
    dof: int
    sigma0: float | None = None
    p_value: float | None = None
    status: str = ""
    sentence: str = ""
    held_out_rms: float | None = None


class ParameterEntry(Table):
    """One estimate in the unit a person reads."""

    name: str
    value: float
    sigma: float
    unit: str = ""
    prior_sigma: float | None = None
    instrument: str = ""


class CombinationEntry(Table):
    """A combination of parameters that is not determined."""

    combination: dict[str, float]
    gain: float | None = None
    cure: str = ""


class StationEntry(Table):
    """Pose of a station: mm, quaternion x y z w from instrument to network."""

    name: str
    position_mm: Vector
    rotation_quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    sigma_position_mm: Vector | None = None


class OutlierEntry(Table):
    """A reading that does not belong."""

    row: int
    station: str
    target: str
    observable: str
    size: float
    unit: str
    w: float
    left_out: bool = False


class NoiseEntry(Table):
    """Noise that was found from the readings."""

    observable: str
    instrument: str = ""
    factor: float
    factor_sigma: float | None = None
    redundancy: float
    typical: float
    unit: str = ""


class VerdictEntry(Table):
    """Which test to trust."""

    case: str = ""
    sentence: str = ""


class CalibrationFile(Table):
    """`calibration.json`."""

    format: str
    method: str = ""
    construction: str = ""
    fit: FitEntry
    frame: str = ""
    parameters: tuple[ParameterEntry, ...] = ()
    covariance: tuple[tuple[float, ...], ...] = ()
    undetermined: tuple[CombinationEntry, ...] = ()
    stations: tuple[StationEntry, ...] = ()
    criteria: dict[str, CriterionEntry] = Field(default_factory=dict)
    outliers: tuple[OutlierEntry, ...] = ()
    robust: bool = False
    noise: tuple[NoiseEntry, ...] = ()
    noise_estimated: bool = False
    verdict: VerdictEntry = VerdictEntry()
    lost_targets: tuple[str, ...] = ()


class WhereEntry(Table):
    """What a finding is confined to; empty means everything."""

    observables: tuple[str, ...] = ()
    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    covariates: tuple[str, ...] = ()


class EvidenceEntry(Table):
    """How strong a finding is."""

    chi2_drop: float | None = None
    parameters: int | None = None
    p_value: float | None = None
    probability: float = 1.0


class EquivalentEntry(Table):
    """Another effect that cannot be excluded."""

    effect: str
    probability: float = 0.0


class FindingEntry(Table):
    """One thing left out of the model."""

    effect: str
    known: bool = True
    sentence: str = ""
    where: WhereEntry = WhereEntry()
    parameters: tuple[ParameterEntry, ...] = ()
    evidence: EvidenceEntry = EvidenceEntry()
    equivalents: tuple[EquivalentEntry, ...] = ()
    separate_by: str = ""
    formula: str = ""


class GlobalTest(Table):
    """The test of the whole model."""

    statistic: float
    dof: int
    p_value: float
    search_p_value: float | None = None


class BeforeAfter(Table):
    """Fit without and with the findings."""

    before: FitEntry
    after: FitEntry


class UndetectableEntry(Table):
    """An effect that leaves no residual."""

    effect: str
    reason: str = ""
    hides_um: float | None = None
    cure: str = ""


class DetectableEntry(Table):
    """The smallest size that would be seen."""

    effect: str
    parameter: str = ""
    size: float
    unit: str = ""


class DiagnosisFile(Table):
    """`diagnosis.json`."""

    format: str
    verdict: str
    summary: str
    global_test: GlobalTest
    findings: tuple[FindingEntry, ...] = ()
    fit: BeforeAfter | None = None
    undetectable: tuple[UndetectableEntry, ...] = ()
    detectable: tuple[DetectableEntry, ...] = ()


File = TypeVar("File", bound=Table)


def read_json(file: Path, model: type[File], format_: str) -> File:
    """A JSON file checked against what the report needs of it.

    Raises
    ------
    RecordError
        When it is not JSON, of another format, or lacks something.
    """
    content = raw_json(file)
    found = content.get("format")
    if found != format_:
        raise RecordError(f"format is '{shown(str(found))}', expected '{format_}'", file=file)
    try:
        return model.model_validate(content)
    except ValidationError as problem:
        error = problem.errors()[0]
        key = ".".join(str(part) for part in error["loc"])
        raise RecordError(f"{shown(key)}: {shown(error['msg'], 120)}", file=file) from None


def raw_json(file: Path) -> dict[str, Any]:
    """The object of a JSON file."""
    try:
        content = json.loads(read_text(file))
    except (json.JSONDecodeError, RecursionError):
        raise RecordError("is not JSON; write it again with the command that made it", file=file) from None
    if not isinstance(content, dict):
        raise RecordError("holds no JSON object", file=file)
    return content


def read_targets(file: Path) -> tuple[tuple[str, ...], Floats, Floats]:
    """Names, coordinates (T, 3) [m] and their standard deviations (T, 3) [m] from `targets.csv`.

    Raises
    ------
    RecordError
        When a column is missing or a field is no number.
    """
    names, rows = [], []
    columns = ("x_mm", "y_mm", "z_mm", "sigma_x_mm", "sigma_y_mm", "sigma_z_mm")
    reader = csv.DictReader(read_text(file).splitlines())
    missing = [name for name in ("target", *columns) if name not in (reader.fieldnames or ())]
    if missing:
        raise RecordError(f"there is no column {missing[0]}; expected target,{','.join(columns)}", file=file)
    for number, record in enumerate(reader, start=1):
        try:
            rows.append([float(record[column] or "nan") for column in columns])
        except (TypeError, ValueError):
            raise RecordError("a coordinate is no number", file=file, row=number) from None
        names.append(record["target"] or "")
    values = np.array(rows, dtype=np.float64).reshape(-1, 6) * MILLIMETRE
    return tuple(names), values[:, :3], values[:, 3:]
