"""Schema of `diagnosis.json`: its entries, and the data tables of a diagnosis."""

from dataclasses import replace
from typing import Self

from pydantic import Field

from ltsim.adjustment.remedies.detectability import MinimalDetectableSize
from ltsim.calibration.combinations import DeterminedEntry
from ltsim.calibration.schema import COORDINATE_COLUMNS, RESIDUALS_TABLE
from ltsim.core.results import Column, Table, model_columns, number_columns, text_columns
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects.linear_effect import Parameter, ShapeParameter
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat

DIAGNOSED_TARGETS_TABLE = Table(
    "targets.csv",
    "targets adjusted with the findings in the model",
    (
        *COORDINATE_COLUMNS,
        *number_columns(
            ".6f", **{f"change_{axis}_mm": f"change of {axis} against the ordinary adjustment" for axis in "xyz"}
        ),
    ),
)
"""Columns of `targets.csv`: coordinates, standard deviations, and changes against the ordinary adjustment."""
BASELINE_RESIDUALS_TABLE = replace(
    RESIDUALS_TABLE, file="residuals_before.csv", description="residuals of the ordinary adjustment"
)
"""Columns of `residuals_before.csv`: residuals of the ordinary adjustment."""


class FindingScope(Entry):
    """Scope of a finding: the observables that it changes, and the stations, targets and instruments where it acts.

    An empty list means no restriction of this kind.
    """

    observables: tuple[str, ...] = ()
    """Names of the changed observables: `distance`, `azimuth`, `elevation`."""
    stations: tuple[str, ...] = ()
    """Names of the stations where the effect acts."""
    targets: tuple[str, ...] = ()
    """Names of the targets where the effect acts."""
    instruments: tuple[str, ...] = ()
    """Names of the instruments whose set-ups the effect changes."""
    covariates: tuple[str, ...] = ()
    """Names of the covariates on which the effect depends, such as time, angles, or an additional column of the
    recording."""


class FindingEvidence(Entry):
    """Strength of the evidence for a finding: drop of chi-square, p-value and probabilities."""

    chi2_drop: Finite
    """Decrease of chi-square by the inclusion of the finding in the model. For noise it is twice the gain of log
    likelihood, and for exchanged names, wrong units and centring errors twice the gain of log evidence of robust
    fits."""
    parameters: int
    """Number of estimated parameters of the finding."""
    p_value: OptionalFloat = None
    """p-value of the finding, corrected for the number of hypotheses of the search for effects. It is the rank among n
    simulated recordings without effects, and is never below 1 / (n + 1). For a finding that was corrected before the
    search it is the p-value of its test, not corrected for other tests."""
    probability: Finite = 1.0
    """Posterior probability of this effect against all other explanations."""
    p_same_scope: OptionalFloat = None
    """Posterior probability of any effect with the same scope: observables, stations, targets and covariates."""

    @property
    def p_real(self) -> float:
        """Probability that the finding is real: the larger of `probability` and `p_same_scope`."""
        return max(self.probability, self.p_same_scope or 0.0)


class EquivalentEffect(Entry):
    """Equivalent of a finding: another effect that cannot be excluded as its cause."""

    effect: str
    """Name of the other effect in the catalogue."""
    probability: Finite = 0.0
    """Posterior probability that the other effect is the cause."""


class ParameterEstimate(Entry):
    """Estimate of a parameter of a finding or of an instrument constant, as a correction: true value minus reading."""

    name: str
    """Name of the parameter."""
    value: Finite
    """Estimated value of the parameter."""
    sigma: Finite = 0.0
    """Standard deviation of the estimated value."""
    unit: str = ""
    """Unit of the value and of the standard deviation."""

    @classmethod
    def from_si(cls, parameter: Parameter | ShapeParameter, value: float, sigma: float) -> Self:
        """Estimate of a parameter from its value and standard deviation [SI]."""
        factor = SI_PER_UNIT[parameter.unit]
        return cls(name=parameter.name, value=value / factor, sigma=sigma / factor, unit=parameter.unit)


class ResponseCurve(Entry):
    """Curve of the quantity that a finding changes, as a function of one covariate."""

    covariate: str
    """Name of the covariate over which the curve runs."""
    unit: str = ""
    """Unit of the values of the curve and of their standard deviations."""
    at: tuple[Finite, ...]
    """Values of the covariate in SI units, or in the unit of an additional column of the recording."""
    value: tuple[Finite, ...]
    """Values of the changed quantity at the values of the covariate in `at`, in `unit`."""
    sigma: tuple[Finite, ...]
    """Standard deviations of the curve, in `unit`."""


class Finding(Entry):
    """Finding of a diagnosis: an unmodelled cause that explains a part of the misfit."""

    effect: str
    """Name of the effect in the catalogue, or `unknown`."""
    is_catalogued: bool = Field(default=True, alias="known")
    """True if the cause is an effect of the catalogue, false for an unknown effect."""
    is_corrected_before_search: bool = False
    """True if the readings were corrected by the finding, or were left out, before the global test and the search for
    effects."""
    sentence: str = ""
    """Description of the finding in a few sentences."""
    where: FindingScope = FindingScope()
    """Observables, stations, targets, instruments and covariates to which the finding is limited."""
    parameters: tuple[ParameterEstimate, ...] = ()
    """Estimated parameters and shape parameters (period, time constant, onset time) of the effect."""
    target_shift_rms_um: OptionalFloat = None
    """Displacement of the targets if the finding is not modelled [um]: rms after a rigid least-squares fit."""
    evidence: FindingEvidence
    """Strength of the evidence for the finding."""
    equivalents: tuple[EquivalentEffect, ...] = ()
    """Other effects that cannot be excluded as the cause."""
    separate_by: str = ""
    """Measurement that would discriminate the effect from its equivalents."""
    formula: str = ""
    """Formula of an effect outside the catalogue, as text."""
    carrier: str = ""
    """Reading or instrument constant that an effect outside the catalogue changes."""
    driver: str = ""
    """Quantity or function of covariates (regressor) on which an effect outside the catalogue depends."""
    curve: ResponseCurve | None = None
    """Curve of the changed quantity over its covariate; null if it does not depend on a single covariate."""

    @property
    def concerns_reference_value(self) -> bool:
        """True for an error of a reference value, such as a declared coordinate or a known length."""
        return self.carrier.startswith("reference")


