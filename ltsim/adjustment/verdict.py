"""Verdict on an adjustment: which test and which noise to trust, from the global test and the outlier tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment, FlaggedReading
from ltsim.adjustment.quality import adjustment_warnings
from ltsim.adjustment.significance import GLOBAL_TEST_LEVEL, MAX_SINGLE_ERROR_FRACTION, MIN_DOF_FOR_ESTIMATED_NOISE
from ltsim.adjustment.stochastic_model import converged_variance_components, noise_declaration_texts
from ltsim.core.notation import names_text
from ltsim.recordings.recording import OBSERVABLES, SIGMA_COLUMNS
from ltsim.recordings.specification import noise_origin


class VerdictCase(Enum):
    """Conclusion from the global test of an adjustment and the tests of its readings."""

    CLEAN = "clean"
    """Passed global test, without outliers among the readings."""
    SINGLE_ERRORS = "single errors"
    """Failed global test, which passes without a few outliers."""
    HIDDEN_ERRORS = "single errors hidden in the sum"
    """Passed global test, but outliers among the readings."""
    LARGER_NOISE = "larger noise"
    """Noise larger than declared, which was identified as the cause of the misfit."""
    UNEXPLAINED_MISFIT = "larger noise or a systematic effect"
    """Failed global test without an identified cause."""
    SMALLER_NOISE = "smaller noise"
    """Residuals smaller than the declared noise permits."""
    UNCHECKED = "nothing to test"
    """Network without redundancy."""
    IN_DOUBT = "in doubt"
    """Adjustment that passed its tests, but with warnings on its network."""


@dataclass(frozen=True)
class Verdict:
    """Verdict on an adjustment: conclusion from the tests, its reasons, and the noise to use."""

    case: VerdictCase
    """Conclusion from the global test and the tests of single readings."""
    sentence: str
    """Sentences with the verdict and its reasons, the most important first."""
    uses_estimated_noise: bool
    """True if standard deviations should be multiplied by the estimated sigma0."""


@dataclass(frozen=True)
class FitWithConstants:
    """Fit of the readings of an adjustment that also estimates the instrument constants."""

    chi2: float
    """Chi-square of the fit."""
    dof: int
    """Degrees of freedom of the fit."""
    outliers: tuple[FlaggedReading, ...] = ()
    """Outliers among the readings, by the w-test."""

    @classmethod
    def from_adjustment(cls, adjustment: Adjustment | None) -> FitWithConstants | None:
        """Fit from an adjustment that estimates the instrument constants; None without degrees of freedom."""
        if adjustment is None or adjustment.dof <= 0:
            return None
        return cls(adjustment.chi2, adjustment.dof, tuple(adjustment.flagged_readings()))

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight."""
        return float(np.sqrt(self.chi2 / self.dof))

    def explains_misfit(self, alpha: float) -> bool:
        """True if the fit passes the global test at the two-sided level `alpha`.

        The fit passes too if it scatters less than the noise permits.
        """
        return self.sigma0 <= _sigma0_limits(self.dof, alpha)[1]

    def sigma0_text(self, alpha: float) -> str:
        """Text on sigma0 with its expected range, for the two-sided level `alpha` of the global test."""
        low, high = _sigma0_limits(self.dof, alpha)
        return f"sigma0 is {self.sigma0:.3f} ({low:.3f} to {high:.3f} expected)"


def verdict_on(
    adjustment: Adjustment, alpha: float = GLOBAL_TEST_LEVEL, fit_with_constants: FitWithConstants | None = None
) -> Verdict:
    """Verdict on an adjustment from its tests and warnings; `alpha` is the two-sided level of the global test.

    `fit_with_constants` also estimates the instrument constants; None if there is no such fit.
    """
    judged = _verdict_from_tests(adjustment, alpha, fit_with_constants)
    open_ = adjustment_warnings(adjustment)
    if not open_:
        return judged
    sentence = " ".join(f"{doubt[0].upper()}{doubt[1:]}." for doubt in open_)
    case = VerdictCase.IN_DOUBT if judged.case is VerdictCase.CLEAN else judged.case
    return replace(judged, case=case, sentence=f"{sentence} {judged.sentence}")


def trusted_outliers(
    adjustment: Adjustment, alpha: float, fit_with_constants: FitWithConstants | None
) -> Sequence[FlaggedReading]:
    """Outliers among the readings in use, by the test that the verdict trusts.

    If `fit_with_constants` explains the residuals, these are its outliers: errors of the instrument constants, which
    large residuals can contain, are no errors of readings. `alpha` is the two-sided level of the global test.
    """
    if fit_with_constants is not None and fit_with_constants.explains_misfit(alpha):
        return fit_with_constants.outliers
    return adjustment.flagged_readings(uses_estimated_noise=verdict_on(adjustment, alpha).uses_estimated_noise)


