"""Calibrations of one instrument over time: changes of its parameters from date to date, and tests of these changes.

Two calibrations with the same prior are not independent: if the readings have no information, both give the prior mean,
and their agreement means nothing. All tests therefore use the joint covariance of the estimates. Its null hypothesis is
an unchanged instrument, drawn from the prior once and measured independently each time.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from pydantic import Field
from scipy import linalg, special

from ltsim.adjustment.remedies.undetermined import MAX_UNINFORMATIVE_GAIN
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.evidence import LikelihoodInformation, likelihood_information
from ltsim.core.arrays import Floats
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import RecordError, option_text
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.result_file import Entry, Finite
from ltsim.solve.design import NORMAL_RANK_TOLERANCE

MAX_EM_STEPS = 2000
"""Largest number of steps of the expectation-maximisation, which converges linearly."""
MAX_LOG_VARIANCE_CHANGE_AT_CONVERGENCE = 1e-4
"""Change of the log variances in one step of the expectation-maximisation at which the iteration ends."""


class ChiSquareEntry(Entry):
    """Result of a chi-square test."""

    chi2: Finite
    """Chi-square statistic: weighted sum of squares."""
    dof: int
    """Degrees of freedom."""
    p_value: Finite
    """p-value: probability of a chi-square at least this large; 1 without degrees of freedom."""

    @classmethod
    def from_statistic(cls, chi2: float, dof: int) -> Self:
        """Result of a chi-square test from its statistic and its degrees of freedom."""
        return cls(chi2=chi2, dof=dof, p_value=float(special.chdtrc(dof, max(chi2, 0.0))) if dof else 1.0)


class DifferenceEntry(Entry):
    """Difference of one parameter between two calibrations: later minus earlier estimate, with its test."""

    name: str
    """Name of the parameter."""
    difference: Finite
    """Later minus earlier estimate, in `unit`."""
    sigma: Finite
    """Standard deviation of the difference, in `unit`."""
    unit: str
    """Unit of the difference and of its standard deviation."""
    p_value: Finite
    """Two-sided p-value of the difference."""


class ChangeEntry(ChiSquareEntry):
    """Change of an instrument between two calibrations, with the chi-square test that it did not change."""

    from_: str = Field(alias="from")
    """Label of the earlier calibration."""
    to: str
    """Label of the later calibration."""
    changed_parameters: tuple[str, ...] = ()
    """Names of the parameters that changed significantly."""
    parameters: tuple[DifferenceEntry, ...] = ()
    """Differences of all parameters between the two calibrations."""


@dataclass(frozen=True)
class ParameterDistribution(ValueEquality):
    """Distribution of an instrument's parameters over its calibrations: mean and standard deviation."""

    mean: Floats
    """Mean of each parameter over the calibrations, shape (parameters,) [SI]."""
    covariance: Floats
    """Covariance of the estimated mean, shape (parameters, parameters) [SI]."""
    between_calibration_sigma: Floats
    """Standard deviation of the true value of each parameter between calibrations, shape (parameters,) [SI];
    estimation errors are not included."""