class GlobalTest(Entry):
    """Global test of the agreement of the ordinary adjustment with the declared noise."""

    statistic: OptionalFloat
    """Chi-square of the ordinary adjustment."""
    dof: int
    """Degrees of freedom of the ordinary adjustment."""
    p_value: OptionalFloat
    """One-sided p-value of chi-square: probability of at least this chi-square if the model is correct. Reports display
    the two-sided p-value."""
    search_p_value: OptionalFloat = None
    """p-value of the complete search for effects, corrected for the number of hypotheses."""


class Misfit(Entry):
    """Misfit of an adjustment: chi-square, and the normalised error of held-out readings."""

    chi2: Finite
    """Chi-square, the weighted sum of squared residuals."""
    dof: int
    """Degrees of freedom of the adjustment."""
    held_out_rms: OptionalFloat = None
    """Root mean square prediction error of held-out readings, divided by the larger of the declared and the estimated
    noise. The readings of each of five folds of pointings are predicted by a diagnosis and an adjustment without the
    fold."""


class MisfitBeforeAfter(Entry):
    """Misfit of the adjustments without and with the findings in the model."""

    before: Misfit
    """Misfit of the adjustment without the findings in the model."""
    after: Misfit
    """Misfit of the adjustment with the findings in the model."""


class UndetectableEntry(Entry):
    """Entry of an effect that is not detectable in this network."""

    effect: str
    """Name of the undetectable effect in the catalogue."""
    reason: str = ""
    """Reason why the effect is not detectable in these readings."""
    undetected_target_error_um: OptionalFloat = None
    """Error of the target coordinates [um] by a large but plausible size of the effect."""
    detectable_at_factor: OptionalFloat = None
    """Smallest detectable size of the effect divided by a large but plausible size; null if no size is detectable."""
    cure: str = ""
    """Measurement that would make the effect detectable."""


class DetectableEntry(Entry):
    """Entry of a detectable effect with its smallest detectable size."""

    effect: str
    """Name of the detectable effect in the catalogue."""
    parameter: str = ""
    """Name of the parameter of the effect to which the size refers."""
    size: OptionalFloat
    """Smallest detectable size of the parameter, in `unit`."""
    unit: str = ""
    """Unit of the smallest detectable size."""

    @classmethod
    def from_minimal_size(cls, minimal_size: MinimalDetectableSize) -> Self:
        """Entry from a smallest detectable size, the median over the stations and targets where the effect may act."""
        displayed_size = minimal_size.median_size / SI_PER_UNIT[minimal_size.unit]
        return cls(
            effect=minimal_size.effect, parameter=minimal_size.parameter, size=displayed_size, unit=minimal_size.unit
        )


class InstrumentEntry(Entry):
    """Entry of one instrument with the results of its ordinary calibration."""

    name: str
    """Name of the instrument."""
    parameters: tuple[ParameterEstimate, ...] = ()
    """Estimated instrument constants."""
    determined: tuple[DeterminedEntry, ...] = ()
    """Linear combinations of the instrument constants that the recording determines."""


FINDINGS_TABLE = Table(
    "findings.csv",
    "findings, one row per parameter",
    (
        *text_columns(effect="name of the effect in the catalogue, or `unknown`"),
        *text_columns(stations="stations at which the effect acts; empty for all"),
        *text_columns(targets="targets at which the effect acts; empty for all"),
        *text_columns(observables="observables on which the effect acts; empty for all"),
        Column("probability", "posterior probability of this effect against all other explanations"),
        *text_columns(parameter="name of a parameter of the effect"),
        Column("value", "estimated size", sigma_column="sigma"),
        Column("sigma", "standard deviation of the size"),
        *text_columns(unit="unit of value and sigma"),
    ),
)
"""Columns of `findings.csv`: findings with one row per parameter."""
FIT_TABLE = Table(
    "fit.csv",
    "misfit without and with the findings in the model",
    (
        *text_columns(model="model without or with the findings"),
        Column("chi2", "chi-square, the weighted sum of squared residuals"),
        Column("degrees_of_freedom"),
        Column("ratio", "chi-square per degree of freedom", display_format=".3f"),
        Column("held_out_error", "normalised error of held-out readings", n_digits=3),
    ),
)
"""Columns of `fit.csv`: misfit without and with the findings in the model."""
UNDETECTABLE_TABLE = Table(
    "undetectable.csv",
    "effects that are not detectable in this network",
    model_columns(UndetectableEntry, undetected_target_error_um={"n_digits": 2}, detectable_at_factor={"n_digits": 2}),
)
"""Columns of `undetectable.csv`: effects that are not detectable in this network."""
DETECTABLE_TABLE = Table("detectable.csv", "smallest detectable sizes of effects", model_columns(DetectableEntry))
"""Columns of `detectable.csv`: smallest detectable sizes of effects."""
