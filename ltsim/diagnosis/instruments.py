"""Instrument constants from a recording, compared with those of other instruments and with earlier calibrations."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.special import erfc

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import CORRECTED_INSTRUMENT_SIGMA_FRACTION, ParameterPrior, prior_sigmas
from ltsim.adjustment.significance import MIN_REPORTED_PROBABILITY
from ltsim.calibration.evidence import (
    change_score_and_information,
    determined_combinations,
    estimates_with_plausible_priors,
    forward_select,
    likelihood_information,
    log_evidence,
    log_marginal_likelihood,
    log_sum_exp,
)
from ltsim.calibration.prior_information import EarlierCalibrationPrior
from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.core.probability import PRIOR_BY_RELATIVE_EFFECT_SIZE
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE, SQRT_MACHINE_EPSILON
from ltsim.diagnosis.evidence import normalised_probabilities
from ltsim.diagnosis.prior import MIN_EFFECT_LOG_EVIDENCE, log_prior_of_each_explanation
from ltsim.diagnosis.schema import InstrumentEntry, ParameterEstimate
from ltsim.physics.effects.effect import Parameter
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import Recording
from ltsim.solve.design import scale_to_unit_diagonal

CHANGED_INSTRUMENT_CONSTANT_VARIANCE = sum(share * size**2 for size, share in PRIOR_BY_RELATIVE_EFFECT_SIZE.items())
"""Prior variance of a changed instrument constant, divided by the manufacturer's squared specification."""
INSTRUMENT_CONSTANT_REFERENCE_PHRASES = {True: "its declared correction", False: "the other instruments"}
"""Name, shown to users, of the reference of an instrument constant, by whether the set-up declares it corrected."""


def instrument_entries(adjustment: Adjustment) -> tuple[InstrumentEntry, ...]:
    """Result entries of all instruments of a recording, with constants and measurable combinations of them."""
    return tuple(_instrument_entry(adjustment, i) for i in range(len(adjustment.recording.instruments)))


def _instrument_entry(adjustment: Adjustment, instrument_index: int) -> InstrumentEntry:
    """Result entry of one instrument of a recording, with its constants and the measurable combinations of them."""
    parameters = adjustment.construction.parameters
    constants = adjustment.state.instrument_parameters[instrument_index]
    covariance = adjustment.instrument_covariance_of(instrument_index)
    sigma, prior = np.sqrt(np.maximum(np.diag(covariance), 0.0)), adjustment.problem.prior.sigma[instrument_index]
    return InstrumentEntry(
        name=adjustment.recording.instruments[instrument_index],
        parameters=tuple(
            ParameterEstimate.from_si(p, v, s) for p, v, s in zip(parameters, constants, sigma, strict=True)
        ),
        determined=tuple(
            determined_combinations(
                parameters, *estimates_with_plausible_priors(parameters, constants, covariance, prior)
            )
        ),
    )


@dataclass(frozen=True)
class InstrumentConstantContradiction:
    """Contradiction between an instrument constant, of one or more instruments, and its reference."""

    instruments: tuple[str, ...]
    """Names of the instruments whose constant contradicts its reference."""
    parameter: Parameter
    """Instrument constant that contradicts its reference."""
    difference_from_reference: float
    """Difference [SI] of the constant from that of the other instruments, zero (if corrected) or earlier
    calibrations."""
    sigma: float
    """Standard deviation [SI] of the difference."""
    log_evidence: float
    """Log marginal likelihood ratio of the change, with its prior odds, given the other contradictions."""
    p_value: float
    """Two-sided p-value of the difference, corrected for the number of instrument constants that are compared."""
    reference_text: str
    """Name of the reference for users, such as `the other instruments`."""
    evidence_share_by_constant: Mapping[Parameter, float]
    """Fractions of the evidence, by instrument constant: for this constant, and for each constant of the same
    instruments that may have changed in its place."""


@dataclass(frozen=True)
class ContradictingInstrumentConstants:
    """Contradictions between the instrument constants of a recording and their references."""

    contradictions: tuple[InstrumentConstantContradiction, ...] = ()
    """Contradictions, the most significant first."""
    log_evidence_of_all_contradictions: float = 0.0
    """Log evidence, with prior odds, of all contradictions together; 0 without contradictions.

    It can be compared with the log evidence of a model of effects.
    """