@dataclass(frozen=True)
class CalibrationSeries(ValueEquality):
    """Calibrations of one instrument in chronological order."""

    labels: tuple[str, ...]
    """Label of each calibration."""
    calibrations: tuple[Calibration, ...]
    """Calibrations in chronological order, each of one instrument, all with the same geometric error model."""
    days: Floats | None = None
    """Days since the first calibration, one number per calibration; None if a date is missing."""

    @classmethod
    def from_labelled(
        cls,
        labelled_calibrations: Sequence[tuple[str, Calibration]],
        instrument: str | None = None,
        dates: Sequence[str] | None = None,
    ) -> CalibrationSeries:
        """Series of calibrations with labels, which must be in chronological order.

        `instrument` selects one of several instruments. `dates` (ISO format, one per calibration) replace the dates of
        the recordings.

        Raises
        ------
        RecordError
            If there are fewer than two calibrations, their models differ, the instrument is not unique, a
            parameter has no uncertainty, or the dates are invalid or not in chronological order.
        """
        if len(labelled_calibrations) < 2:
            raise RecordError(
                f"the history has {len(labelled_calibrations)} calibration(s); expected at least two to compare"
            )
        if len({c.construction.parameter_names for _, c in labelled_calibrations}) > 1:
            raise RecordError("the calibrations have different instrument models; calibrate all with one construction")
        if not labelled_calibrations[0][1].construction.n_parameters:
            raise RecordError("the calibrations hold no instrument parameters, expected those of `ltsim calibrate`")
        for label, calibration in labelled_calibrations:
            if calibration.has_history_prior:
                how = f"{label} was calibrated with earlier calibrations as its prior ({option_text('prior')})"
                raise RecordError(f"{how}; expected calibrations that are independent of each other")
        calibrations = _with_common_parameters(
            [instrument_calibration(calibration, instrument, label) for label, calibration in labelled_calibrations]
        )
        for (label, _), calibration in zip(labelled_calibrations, calibrations, strict=True):
            unsure = np.flatnonzero(~(calibration.sigma[0] > 0))
            if len(unsure):
                name = calibration.construction.parameter_names[unsure[0]]
                raise RecordError(f"{label} states no uncertainty of {name}; expected one above 0 for every parameter")
        labels = tuple(label for label, _ in labelled_calibrations)
        day_texts = (
            dates
            if dates is not None
            else [c.recording.measured_on if c.recording else None for _, c in labelled_calibrations]
        )
        return cls(labels, calibrations, days_since_first(labels, day_texts))

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def construction(self) -> GeometricErrorModel:
        """Geometric error model of all calibrations."""
        return self.calibrations[0].construction

    @cached_property
    def estimates(self) -> Floats:
        """Estimates of the parameters, shape (calibrations, parameters) [SI]."""
        return np.array([c.estimates[0] for c in self.calibrations])

    @cached_property
    def sigma(self) -> Floats:
        """Standard deviations of the estimates, shape (calibrations, parameters) [SI]."""
        return np.array([c.sigma[0] for c in self.calibrations])

    @cached_property
    def prior_sigma(self) -> Floats:
        """Largest prior standard deviation of each parameter over the calibrations, shape (parameters,) [SI].

        It is the unit of the parameters in all computations of this class.
        """
        return np.max([c.prior_sigma[0] for c in self.calibrations], axis=0)

    @cached_property
    def _likelihood_information(self) -> list[LikelihoodInformation]:
        """Information of the readings of each calibration, without its prior."""
        return [
            likelihood_information(c.estimates[0], c.covariance, c.arrays.effective_prior_sigma[0], self.prior_sigma)
            for c in self.calibrations
        ]

    @cached_property
    def _informative_combinations(self) -> Floats:
        """Orthonormal combinations (parameters, combinations) of parameters that the calibrations determine.

        The parameters are in units of their prior standard deviations.
        """
        remaining = np.mean([e.posterior_covariance for e in self._likelihood_information], axis=0)
        values, vectors = linalg.eigh(remaining)
        return vectors[:, 1.0 - values > MAX_UNINFORMATIVE_GAIN]

    @cached_property
    def _joint_covariance(self) -> Floats:
        """Joint covariance of the estimates of all calibrations if the instrument did not change, in prior variances.

        The shape is (calibrations, parameters, calibrations, parameters). Calibration i has the posterior covariance
        C_i and the information N_i. Its estimate is C_i N_i x + noise, and the noise has the covariance C_i N_i C_i.
        The parameters x are drawn from the prior once for all calibrations.
        """
        remaining = np.array([e.posterior_covariance for e in self._likelihood_information])
        pull = np.array([e.posterior_covariance @ e.information_matrix for e in self._likelihood_information])
        covariance: Floats = np.einsum("iab,jcb->iajc", pull, pull)
        for i in range(len(self)):
            covariance[i, :, i] += pull[i] @ remaining[i]
        return covariance

    def change_between(self, earlier_index: int, later_index: int) -> ChangeEntry:
        """Change between two calibrations of the series: later minus earlier estimates, with p-values.

        `earlier_index` and `later_index` count from 0. The changed parameters are selected by Holm's procedure at the
        level `FAMILY_WISE_LEVEL`. Undetermined parameters have a p-value of 1.
        """
        contrast, parameters = np.zeros((1, len(self))), self.construction.parameters
        contrast[0, [earlier_index, later_index]] = -1.0, 1.0
        gap, spread = self._contrasts_and_covariance(contrast, np.eye(len(parameters)))
        sigma = np.sqrt(np.where(self._mean_variance_reduction > MAX_UNINFORMATIVE_GAIN, np.diag(spread), 0.0))
        z = np.divide(gap, sigma, out=np.zeros_like(sigma), where=sigma > 0)
        chances = 2.0 * special.ndtr(-np.abs(z))
        order = np.argsort(chances)
        holds = chances[order] > FAMILY_WISE_LEVEL / np.arange(len(order), 0, -1)
        changed_indices = np.sort(order[: int(np.argmax(holds)) if holds.any() else len(order)])
        unit = self.prior_sigma / [p.si_per_display_unit for p in parameters]
        test: dict[str, Any] = _chi_square_test(
            *self._contrasts_and_covariance(contrast, self._informative_combinations)
        ).model_dump()
        return ChangeEntry(
            **test | {"from": self.labels[earlier_index], "to": self.labels[later_index]},
            changed_parameters=tuple(parameters[k].name for k in changed_indices),
            parameters=tuple(
                DifferenceEntry(
                    name=p.name, difference=gap[k] * scale, sigma=sigma[k] * scale, unit=p.unit, p_value=chance
                )
                for k, (p, scale, chance) in enumerate(zip(parameters, unit, chances, strict=True))
            ),
        )

    @cached_property
    def _mean_variance_reduction(self) -> Floats:
        """Fraction (parameters,) by which the readings reduce the prior variance, averaged over the calibrations."""
        return 1.0 - np.mean([np.diag(e.posterior_covariance) for e in self._likelihood_information], axis=0)

    def successive_changes(self) -> list[ChangeEntry]:
        """Changes between each calibration and the previous one."""
        return [self.change_between(i, i + 1) for i in range(len(self) - 1)]

    def constancy_test(self, parameter_index: int | None = None) -> ChiSquareEntry:
        """Chi-square test that a parameter is equal in all calibrations.

        `parameter_index` is the index of the parameter; None tests all parameters together.
        """
        contrast = np.diff(np.eye(len(self)), axis=0)
        if parameter_index is None:
            return _chi_square_test(*self._contrasts_and_covariance(contrast, self._informative_combinations))
        if not self._mean_variance_reduction[parameter_index] > MAX_UNINFORMATIVE_GAIN:
            return ChiSquareEntry.from_statistic(0.0, 0)
        return _chi_square_test(
            *self._contrasts_and_covariance(contrast, np.eye(self.construction.n_parameters)[:, [parameter_index]])
        )

    def _contrasts_and_covariance(self, contrast: Floats, combination: Floats) -> tuple[Floats, Floats]:
        """Contrasts (weighted sums) of calibrations, and their covariance if the instrument did not change.

        Each row of `contrast` (contrasts, calibrations) has a coefficient for each calibration, each column of
        `combination` (parameters, combinations) a coefficient for each parameter. The result has one entry for each
        pair of contrast and combination, in prior standard deviations.
        """
        contrasts = contrast @ (self.estimates / self.prior_sigma) @ combination
        half_product: Floats = np.einsum(
            "mi,iajb,as->msjb", contrast, self._joint_covariance, combination, optimize=True
        )
        spread: Floats = np.einsum("msjb,nj,bt->msnt", half_product, contrast, combination, optimize=True)
        return contrasts.ravel(), spread.reshape(contrasts.size, contrasts.size)

    @cached_property
    def population(self) -> ParameterDistribution:
        """Mean of the parameters over the calibrations, and standard deviation between calibrations.

        The standard deviation is estimated by restricted maximum likelihood (Patterson and Thompson, Biometrika 58
        (1971) 545) with expectation-maximisation. Otherwise it would be biased, because the mean comes from the same
        few calibrations. Combinations without information keep the prior mean, and a parameter without information has
        the prior standard deviation.
        """
        information = np.array([e.information_matrix for e in self._likelihood_information])
        vectors = np.array([e.information_vector for e in self._likelihood_information])
        identity, variance = np.eye(self.construction.n_parameters), np.ones(self.construction.n_parameters)
        mean, of_mean = np.zeros(self.construction.n_parameters), identity
        for _ in range(MAX_EM_STEPS):
            # With N and V: weight of the mean in an estimate, covariance of the estimate, covariance of the mean.
            keeps = np.linalg.inv(identity + variance[:, None] * information)
            of_mean = np.linalg.inv(np.einsum("kab,kbc->ac", information, keeps) + identity)
            mean = of_mean @ np.einsum("kba,kb->a", keeps, vectors)
            single = np.einsum("kab,kb->ka", keeps, variance * vectors + mean)
            deviation = keeps - identity
            remaining = keeps * variance + deviation @ of_mean @ np.swapaxes(deviation, 1, 2)
            spread = np.mean((single - mean) ** 2 + np.einsum("kaa->ka", remaining), axis=0)
            spread = np.maximum(spread, NORMAL_RANK_TOLERANCE)
            settled = np.max(np.abs(np.log(spread / variance))) < MAX_LOG_VARIANCE_CHANGE_AT_CONVERGENCE
            variance = spread
            if settled:
                break
        is_silent = self._mean_variance_reduction < MAX_UNINFORMATIVE_GAIN
        mean, variance = np.where(is_silent, 0.0, mean), np.where(is_silent, 1.0, variance)
        unit = self.prior_sigma
        return ParameterDistribution(mean * unit, of_mean * np.outer(unit, unit), np.sqrt(variance) * unit)

    def with_population_prior(self, calibration: Calibration) -> Calibration:
        """Copy of a calibration in which the distribution of the series replaces the prior from the specification.

        The calibration must not be part of the series. The estimate of a parameter that hardly varies between
        calibrations moves to the mean of the series. The estimate of a parameter that varies much stays near the value
        from its own readings.
        """
        population, unit = self.population, self.prior_sigma
        input_calibration = instrument_calibration(calibration, None, "the calibration")
        spread = population.between_calibration_sigma / unit
        likelihood = likelihood_information(
            input_calibration.estimates[0],
            input_calibration.covariance,
            input_calibration.arrays.effective_prior_sigma[0],
            unit,
        )
        covariance = np.linalg.inv(likelihood.information_matrix + np.diag(spread**-2))
        posterior_means = covariance @ (likelihood.information_vector + population.mean / unit * spread**-2)
        return input_calibration.with_changes(
            estimates=(posterior_means * unit)[None],
            covariance=covariance * np.outer(unit, unit),
            prior_sigma=population.between_calibration_sigma[None],
            correction=None,
        )


