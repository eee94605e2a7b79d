"""Entries of diagnosis.json, and the tables of a diagnosis."""

from dataclasses import replace
from typing import Self

from pydantic import Field

from ltsim.adjustment.remedies.detectability import MinimalSize
from ltsim.calibration.combinations import DeterminedEntry
from ltsim.calibration.schema import COORDINATES, RESIDUALS
from ltsim.core.results import Column, Table, columns_of, numbers, texts
from ltsim.core.units import FACTOR
from ltsim.physics.effects.signature import Parameter, ShapeParameter
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat

TARGETS = Table(
    "targets.csv",
    "targets adjusted with the findings modelled",
    (
        *COORDINATES,
        *numbers(".6f", change_x_mm="against the ordinary adjustment", change_y_mm="as x", change_z_mm="as x"),
    ),
)
BEFORE = replace(RESIDUALS, file="residuals_before.csv", about="residuals of the ordinary adjustment")


class Where(Entry):
    """Scope of a finding; empty means everything."""

    observables: tuple[str, ...] = ()
    """Names of the observables: `distance`, `azimuth`, `elevation`."""
    stations: tuple[str, ...] = ()
    """Names of the stations."""
    targets: tuple[str, ...] = ()
    """Names of the targets."""
    instruments: tuple[str, ...] = ()
    """Names of the instruments."""
    covariates: tuple[str, ...] = ()
    """Covariates on which it depends: time, angles, or a further column of the recording."""


class Evidence(Entry):
    """Strength of the evidence for a finding; `p_value` is corrected for everything that was searched."""

    chi2_drop: Finite
    """Decrease of chi-square with the finding modelled."""
    parameters: int
    """Number of parameters that this takes."""
    p_value: OptionalFloat = None
    """p-value in the whole search: share of n simulated clean recordings, never below 1 / (n + 1)."""
    probability: Finite = 1.0
    """Posterior probability of this name against all other explanations."""
    p_located: OptionalFloat = None
    """Probability of an effect on these observables, at this place and with these covariates, whatever its name."""

    @property
    def chance(self) -> float:
        """Probability of its name, or of such a change whatever it is called."""
        return max(self.probability, self.p_located or 0.0)


class Equivalent(Entry):
    """Another effect that cannot be excluded."""

    effect: str
    """Id of the catalogue."""
    probability: Finite = 0.0
    """Posterior probability of this effect."""


class Estimate(Entry):
    """A parameter of a finding, or a constant of an instrument: a correction, truth minus reading."""

    name: str
    """Name of the parameter."""
    value: Finite
    """Estimated size."""
    sigma: Finite = 0.0
    """Standard deviation of the size."""
    unit: str = ""
    """Display unit of value and standard deviation."""

    @classmethod
    def of(cls, parameter: Parameter | ShapeParameter, value: float, sigma: float) -> Self:
        """The estimate of a parameter from value and deviation [SI]."""
        factor = FACTOR[parameter.unit]
        return cls(name=parameter.name, value=value / factor, sigma=sigma / factor, unit=parameter.unit)


class Curve(Entry):
    """Response of an effect as a function of one covariate."""

    covariate: str
    """Name of the covariate."""
    unit: str = ""
    """Unit of the response and of its standard deviation."""
    at: tuple[Finite, ...]
    """Values of the covariate: SI, or in the unit of the recording's own column."""
    value: tuple[Finite, ...]
    """Response at these values, in `unit`."""
    sigma: tuple[Finite, ...]
    """Standard deviations of the response, in `unit`."""


class Finding(Entry):
    """Finding: an effect that is missing from the model."""

    effect: str
    """Id of the catalogue, or `unknown`."""
    is_catalogued: bool = Field(default=True, alias="known")
    """True for an effect of the catalogue."""
    sentence: str = ""
    """The same for a person."""
    where: Where = Where()
    """Scope of the finding."""
    parameters: tuple[Estimate, ...] = ()
    """Sizes of the effect."""
    target_shift_rms_um: OptionalFloat = None
    """Displacement of the targets where it is not modelled [um]: rms after the best rigid fit."""
    evidence: Evidence
    """Strength of the evidence."""
    equivalents: tuple[Equivalent, ...] = ()
    """Other effects that cannot be excluded."""
    separate_by: str = ""
    """The measurement that would discriminate it from its equivalents."""
    formula: str = ""
    """The proposed term of an unknown effect."""
    carrier: str = ""
    """Response term on which an effect outside the catalogue acts."""
    driver: str = ""
    """Regressor: quantity or function on which an effect outside the catalogue depends."""
    curve: Curve | None = None
    """The same as a curve, where it follows one covariate."""