@dataclass(frozen=True)
class InstrumentConstantChange:
    """Possible change of an instrument constant of one instrument, or of several instruments by the same amount."""

    instrument_indices: tuple[int, ...]
    """Indices of the instruments whose constant may have changed."""
    constant_index: int
    """Index of the changed constant among the p constants of an instrument."""
    reference_text: str
    """Name, shown to users, of the reference with which the instrument constant is compared."""
    added_variance_grid: Floats | float = 0.0
    """Possible additional variances (s,), or a single one, of the constant, divided by the squared specification."""
    log_variance_weights: Floats | float = 0.0
    """Natural logarithms of the prior weights of each value of `added_variance_grid`."""


@dataclass(frozen=True)
class ExpectedInstrumentConstants:
    """Expected p constants of I instruments, divided by the manufacturer's specifications, and changes to be tested."""

    mean: Floats
    """Expected values (I p,) of the p constants of I instruments, divided by the manufacturer's specifications."""
    covariance: Floats
    """Covariance (I p, I p) of the p constants of I instruments, in units of the manufacturer's specifications."""
    possible_changes: tuple[InstrumentConstantChange, ...]
    """Changes of instrument constants that are tested."""


def find_contradicting_instrument_constants(adjustment: Adjustment) -> ContradictingInstrumentConstants:
    """Instrument constants that differ from those of other instruments, or from zero for a corrected instrument.

    If two instruments differ, the readings do not show which one is in error. An error of the constant that is farther
    from zero is then the more probable. An offset common to all corrected instruments is one change, possibly of their
    reference. A contradiction has a log evidence of more than `MIN_EFFECT_LOG_EVIDENCE`.
    """
    recording = adjustment.recording
    setup, unit = recording.setup, prior_sigmas(recording, adjustment.construction)
    is_corrected = np.array([setup.instrument_named(name).corrected for name in recording.instruments])
    is_compared = ~is_corrected & (np.sum(~is_corrected) > 1)
    common_variance = np.where(
        np.outer(is_compared, is_compared)[:, :, None], np.minimum(unit[:, None], unit) ** 2, 0.0
    )
    common_variance /= unit[:, None] * unit  # the common part of all constants is within the smallest specification
    separate_variance = np.where(is_corrected, CORRECTED_INSTRUMENT_SIGMA_FRACTION**2, np.where(is_compared, 0.0, 1.0))
    blocks = common_variance + (np.eye(len(unit)) * separate_variance)[:, :, None]
    covariance = np.einsum("ijp,pq->ipjq", blocks, np.eye(unit.shape[1])).reshape(unit.size, unit.size)
    corrected_indices = tuple(np.flatnonzero(is_corrected).tolist())
    owners = [(i,) for i in np.flatnonzero(is_corrected | is_compared).tolist()] + (
        [corrected_indices] if len(corrected_indices) > 1 else []
    )
    reference_texts = {group: INSTRUMENT_CONSTANT_REFERENCE_PHRASES[bool(is_corrected[group[0]])] for group in owners}
    possible_changes = tuple(
        InstrumentConstantChange(group, k, reference_texts[group]) for group in owners for k in range(unit.shape[1])
    )
    return instrument_constants_contradicting_expectation(
        adjustment, ExpectedInstrumentConstants(np.zeros(unit.size), covariance, possible_changes)
    )