def instrument_calibration(calibration: Calibration, instrument: str | None, label: str) -> Calibration:
    """Calibration of one instrument, without the adjusted network; `label` names the calibration in errors.

    Raises
    ------
    RecordError
        If the calibration contains several instruments and none of them has the name `instrument`.
    """
    names = calibration.instruments
    if len(names) == 1:
        return calibration
    if instrument not in names:
        raise RecordError(
            f"{label} contains the instruments {', '.join(names)}; choose one with {option_text('instrument')}"
        )
    return calibration.for_instrument(names.index(instrument), np.arange(calibration.construction.n_parameters))


def _with_common_parameters(calibrations: Sequence[Calibration]) -> tuple[Calibration, ...]:
    """Calibrations of one instrument, reduced to the parameters that all of them estimated.

    Raises RecordError if there is no such parameter.
    """
    is_fixed = np.any([c.is_fixed[0] for c in calibrations], axis=0)
    if is_fixed.all():
        raise RecordError("no parameter is estimated in all calibrations; calibrate all with the same parameters")
    return tuple(c.for_instrument(0, np.flatnonzero(~is_fixed)) if is_fixed.any() else c for c in calibrations)


def _chi_square_test(difference: Floats, covariance: Floats) -> ChiSquareEntry:
    """Chi-square test that a vector is zero, over the combinations of its components with nonzero variance.

    `difference` (components,) is the vector and `covariance` (components, components) its covariance.
    """
    values, vectors = linalg.eigh(0.5 * (covariance + covariance.T))
    is_resolved = values > NORMAL_RANK_TOLERANCE * max(float(values[-1]), 0.0)
    z = (vectors[:, is_resolved].T @ difference) / np.sqrt(values[is_resolved])
    return ChiSquareEntry.from_statistic(float(z @ z), int(is_resolved.sum()))