def _verdict_from_tests(adjustment: Adjustment, alpha: float, fit_with_constants: FitWithConstants | None) -> Verdict:
    """Verdict on an adjustment from its tests, without the warnings on the network.

    `alpha` is the two-sided level of the global test. If this test fails but passes without the outliers, the cause is
    single errors; otherwise the cause is other noise or an error of the model. `fit_with_constants` also estimates the
    instrument constants.
    """
    dof, sigma0, chi2 = adjustment.dof, adjustment.sigma0, adjustment.chi2
    origin = noise_origin(adjustment.recording.notes)
    if dof <= 0:
        sentence = f"There is no redundancy: no test is possible, and the {origin} noise is used."
        return Verdict(VerdictCase.UNCHECKED, sentence, False)
    low, high = _sigma0_limits(dof, alpha)
    outliers, by_tau = adjustment.flagged_readings(), len(adjustment.flagged_readings(uses_estimated_noise=True))
    by_w, outlier_sentence = len(outliers), _outlier_sentence(len(outliers))
    phrase = f"sigma0 = {sigma0:.3f} ({dof} degrees of freedom, {low:.3f} to {high:.3f} expected)"
    if low <= sigma0 <= high and not by_w:
        return Verdict(VerdictCase.CLEAN, f"Noise and model agree with the readings: {phrase}, no outlier.", False)
    if low <= sigma0 <= high:
        sentence = (
            f"{outlier_sentence} Trust the test of single readings, although the global test passes: {phrase}. A few "
            "outliers hardly change a sum over many readings."
        )
        return Verdict(VerdictCase.HIDDEN_ERRORS, sentence, False)
    if sigma0 < low and dof < MIN_DOF_FOR_ESTIMATED_NOISE:
        sentence = (
            f"Trust the {origin} noise. The readings scatter less: {phrase}. With so few degrees of freedom no other "
            "noise can be estimated."
        )
        return Verdict(VerdictCase.SMALLER_NOISE, sentence, False)
    if sigma0 < low:
        sentence = (
            f"The {origin} noise is too large: {phrase}. {noise_declaration_advice(adjustment, alpha)} "
            f"Trust the estimated sigma0 and the tau-test. {_outlier_sentence(by_tau, ' in the tau-test')}"
        )
        return Verdict(VerdictCase.SMALLER_NOISE, sentence.rstrip(), True)
    flagged_sentence = _flagged_readings_sentence(by_w, by_tau, origin)
    if adjustment.noise_sentences:
        noise, constants = (
            " ".join(adjustment.noise_sentences),
            _sigma0_with_constants_sentence(fit_with_constants, alpha),
        )
        sentence = f"{noise} Until then trust the estimated sigma0: {phrase}. {constants}{flagged_sentence}"
        return Verdict(VerdictCase.LARGER_NOISE, sentence, True)
    chi2_rest = chi2 - sum(o.normalised_residual**2 for o in outliers)
    is_explained = dof > by_w and chi2_rest <= high**2 * (dof - by_w)
    if (
        by_w
        and is_explained
        and by_w <= max(1, MAX_SINGLE_ERROR_FRACTION * int(adjustment.problem.is_used_reading.sum()))
    ):
        because = "of this error, which is not in the model" if adjustment.cause_sentences else "of outliers"
        trust = "" if adjustment.cause_sentences else "Trust the test of single readings. "
        sentence = (
            f"{outlier_sentence} {trust}The global test fails only because {because}: {phrase}. The other readings "
            f"agree with the {origin} noise."
        )
        return Verdict(VerdictCase.SINGLE_ERRORS, sentence, False)
    if dof < MIN_DOF_FOR_ESTIMATED_NOISE:
        sentence = (
            f"The noise or the model is wrong. Trust the global test, which fails: {phrase}. With so few degrees of "
            "freedom neither the estimated sigma0 nor a test of single readings identifies the error."
        )
        return Verdict(VerdictCase.UNEXPLAINED_MISFIT, sentence, True)
    reasons = _rejection_reasons(adjustment, alpha, fit_with_constants)
    conclusion = f"Trust the global test, which fails, and the estimated sigma0: {phrase}."
    if fit_with_constants is not None:
        is_explained = fit_with_constants.explains_misfit(alpha)
        if is_explained:
            condition = " if the instrument constants are estimated"
            flagged_sentence = _outlier_sentence(len(fit_with_constants.outliers), condition)
        result = "has" if is_explained else "fails the global test:"
        conclusion = (
            f"This adjustment, which does not estimate the instrument constants, {result} {phrase}. The standard "
            "deviations of the adjustment are multiplied by sigma0."
        )
    sentence = f"{reasons} {conclusion} {flagged_sentence}{_noisy_targets_sentence(adjustment)}"
    return Verdict(VerdictCase.UNEXPLAINED_MISFIT, sentence, True)


def _sigma0_limits(dof: int, alpha: float) -> tuple[float, float]:
    """Lower and upper critical value of sigma0 with `dof` degrees of freedom, at the two-sided level `alpha`."""
    low, high = np.sqrt(2.0 * special.gammaincinv(0.5 * dof, [alpha / 2, 1 - alpha / 2]) / dof).tolist()
    return low, high