def instrument_constants_contradicting_expectation(
    adjustment: Adjustment, expectation: ExpectedInstrumentConstants
) -> ContradictingInstrumentConstants:
    """Instrument constants that differ from `expectation`, with log evidences above `MIN_EFFECT_LOG_EVIDENCE`.

    The evidence of each is given the other selected constants. The constants are selected by forward selection with
    exchange, in which a selected constant has a prior variance of `CHANGED_INSTRUMENT_CONSTANT_VARIANCE`.
    The readings alone give the normal equations N x = b of the constants x. With the expectation x ~ N(m, V), the
    information on a change of constant k is (V + N^-1)^-1[k, k].
    """
    prior = adjustment.problem.prior.sigma
    unit = prior_sigmas(adjustment.recording, adjustment.construction)
    estimates, estimate_covariance = adjustment.state.instrument_parameters, adjustment.covariance_of_all_instruments
    likelihood = likelihood_information(estimates.ravel(), estimate_covariance, prior.ravel(), unit.ravel())
    score_vector, log_prior = (
        likelihood.information_vector - likelihood.information_matrix @ expectation.mean,
        log_prior_of_each_explanation("constant", len(expectation.possible_changes)),
    )
    change_directions = np.zeros((len(expectation.possible_changes), *unit.shape))
    for change_direction, change in zip(change_directions, expectation.possible_changes, strict=True):
        change_direction[list(change.instrument_indices), change.constant_index] = 1.0
    change_directions = change_directions.reshape(len(change_directions), unit.size)

    def log_evidences_given(other_changes: Collection[int]) -> Floats:
        """Log evidence (changes,) of each possible change, given the changes with the indices `other_changes`."""
        given_changes = change_directions[list(other_changes)]
        score, weight = change_score_and_information(
            likelihood.information_matrix,
            score_vector,
            expectation.covariance + CHANGED_INSTRUMENT_CONSTANT_VARIANCE * given_changes.T @ given_changes,
        )
        information_of_change, score_along = (
            np.einsum("hi,ij,hj->h", change_directions, weight, change_directions),
            change_directions @ score,
        )
        log_evidences = np.full(len(change_directions), -np.inf)
        for k in np.flatnonzero(
            (information_of_change > SQRT_MACHINE_EPSILON)
            & ~np.isin(np.arange(len(change_directions)), list(other_changes))
        ):
            change = expectation.possible_changes[k]
            log_evidences[k] = log_prior + _log_evidence_of_change(
                score_along[k] / information_of_change[k],
                1.0 / information_of_change[k] + change.added_variance_grid,
                change.log_variance_weights,
            )
        return log_evidences

    odds_by_change = forward_select(log_evidences_given, MIN_EFFECT_LOG_EVIDENCE)
    score, weight = change_score_and_information(likelihood.information_matrix, score_vector, expectation.covariance)
    information = change_directions @ weight @ change_directions.T
    contradictions: list[int] = []
    for k in sorted(
        (k for k in odds_by_change if odds_by_change[k][k] > MIN_EFFECT_LOG_EVIDENCE),
        key=lambda k: -odds_by_change[k][k],
    ):
        square = information[np.ix_([*contradictions, k], [*contradictions, k])]
        if np.linalg.eigvalsh(scale_to_unit_diagonal(square, np.diag(square))[0])[0] > NORMAL_EQUATIONS_TOLERANCE:
            contradictions.append(k)
    if not contradictions:
        return ContradictingInstrumentConstants()
    changed = [
        np.log(share)
        + log_marginal_likelihood(
            likelihood,
            expectation.mean,
            expectation.covariance + size**2 * change_directions[contradictions].T @ change_directions[contradictions],
        )
        for size, share in PRIOR_BY_RELATIVE_EFFECT_SIZE.items()
    ]
    unchanged = log_marginal_likelihood(likelihood, np.zeros(unit.size), np.diag((prior / unit).ravel() ** 2))
    joint_log_ratio = float(log_sum_exp(np.array(changed))) - unchanged
    covariance = np.linalg.inv(information[np.ix_(contradictions, contradictions)])
    gap, sigma = covariance @ change_directions[contradictions] @ score, np.sqrt(np.diag(covariance))
    units = [
        unit[expectation.possible_changes[k].instrument_indices[0], expectation.possible_changes[k].constant_index]
        for k in contradictions
    ]
    p_values = np.minimum(len(change_directions) * erfc(np.abs(gap) / sigma / np.sqrt(2.0)), 1.0)
    entries = (
        _instrument_constant_contradiction(
            adjustment, expectation.possible_changes, odds_by_change[k], k, *map(float, (g * u, s * u, c))
        )
        for k, g, s, c, u in zip(contradictions, gap, sigma, p_values, units, strict=True)
    )
    return ContradictingInstrumentConstants(tuple(entries), joint_log_ratio + log_prior * len(contradictions))


