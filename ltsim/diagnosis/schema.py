"""What a diagnosis says, in the models that stand in diagnosis.json as they are; the tables beside it."""

from dataclasses import replace
from typing import ClassVar, Literal, Self

from ltsim.adjustment.identification.tests import Test
from ltsim.calibration.schema import COORDINATES, RESIDUALS, DeterminedEntry
from ltsim.core.results import Table, numbers
from ltsim.core.units import FACTOR
from ltsim.physics.effects.signature import Parameter, ShapeParameter
from ltsim.recordings.result_file import Entry, Finite, Known, ResultFile

TARGETS = Table(
    "targets.csv",
    "targets adjusted with the findings modelled",
    (
        *COORDINATES,
        *numbers(".6f", change_x_mm="against the ordinary adjustment", change_y_mm="as x", change_z_mm="as x"),
    ),
)
BEFORE = replace(RESIDUALS, file="residuals_before.csv", about="what the ordinary adjustment left")


class Where(Entry):
    """What a finding is confined to; empty means everything."""

    observables: tuple[str, ...] = ()
    """`distance`, `azimuth`, `elevation`."""
    stations: tuple[str, ...] = ()
    """Names."""
    targets: tuple[str, ...] = ()
    """Names."""
    instruments: tuple[str, ...] = ()
    """Names."""
    covariates: tuple[str, ...] = ()
    """What it follows: time, angles, or a further column of the recording."""


class Evidence(Entry):
    """How strong a finding is; `p_value` is corrected for everything that was searched."""

    chi2_drop: Finite
    """How much chi-square falls."""
    parameters: int
    """For how many."""
    p_value: Known = None
    """Chance of as much in a clean recording, in the whole search: of n simulated ones, never below 1 / (n + 1)."""
    probability: Finite = 1.0
    """Of this name against all other explanations."""
    shown: Known = None
    """Probability that it acts on this, here, and follows this, whatever the cause is called."""

    @property
    def chance(self) -> float:
        """Probability of its name, or of such a change whatever it is called."""
        return max(self.probability, self.shown or 0.0)


class Equivalent(Entry):
    """Another effect that cannot be excluded."""

    effect: str
    """Id of the catalogue."""
    probability: Finite = 0.0
    """That it is this one."""


class Estimate(Entry):
    """A parameter of a finding, or a constant of an instrument: a correction, truth minus reading."""

    name: str
    """Its name."""
    value: Finite
    """Its size."""
    sigma: Finite = 0.0
    """Its standard deviation."""
    unit: str = ""
    """Of both: that in which a person reads it."""

    @classmethod
    def of(cls, parameter: Parameter | ShapeParameter, value: float, sigma: float) -> Self:
        """The estimate of a parameter from value and deviation [SI]."""
        factor = FACTOR[parameter.unit]
        return cls(name=parameter.name, value=value / factor, sigma=sigma / factor, unit=parameter.unit)


class Curve(Entry):
    """What a carrier does over a covariate."""

    covariate: str
    """What it follows."""
    unit: str = ""
    """Of the carrier."""
    at: tuple[Finite, ...]
    """Values of the covariate: SI, or in the unit of the recording's own column."""
    value: tuple[Finite, ...]
    """Of the carrier there."""
    sigma: tuple[Finite, ...]
    """Standard deviations."""


class Finding(Entry):
    """One thing left out of the model."""

    effect: str
    """Id of the catalogue, or `unknown`."""
    known: bool = True
    """It is one of the catalogue."""
    sentence: str = ""
    """The same for a person."""
    where: Where = Where()
    """What it is confined to."""
    parameters: tuple[Estimate, ...] = ()
    """Its size."""
    moves_targets_um: Known = None
    """What it does to the coordinates of the targets where it is not modelled: rms after the best rigid fit."""
    evidence: Evidence
    """How strong it is."""
    equivalents: tuple[Equivalent, ...] = ()
    """What else it may be."""
    separate_by: str = ""
    """The measurement that would tell it from its equivalents."""
    formula: str = ""
    """The proposed term of an unknown effect."""
    carrier: str = ""
    """What an effect that no card names acts on."""
    driver: str = ""
    """What an effect that no card names follows."""
    curve: Curve | None = None
    """The same as a curve, where it follows one covariate."""


class GlobalTest(Entry):
    """The test of the whole model."""

    statistic: Known
    """Chi-square."""
    dof: int
    """Degrees of freedom."""
    p_value: Known
    """Chance of as large a chi-square or larger; pages print the two-sided one, from both tails."""
    search_p_value: Known = None
    """Of the whole search."""


class Misfit(Entry):
    """Chi-square, and the normalised error on observations that the fit did not see."""

    chi2: Finite
    """Weighted sum of squares."""
    dof: int
    """Degrees of freedom."""
    held_out_rms: Known = None
    """Error on five parts of the pointings, left out in turn and predicted by a fit and search without them, over the
    noise: stated, or found where that is larger."""


class BeforeAfter(Entry):
    """Fit without and with the findings."""

    before: Misfit
    """Without the findings."""
    after: Misfit
    """With them."""


class Undetectable(Entry):
    """An effect that leaves no residual."""

    effect: str
    """Id of the catalogue."""
    reason: str = ""
    """Why it leaves no trace here."""
    hides_um: Known = None
    """Error of the targets that a bad but plausible size of it hides."""
    shows_at: Known = None
    """How many times that size would be found; none: it never shows."""
    cure: str = ""
    """The measurement that would help."""


class DetectableEntry(Entry):
    """The smallest size that would be seen."""

    effect: str
    """Id of the catalogue."""
    parameter: str = ""
    """Name of the parameter."""
    size: Known
    """Smallest that would be found."""
    unit: str = ""
    """Of the size."""


class InstrumentEntry(Entry):
    """The ordinary calibration of one instrument."""

    name: str
    """Its name."""
    parameters: tuple[Estimate, ...] = ()
    """Estimates."""
    determined: tuple[DeterminedEntry, ...] = ()
    """Combinations that the recording determines."""


class DiagnosisFile(ResultFile):
    """`diagnosis.json`: from `diagnose`."""

    FILE: ClassVar[str] = "diagnosis.json"
    format: Literal["ltsim-diagnosis/1"] = "ltsim-diagnosis/1"
    """Which format and version this file is in."""
    verdict: str
    """`consistent`, or `mismatch`."""
    summary: str
    """The answer in a few sentences."""
    global_test: GlobalTest
    """Of the ordinary model."""
    findings: tuple[Finding, ...] = ()
    """What was left out of the model."""
    tests: tuple[Test, ...] = ()
    """Simple causes that the readings support, and outliers, as `adjust` and `check` have them."""
    fit: BeforeAfter | None = None
    """Without and with the findings."""
    undetectable: tuple[Undetectable, ...] = ()
    """What this network cannot see."""
    detectable: tuple[DetectableEntry, ...] = ()
    """How small everything else may be."""
    instruments: tuple[InstrumentEntry, ...] = ()
    """Their ordinary calibration."""
