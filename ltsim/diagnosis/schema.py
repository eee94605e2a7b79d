"""Entries of diagnosis.json, and the tables of a diagnosis."""

from dataclasses import replace
from typing import Self

from pydantic import Field

from ltsim.adjustment.remedies.detectability import MinimalSize
from ltsim.calibration.combinations import DeterminedEntry
from ltsim.calibration.schema import COORDINATE_COLUMNS, RESIDUALS_TABLE
from ltsim.core.results import Column, Table, columns_of, numbers, texts
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects.signature import Parameter, ShapeParameter
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat

DIAGNOSED_TARGETS_TABLE = Table(
    "targets.csv",
    "targets adjusted with the findings modelled",
    (
        *COORDINATE_COLUMNS,
        *numbers(".6f", change_x_mm="against the ordinary adjustment", change_y_mm="as x", change_z_mm="as x"),
    ),
)
RESIDUALS_BEFORE_TABLE = replace(
    RESIDUALS_TABLE, file="residuals_before.csv", about="residuals of the ordinary adjustment"
)


class FindingScope(Entry):
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
    """Covariates on which the effect depends: time, angles, or an additional column of the recording."""


class FindingEvidence(Entry):
    """Strength of the evidence for a finding; `p_value` is corrected for everything that was searched."""

    chi2_drop: Finite
    """Decrease of chi-square with the finding modelled."""
    parameters: int
    """Number of parameters of the finding."""
    p_value: OptionalFloat = None
    """p-value in the complete search, from n simulated clean recordings, never below 1 / (n + 1)."""
    probability: Finite = 1.0
    """Posterior probability of this name against all other explanations."""
    p_located: OptionalFloat = None
    """Probability of any effect on these observables, at this place and with these covariates."""

    @property
    def p_real(self) -> float:
        """Probability of the name, or of any such change."""
        return max(self.probability, self.p_located or 0.0)


class Equivalent(Entry):
    """Another effect that cannot be excluded."""

    effect: str
    """Identifier of the effect in the catalogue."""
    probability: Finite = 0.0
    """Posterior probability of this effect."""


class ParameterEstimate(Entry):
    """Estimate of a parameter of a finding, or of a constant of an instrument: a correction, truth minus reading."""

    name: str
    """Name of the parameter."""
    value: Finite
    """Estimated size."""
    sigma: Finite = 0.0
    """Standard deviation of the size."""
    unit: str = ""
    """Unit of display of value and standard deviation."""

    @classmethod
    def from_si(cls, parameter: Parameter | ShapeParameter, value: float, sigma: float) -> Self:
        """Estimate of a parameter from its value and standard deviation [SI]."""
        factor = SI_PER_UNIT[parameter.unit]
        return cls(name=parameter.name, value=value / factor, sigma=sigma / factor, unit=parameter.unit)


class ResponseCurve(Entry):
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
    """Identifier of the effect in the catalogue, or `unknown`."""
    is_catalogued: bool = Field(default=True, alias="known")
    """True for an effect of the catalogue."""
    sentence: str = ""
    """Sentence on the finding."""
    where: FindingScope = FindingScope()
    """Scope of the finding."""
    parameters: tuple[ParameterEstimate, ...] = ()
    """Sizes of the effect."""
    target_shift_rms_um: OptionalFloat = None
    """Displacement of the targets if the finding is not modelled [um]: rms after the best rigid fit."""
    evidence: FindingEvidence
    """Strength of the evidence."""
    equivalents: tuple[Equivalent, ...] = ()
    """Other effects that cannot be excluded."""
    separate_by: str = ""
    """Measurement that would discriminate the effect from its equivalents."""
    formula: str = ""
    """Formula of the proposed term of an unknown effect."""
    carrier: str = ""
    """Response on which an effect outside the catalogue acts."""
    driver: str = ""
    """Regressor: quantity or function on which an effect outside the catalogue depends."""
    curve: ResponseCurve | None = None
    """Curve of the response; null if it does not depend on a single covariate."""


class GlobalTest(Entry):
    """Global test of the ordinary model."""

    statistic: OptionalFloat
    """Chi-square of the ordinary model."""
    dof: int
    """Degrees of freedom."""
    p_value: OptionalFloat
    """p-value: probability of as large a chi-square or larger; reports display the two-sided one."""
    search_p_value: OptionalFloat = None
    """p-value of the complete search."""


class Misfit(Entry):
    """Chi-square, and normalised error of held-out observations."""

    chi2: Finite
    """Weighted sum of squares."""
    dof: int
    """Degrees of freedom."""
    held_out_rms: OptionalFloat = None
    """Error of held-out readings in five folds of the pointings, each predicted by a fit and search without it, divided
    by the larger of the declared and the estimated noise.
    """


class BeforeAfter(Entry):
    """Fit without and with the findings."""

    before: Misfit
    """Misfit without the findings."""
    after: Misfit
    """Misfit with the findings."""


class Undetectable(Entry):
    """Effect that is not detectable in this network."""

    effect: str
    """Identifier of the effect in the catalogue."""
    reason: str = ""
    """Reason for which it has no detectable influence on these readings."""
    undetected_target_error_um: OptionalFloat = None
    """Error of the targets caused by a large but plausible size of the effect."""
    detectable_at_factor: OptionalFloat = None
    """Multiple of a large but plausible size from which the effect is detectable; null if it never is."""
    cure: str = ""
    """Measurement that would make the effect detectable."""


class DetectableEntry(Entry):
    """Smallest detectable size of an effect."""

    effect: str
    """Identifier of the effect in the catalogue."""
    parameter: str = ""
    """Name of the parameter."""
    size: OptionalFloat
    """Smallest detectable size, in `unit`."""
    unit: str = ""
    """Unit of the size."""

    @classmethod
    def from_minimal_size(cls, minimal_size: MinimalSize) -> Self:
        """Entry of a minimal detectable size at a median place."""
        size = minimal_size.median_size / SI_PER_UNIT[minimal_size.unit]
        return cls(effect=minimal_size.effect, parameter=minimal_size.parameter, size=size, unit=minimal_size.unit)


class InstrumentEntry(Entry):
    """Ordinary calibration of one instrument."""

    name: str
    """Name of the instrument."""
    parameters: tuple[ParameterEstimate, ...] = ()
    """Estimated constants."""
    determined: tuple[DeterminedEntry, ...] = ()
    """Combinations that the recording determines."""


FINDINGS_TABLE = Table(
    "findings.csv",
    "findings, one row per parameter",
    (
        *texts(effect="id of the catalogue, or `unknown`", stations="place of the effect; empty for all"),
        *texts(targets="place of the effect; empty for all", observables="on which it acts"),
        Column("probability", "of this name against all other explanations"),
        *texts(parameter="of the effect"),
        Column("value", "estimated size", sigma="sigma"),
        Column("sigma", "its standard deviation"),
        *texts(unit="of value and sigma"),
    ),
)
FIT_TABLE = Table(
    "fit.csv",
    "fit before and after",
    (
        *texts(model="without or with the findings"),
        Column("chi2", "weighted sum of squares"),
        Column("degrees_of_freedom"),
        Column("ratio", "chi-square per degree of freedom", shown=".3f"),
        Column("held_out_error", "normalised error of held-out observations", digits=3),
    ),
)
UNDETECTABLE_TABLE = Table(
    "undetectable.csv",
    "effects that leave no residual",
    columns_of(Undetectable, undetected_target_error_um={"digits": 2}, detectable_at_factor={"digits": 2}),
)
DETECTABLE_TABLE = Table("detectable.csv", "smallest detectable sizes of effects", columns_of(DetectableEntry))