def _instrument_constant_contradiction(
    adjustment: Adjustment,
    constant_changes: Sequence[InstrumentConstantChange],
    log_evidences: Floats,
    change_index: int,
    difference: float,
    sigma: float,
    p_value: float,
) -> InstrumentConstantContradiction:
    """Contradiction for the change with the index `change_index`, with the alternatives to this change.

    `log_evidences` are the log evidences of all changes, `difference` and `sigma` the difference from the reference and
    its standard deviation [SI], and `p_value` its p-value.
    """
    change, parameters = constant_changes[change_index], adjustment.construction.parameters
    alternative_indices = [
        i for i, other in enumerate(constant_changes) if other.instrument_indices == change.instrument_indices
    ]
    share = normalised_probabilities(log_evidences[alternative_indices])
    return InstrumentConstantContradiction(
        instruments=tuple(adjustment.recording.instruments[i] for i in change.instrument_indices),
        parameter=parameters[change.constant_index],
        difference_from_reference=difference,
        sigma=sigma,
        log_evidence=float(log_evidences[change_index]),
        p_value=p_value,
        reference_text=change.reference_text,
        evidence_share_by_constant={
            parameters[constant_changes[alternative_indices[i]].constant_index]: float(share[i])
            for i in np.argsort(-share)
            if share[i] > MIN_REPORTED_PROBABILITY
        },
    )


def _log_evidence_of_change(
    difference: float, variances: Floats | float, log_variance_weights: Floats | float
) -> float:
    """Log evidence of a changed constant from its `difference`, averaged over s variances with their log weights."""
    variances, log_variance_weights = np.atleast_1d(variances), np.atleast_1d(log_variance_weights)
    log_unchanged = log_variance_weights - 0.5 * (difference**2 / variances + np.log(variances))
    log_changed = log_unchanged + log_evidence(((difference / variances) ** 2)[:, None], 1.0 / variances[:, None])
    return float(log_sum_exp(log_changed) - log_sum_exp(log_unchanged))


TRUE_TO_SAMPLE_VARIANCE_RATIO_GRID = np.geomspace(0.05, 1e4, 80)
"""Ratios of the true variance of an instrument constant between calibrations to that in a sample of calibrations."""
SAMPLE_VARIANCE_PRIOR_DOF = 4
"""Degrees of freedom that the sample variances of all instrument constants add to the sample variance of one constant
(Smyth 2004). Such standard deviations mostly agree within a factor of two."""