class GlobalTest(Entry):
    """The test of the whole model."""

    statistic: OptionalFloat
    """Chi-square."""
    dof: int
    """Degrees of freedom."""
    p_value: OptionalFloat
    """p-value: probability of as large a chi-square or larger; pages print the two-sided one."""
    search_p_value: OptionalFloat = None
    """p-value of the whole search."""


class Misfit(Entry):
    """Chi-square, and the normalised error on observations that the fit did not see."""

    chi2: Finite
    """Weighted sum of squares."""
    dof: int
    """Degrees of freedom."""
    held_out_rms: OptionalFloat = None
    """Error on five parts of the pointings, left out in turn and predicted by a fit and search without them, over the
    the larger of the declared and the estimated noise."""


class BeforeAfter(Entry):
    """Fit without and with the findings."""

    before: Misfit
    """Misfit without the findings."""
    after: Misfit
    """Misfit with the findings."""


class Undetectable(Entry):
    """An effect that leaves no residual."""

    effect: str
    """Id of the catalogue."""
    reason: str = ""
    """Reason for which it has no detectable influence on these readings."""
    undetected_target_error_um: OptionalFloat = None
    """Error of the targets that a bad but plausible size of it hides."""
    detectable_at_factor: OptionalFloat = None
    """Multiple of a bad but plausible size from which it would be detected; null where it is never detectable."""
    cure: str = ""
    """The measurement that would help."""


class DetectableEntry(Entry):
    """Smallest detectable size of an effect."""

    effect: str
    """Id of the catalogue."""
    parameter: str = ""
    """Name of the parameter."""
    size: OptionalFloat
    """Smallest detectable size, in `unit`."""
    unit: str = ""
    """Unit of the size."""

    @classmethod
    def of(cls, minimal: MinimalSize) -> Self:
        """The entry of a size, that at a median place."""
        size = minimal.typical / FACTOR[minimal.unit]
        return cls(effect=minimal.effect, parameter=minimal.parameter, size=size, unit=minimal.unit)


class InstrumentEntry(Entry):
    """The ordinary calibration of one instrument."""

    name: str
    """Name of the instrument."""
    parameters: tuple[Estimate, ...] = ()
    """Estimates."""
    determined: tuple[DeterminedEntry, ...] = ()
    """Combinations that the recording determines."""


FINDINGS = Table(
    "findings.csv",
    "findings, a row per parameter",
    (
        *texts(effect="id of the catalogue, or `unknown`", stations="where it acts; empty for all"),
        *texts(targets="where it acts; empty for all", observables="on which it acts"),
        Column("probability", "of this name against all other explanations"),
        *texts(parameter="of the effect"),
        Column("value", "estimated size", sigma="sigma"),
        Column("sigma", "its standard deviation"),
        *texts(unit="of value and sigma"),
    ),
)
FIT = Table(
    "fit.csv",
    "fit before and after",
    (
        *texts(model="without or with the findings"),
        Column("chi2", "weighted sum of squares"),
        Column("degrees_of_freedom"),
        Column("ratio", "chi-square per degree of freedom", shown=".3f"),
        Column("held_out_error", "normalised error on observations that the fit did not see", digits=3),
    ),
)
UNDETECTABLE = Table(
    "undetectable.csv",
    "effects that leave no residual",
    columns_of(Undetectable, undetected_target_error_um={"digits": 2}, detectable_at_factor={"digits": 2}),
)
DETECTABLE = Table("detectable.csv", "smallest detectable sizes of effects", columns_of(DetectableEntry))