def days_since_first(labels: Sequence[str], dates: Sequence[str | None]) -> Floats | None:
    """Days since the first date, one number per calibration; None if a date is missing.

    `labels` are the names of the calibrations in error messages.

    Raises RecordError for dates that are not in ISO form, a wrong number of dates, or a wrong order.
    """
    if len(dates) != len(labels):
        problem = f"there are {len(dates)} dates for {len(labels)} calibrations"
        raise RecordError(f"{problem}; expected one date per calibration")
    given_dates = [date for date in dates if date]
    if len(given_dates) < len(dates):
        return None
    try:
        times = [datetime.datetime.fromisoformat(date).replace(tzinfo=None) for date in given_dates]
    except ValueError:
        problem = f"the dates {', '.join(given_dates)} are not all in ISO form"
        raise RecordError(f"{problem}; expected dates such as 2026-05-31") from None
    days = np.array([(time - times[0]) / datetime.timedelta(days=1) for time in times])
    backward_steps = np.flatnonzero(np.diff(days) < 0)
    if len(backward_steps):
        i = int(backward_steps[0])
        message = f"{labels[i]} ({given_dates[i]}) is listed before {labels[i + 1]} ({given_dates[i + 1]})"
        raise RecordError(f"{message}; expected calibrations in the order of time")
    return days