@dataclass(frozen=True)
class ExpectationFromEarlierCalibrations:
    """Expected instrument constants of a recording, from earlier calibrations."""

    earlier_calibration_prior: EarlierCalibrationPrior
    """Earlier calibrations of the same instruments."""
    expected_constants: ParameterPrior
    """Mean and covariance of the instrument constants [SI]; the covariance includes their scatter between
    calibrations."""
    manufacturer_specification: Floats
    """Specification of the manufacturer (I, p) [SI] of p constants of I instruments, the unit of their comparison."""

    @classmethod
    def from_calibrations(
        cls, calibrations: EarlierCalibrationPrior, recording: Recording, construction: GeometricErrorModel
    ) -> ExpectationFromEarlierCalibrations:
        """Expected instrument constants of a recording, from earlier calibrations.

        Raises RecordError for calibrations of other instruments or with another geometric error model.
        """
        names = recording.instruments
        if len(calibrations.instruments) < min(len(names), 2):
            raise RecordError(
                f"the earlier calibrations are those of one instrument, but the recording has {', '.join(names)}; give "
                "earlier calibrations of all these instruments"
            )
        nominal_prior = ParameterPrior.from_sigmas(prior_sigmas(recording, construction))
        return cls(
            calibrations, calibrations.replace_nominal_prior(nominal_prior, construction, names), nominal_prior.sigma
        )

    def find_contradicting_instrument_constants(self, adjustment: Adjustment) -> ContradictingInstrumentConstants:
        """Instrument constants that changed after the earlier calibrations, with sufficient log evidence."""
        parameters, unit = adjustment.construction.parameters, self.manufacturer_specification
        parameter_indices = [k for k, p in enumerate(parameters) if p.name in self.earlier_calibration_prior.parameters]
        names = [parameters[k].name for k in parameter_indices]
        covariance = [block / np.outer(u, u) for block, u in zip(self.expected_constants.covariance, unit, strict=True)]
        possible_changes: list[InstrumentConstantChange] = []
        for i, block in enumerate(covariance):
            spreads = zip(
                *self._additional_variances_and_log_weights(
                    block[np.ix_(parameter_indices, parameter_indices)], unit[i, parameter_indices], names
                ),
                strict=True,
            )
            possible_changes += [
                InstrumentConstantChange((i,), k, self._reference_phrase(parameters[k]), *s)
                for k, s in zip(parameter_indices, spreads, strict=True)
            ]
        expected_means = (self.expected_constants.mean / unit).ravel()
        return instrument_constants_contradicting_expectation(
            adjustment,
            ExpectedInstrumentConstants(expected_means, linalg.block_diag(*covariance), tuple(possible_changes)),
        )

    def _additional_variances_and_log_weights(
        self, expected_covariance: Floats, specification: Floats, constant_names: list[str]
    ) -> tuple[Floats, Floats]:
        """Possible additional variances (k, s) of k constants, s of each, and logs (k, s) of their prior weights.

        The sample variance of a few calibrations has a scaled chi-square distribution, with one degree of freedom less
        than the number of calibrations. The sample variances of the other constants add `SAMPLE_VARIANCE_PRIOR_DOF`
        degrees of freedom (Smyth, Statistical Applications in Genetics 3 (2004) 3). No standard deviation exceeds the
        specification of the manufacturer. `expected_covariance` (k, k) is the expected covariance, `specification` (k,)
        [SI] the specification, and `constant_names` are the names of the constants.
        """
        n_calibrations = self.earlier_calibration_prior.n_calibrations
        if n_calibrations == 1:
            return np.zeros((len(specification), 1)), np.zeros((len(specification), 1))
        spread = self._sigmas_between_calibrations(constant_names) ** 2 / specification**2
        precision = (
            np.diag(np.linalg.inv(expected_covariance - np.diag(spread))) - 1.0
        )  # variance of the mean, without the specification of the manufacturer
        variances = n_calibrations / np.maximum(precision, SQRT_MACHINE_EPSILON)
        usual_variance = variances + np.median(spread) - spread
        added_variance = np.minimum(
            np.outer(variances, TRUE_TO_SAMPLE_VARIANCE_RATIO_GRID - 1.0), np.maximum(1.0 - spread, 0.0)[:, None]
        )
        scaled_sum = (n_calibrations - 1 + SAMPLE_VARIANCE_PRIOR_DOF * usual_variance / variances)[:, None]
        weights = (
            -0.5 * (n_calibrations - 1 + SAMPLE_VARIANCE_PRIOR_DOF) * np.log(TRUE_TO_SAMPLE_VARIANCE_RATIO_GRID)
            - 0.5 * scaled_sum / TRUE_TO_SAMPLE_VARIANCE_RATIO_GRID
        )
        return np.maximum(added_variance * (1.0 + 1.0 / n_calibrations), -spread[:, None]), weights

    def _sigmas_between_calibrations(self, constant_names: Sequence[str]) -> Floats:
        """Standard deviations (k,) [SI] of k instrument constants between the earlier calibrations."""
        indices = [self.earlier_calibration_prior.parameters.index(name) for name in constant_names]
        return self.earlier_calibration_prior.between_calibration_sigma[indices]

    def _reference_phrase(self, parameter: Parameter) -> str:
        """Name, shown to users, of the earlier calibrations with which an instrument constant is compared."""
        n_calibrations = self.earlier_calibration_prior.n_calibrations
        if n_calibrations == 1:
            return "its calibration"
        spread = self._sigmas_between_calibrations([parameter.name])[0] / parameter.si_per_display_unit
        return f"its history ({n_calibrations} calibrations, spread {spread:.2g} {parameter.unit})"