def _sigma0_with_constants_sentence(fit_with_constants: FitWithConstants | None, alpha: float) -> str:
    """Sentence, with a space at its end, on sigma0 of a fit with instrument constants; empty without such a fit.

    `alpha` is the two-sided level of the global test.
    """
    if fit_with_constants is None:
        return ""
    return f"If the instrument constants are estimated, {fit_with_constants.sigma0_text(alpha)}. "


def _rejection_reasons(adjustment: Adjustment, alpha: float, fit_with_constants: FitWithConstants | None) -> str:
    """Sentences on the possible reasons for a global test that failed at the two-sided level `alpha`.

    Errors of the instrument constants are a possible reason if they are neither corrected nor estimated. A fit that
    estimates them, `fit_with_constants`, shows if they are the reason.
    """
    origin = noise_origin(adjustment.recording.notes)
    if fit_with_constants is not None:
        expected = fit_with_constants.sigma0_text(alpha)
        if fit_with_constants.explains_misfit(alpha):
            is_smaller = fit_with_constants.sigma0 < _sigma0_limits(fit_with_constants.dof, alpha)[0]
            smaller = f", so that the noise is smaller than {origin}" if is_smaller else ""
            return f"The instrument constants explain the residuals: if they are estimated, {expected}{smaller}."
        return (
            f"The noise is larger than {origin}, or a systematic effect is missing from the model. Errors of the "
            f"instrument constants are not the only reason. If these constants are estimated, {expected}."
        )
    if adjustment.construction.n_parameters or adjustment.recording.is_corrected:
        return f"The noise is larger than {origin}, or a systematic effect is missing from the model."
    return (
        f"The readings contain errors of the instrument constants, the noise is larger than {origin}, or a "
        "systematic effect is missing from the model."
    )


def noise_declaration_advice(adjustment: Adjustment, alpha: float = GLOBAL_TEST_LEVEL) -> str:
    """Advice on the noise to declare if readings scatter less or more than declared; otherwise empty.

    Each observable is tested separately with the noise of the others as the readings show it: the square of its noise
    factor times its redundancy is compared with chi-square, at the two-sided significance level `alpha`.
    """
    recording, advice, by_row = adjustment.recording, list[str](), list[str]()
    components = {c.observable: c for c in converged_variance_components(adjustment.problem, adjustment.state)}
    for k, observable in enumerate(OBSERVABLES):
        component, use = components.get(observable), adjustment.problem.is_used_reading[:, k]
        if component is None or component.redundancy < MIN_DOF_FOR_ESTIMATED_NOISE:
            continue
        factor, half_dof = component.noise_factor, 0.5 * component.redundancy
        tails = (f(half_dof, half_dof * factor**2) for f in (special.gammainc, special.gammaincc))
        if min(tails) > alpha / 2:
            continue
        if np.isfinite(recording.covariates.get(SIGMA_COLUMNS[k], np.full(len(recording), np.nan))[use]).all():
            by_row.append(f"the sigmas of {observable} by {factor:.3g}")
        elif len(recording.instruments) == 1:
            advice += noise_declaration_texts(recording, observable, factor)
        else:
            by_row.append(f"the noise of {observable} by {factor:.3g}")
    sentences = [f"Set {names_text(advice, len(advice))} in [instrument.noise]." if advice else ""]
    sentences.append(f"Multiply {names_text(by_row, len(by_row))}." if by_row else "")
    return " ".join(filter(None, sentences))


def _noisy_targets_sentence(adjustment: Adjustment) -> str:
    """Sentence, after a space, on noisy targets (with readings that scatter far more than others); or an empty text."""
    named, scatter, rest = adjustment.noisy_targets_and_scatter
    if not len(named):
        return ""
    names = ", ".join(adjustment.recording.targets[t] for t in named)
    return (
        f" Readings to {names} scatter {scatter:.2g} times the {noise_origin(adjustment.recording.notes)} noise, other "
        f"readings {rest:.2g} times."
    )


def _outlier_sentence(n_readings: int, condition: str = "") -> str:
    """Sentence on the number of outliers, `n_readings`; `condition` names the test, such as " in the tau-test"."""
    if not n_readings:
        return f"No reading is an outlier{condition}."
    count = "One reading is an outlier" if n_readings == 1 else f"{n_readings} readings are outliers"
    return f"{count}{condition}."


def _flagged_readings_sentence(n_flagged: int, n_outliers: int, origin: str) -> str:
    """Sentence on the number of readings flagged by the w-test, and of outliers in a test with the estimated noise.

    `origin` says where the noise of the w-test comes from, as an adjective such as "declared".
    """
    if not n_flagged:
        return "The w-test flags no reading."
    flagged = "one reading" if n_flagged == 1 else f"{n_flagged} readings"
    outliers = f"{n_outliers} are outliers" if n_outliers > 1 else f"{'one' if n_outliers else 'none'} is an outlier"
    return f"The w-test with the {origin} noise flags {flagged}, of which {outliers} with the estimated noise."
