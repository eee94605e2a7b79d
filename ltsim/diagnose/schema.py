"""diagnosis.json and the tables beside it: what stands in them, for writers and readers."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

from pydantic import Field

from ltsim.calibrate.schema import COORDINATES, RESIDUALS, ParameterEntry
from ltsim.recording.result_file import Entry, Finite, Known, ResultFile
from ltsim.recording.result_table import ResultTable, numbers

TARGETS = ResultTable(
    "targets.csv",
    "targets adjusted with the findings modelled",
    (
        *COORDINATES,
        *numbers(".6f", change_x_mm="against the ordinary adjustment", change_y_mm="as x", change_z_mm="as x"),
    ),
)
BEFORE = replace(RESIDUALS, file="residuals_before.csv", about="what the ordinary adjustment left")


class WhereEntry(Entry):
    """What a finding is confined to; empty means everything."""

    observables: tuple[str, ...] = ()
    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    instruments: tuple[str, ...] = ()
    covariates: tuple[str, ...] = ()


class EvidenceEntry(Entry):
    """How strong a finding is; `p_value` is corrected for everything that was searched."""

    chi2_drop: Known = None
    parameters: int | None = None
    p_value: Known = None
    probability: Finite = 1.0


class EquivalentEntry(Entry):
    """Another effect that cannot be excluded."""

    effect: str
    probability: Finite = 0.0


class EstimateEntry(Entry):
    """A parameter of a finding."""

    name: str
    value: Finite
    sigma: Known = None
    unit: str = ""


class FindingEntry(Entry):
    """One thing left out of the model."""

    effect: str = Field(description="Id of the catalogue, or `unknown`.")
    known: bool = True
    sentence: str = ""
    where: WhereEntry = WhereEntry()
    parameters: tuple[EstimateEntry, ...] = ()
    evidence: EvidenceEntry = EvidenceEntry()
    equivalents: tuple[EquivalentEntry, ...] = ()
    separate_by: str = Field("", description="The measurement that would tell it from its equivalents.")
    formula: str = Field("", description="The proposed term of an unknown effect.")
    carrier: str = Field("", description="What an effect that no card names acts on.")
    driver: str = Field("", description="What an effect that no card names follows.")


class GlobalTest(Entry):
    """The test of the whole model."""

    statistic: Known
    dof: int
    p_value: Known
    search_p_value: Known = None


class DiagnosisFit(Entry):
    """Chi-square, and the normalised error on observations that the fit did not see."""

    chi2: Known
    dof: int
    held_out_rms: Known = None
    held_out: dict[str, Known] = Field(default_factory=dict)


class BeforeAfter(Entry):
    """Fit without and with the findings."""

    before: DiagnosisFit
    after: DiagnosisFit


class UndetectableEntry(Entry):
    """An effect that leaves no residual."""

    effect: str
    reason: str = ""
    hides_um: Known = None
    cure: str = ""


class DetectableEntry(Entry):
    """The smallest size that would be seen."""

    effect: str
    parameter: str = ""
    size: Known
    unit: str = ""


class DeterminedEntry(Entry):
    """A combination of parameters that the recording determines."""

    combination: dict[str, Finite]
    value: Finite
    sigma: Known = None
    unit: str = ""


class InstrumentEntry(Entry):
    """The ordinary calibration of one instrument."""

    name: str
    parameters: tuple[ParameterEntry, ...] = ()
    determined: tuple[DeterminedEntry, ...] = ()


class DiagnosisFile(ResultFile):
    """`diagnosis.json`: from `diagnose`."""

    FILE: ClassVar[str] = "diagnosis.json"
    format: Literal["ltsim-diagnosis/1"] = "ltsim-diagnosis/1"
    verdict: str = Field(description="`consistent`, or `mismatch`.")
    summary: str
    global_test: GlobalTest
    findings: tuple[FindingEntry, ...] = ()
    fit: BeforeAfter | None = None
    undetectable: tuple[UndetectableEntry, ...] = ()
    detectable: tuple[DetectableEntry, ...] = ()
    instruments: tuple[InstrumentEntry, ...] = ()
