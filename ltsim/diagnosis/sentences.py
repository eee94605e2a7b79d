"""Sentences of a diagnosis for reports and for the terminal."""

from collections.abc import Sequence

import numpy as np

from ltsim.adjustment.significance import MIN_CERTAIN_ERROR_SIGMAS
from ltsim.core.notation import MAX_LISTED_ITEMS, names_text, with_sigma
from ltsim.diagnosis.detectability import MAX_DETECTABLE_TO_PLAUSIBLE_SIZE_RATIO
from ltsim.diagnosis.prior import MAX_MODEL_EFFECTS
from ltsim.diagnosis.schema import Finding, FindingScope, InstrumentEntry, Misfit, ParameterEstimate
from ltsim.physics.effects import catalogue_entry, effect_title, find_effect, parameter_text
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.effects.target_moved import TargetMoved, moved_coordinates_sentence
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.text_form import law_suffix

MIN_PROBABILITY_OF_PROBABLE_CAUSE = 0.5
"""Smallest probability of a cause that is reported as probable: one that is more probable than not."""
CONTRADICTED_MODEL_SENTENCE = (
    " Held-out readings are predicted worse with the effects in the model than without them. These effects are "
    "therefore improbable. Look for single wrong pointings and for repeats that share errors."
)
"""Sentence for users if held-out readings contradict the effects in the model."""
COVARIATE_TEXTS = {
    "approach": "the motion of the head before the pointing",
    "place": "the position in the hall",
    "incidence": "the direction from which the reflector is seen",
}
"""Phrases, shown to users, in place of the names of covariates that need an explanation."""


def estimates_phrase(parameters: Sequence[ParameterEstimate]) -> str:
    """Phrase with the most significant estimates; estimates below their standard deviation are left out."""
    significant = [p for p in parameters if abs(p.value) > p.sigma]
    largest = sorted(significant, key=lambda p: -abs(p.value) / max(p.sigma, 1e-300))[:MAX_LISTED_ITEMS]
    chosen = [p for p in parameters if p in largest]
    return ", ".join(_estimate_text(p) for p in chosen)


def effect_title_in_sentence(name: str) -> str:
    """Title of an effect within a sentence, from its name in the catalogue or `unknown`."""
    return "an effect outside the catalogue" if name == "unknown" else effect_title(name)


def finding_title(finding: Finding) -> str:
    """Title of a finding within a sentence: its effect, or the reference value that is wrong."""
    if finding.concerns_reference_value:
        return f"an error of the {finding.carrier}"
    return effect_title_in_sentence(finding.effect)


def _estimate_text(parameter: ParameterEstimate) -> str:
    """Text of an estimate with sigma and unit; for an added variance, the factor on the declared standard deviation."""
    name, value, sigma = parameter.name, parameter.value, parameter.sigma
    if name.startswith("noise-"):
        factor = float(np.sqrt(max(1.0 + value, 0.0)))
        return f"{name[6:]}s scatter {with_sigma(factor, 0.5 * sigma / max(factor, 0.1))} times as much as declared"
    return f"{parameter_text(name)} {with_sigma(value, sigma)} {parameter.unit}".strip()


def place_text(scope: FindingScope) -> str:
    """Text of stations, targets, instruments and observables of a finding, such as ``at station S3 in distance``."""
    kinds = ("at station", scope.stations), ("of instrument", scope.instruments), ("at target", scope.targets)
    place_texts = [f"{kind}{'s' if len(names) > 1 else ''} {names_text(names)}" for kind, names in kinds if names]
    if scope.observables:
        place_texts.append(f"in {names_text(scope.observables)}")
    return " ".join(place_texts) or "in the whole recording"


def percent_text(probability: float) -> str:
    """Text of a probability in percent, from ``< 1 %`` to ``> 99 %``."""
    if probability > 0.99:
        return "> 99 %"
    return "< 1 %" if probability < 0.01 else f"{100 * probability:.0f} %"


def catalogue_effect_sentence(
    effect_name: str,
    scope: FindingScope,
    parameters: Sequence[ParameterEstimate],
    probability: float,
    *,
    p_same_scope: float | None = None,
) -> str:
    """Sentences on a finding that is a catalogue effect: its size, place and usual cause, and two probabilities.

    `probability` is the probability of this effect, and `p_same_scope` the probability of any effect with the same
    scope (observables, place, covariates).
    """
    entry = catalogue_entry(find_effect(effect_name))
    place_name = place_text(scope).removeprefix("at ").removeprefix("in the ")
    lower_title = f"{entry.title[0].lower()}{entry.title[1:]}"
    sizes_text = estimates_phrase(parameters)
    if max(probability, p_same_scope or 0.0) < MIN_PROBABILITY_OF_PROBABLE_CAUSE:
        size_text = f" ({sizes_text})" if sizes_text else ""
        return (
            f"An unidentified systematic effect is present ({place_name}). "
            f"The most probable cause is {lower_title}{size_text}, with a probability of {percent_text(probability)}."
        )
    place_phrase = place_text(scope.model_copy(update={"observables": ()}))
    located = (
        ""
        if p_same_scope is None
        else f"An effect acts {place_phrase} with a probability of {percent_text(p_same_scope)}, whatever its cause. "
    )
    cause = f"This cause ({entry.cause_description}) has a probability of {percent_text(probability)}."
    title = entry.title if probability >= MIN_PROBABILITY_OF_PROBABLE_CAUSE else f"Perhaps {lower_title}"
    coordinates = f" {moved_coordinates_sentence(scope.targets)}" if effect_name == TargetMoved.name else ""
    return f"{title} ({place_name}){f': {sizes_text}' if sizes_text else ''}. {located}{cause}{coordinates}"


def law_sentence(
    scope: FindingScope, parameters: Sequence[ParameterEstimate], p_same_scope: float, law_text: str
) -> str:
    """Sentences on an empirical law outside the catalogue: changed quantity, function, place, size, probability.

    An empirical law describes an error as a function of covariates. `law_text` is the description of the law, and
    `p_same_scope` the probability of any effect with the same scope (observables, place, covariates).
    """
    sizes_text = estimates_phrase(parameters)
    size_phrase = f" ({sizes_text})" if sizes_text else ""
    place_phrase = _place_suffix(scope.model_copy(update={"observables": ()}))
    response, verb, regressor = law_text.partition(" follows " if " follows " in law_text else " differs")
    if p_same_scope < MIN_PROBABILITY_OF_PROBABLE_CAUSE:
        return (
            f"An effect outside the catalogue is present{_place_suffix(scope)}. "
            "The readings do not determine its form. "
            f"One of several possible forms is that the {response}{place_phrase}{verb}{regressor}{size_phrase}, "
            f"with a probability of {percent_text(p_same_scope)}."
        )
    return (
        f"The {response}{place_phrase}{verb}{regressor}{size_phrase}. "
        "The catalogue does not contain this effect. "
        f"An effect acts on these readings with a probability of {percent_text(p_same_scope)}, whatever its form."
    )


def unknown_noise_sentence(scope: FindingScope, noise_text: str) -> str:
    """Sentences on noise that differs from the declared noise in a way outside the catalogue: place and covariates.

    `noise_text` is the description of this noise.
    """
    covariates = names_text([COVARIATE_TEXTS.get(name, name) for name in scope.covariates])
    dependence = f" The noise depends on {covariates}." if covariates else ""
    present = f"The noise differs from the declared noise{_place_suffix(scope)}, and no catalogue effect describes it."
    return f"{present}{dependence} The most probable description is {noise_text}."


def _place_suffix(scope: FindingScope) -> str:
    """Text of the scope of a finding (`place_text`) with a leading blank; empty for the whole recording."""
    confined = scope.stations or scope.targets or scope.observables or scope.instruments
    return f" {place_text(scope)}" if confined else ""


def significant_instrument_constant_texts(instruments: Sequence[InstrumentEntry]) -> list[str]:
    """Texts of the significant instrument constants of all instruments, the most significant first.

    If only a combination of constants is determined, it has the name of its first constant. The value then includes the
    other constants, which the readings do not separate from the first.
    """
    ranked: list[tuple[float, str]] = []
    for entry in instruments:
        joined = {name for combination in entry.determined for name in combination.combination}
        entries = [(p.name, "", p.value, p.sigma, p.unit) for p in entry.parameters if p.name not in joined]
        for combination in entry.determined:
            name, weight = next(iter(combination.combination.items()))
            sigma = (combination.sigma or 0.0) / abs(weight)
            used = ", with the constants that the readings do not separate from it,"
            entries.append((name, used, combination.value / weight, sigma, combination.unit))
        of = entry.name or "the instrument"
        for name, used, value, sigma, unit in entries:
            plain = f"{parameter_text(name)}{used} of {of}: {with_sigma(value, sigma)} {unit}"
            ranked.append((abs(value) / max(sigma, 1e-300), plain))
    ranked.sort(key=lambda combination: -combination[0])
    return [words for times, words in ranked if times > MIN_CERTAIN_ERROR_SIGMAS][:MAX_MODEL_EFFECTS]


REPLACED_TIME_UNITS_WITHOUT_CLOCK = {"s": ("rows", 1.0), "min": ("rows", 60.0), "h": ("rows", 3600.0)}
"""Replacement of each unit of time, for a recording without a clock: unit ``rows`` and a factor on the value. One row
of the recording then stands for one second."""


def estimate_without_clock(parameter: ParameterEstimate) -> ParameterEstimate:
    """Estimate for a recording without a clock, in which its unit of time is replaced by numbers of rows."""
    per, _, rate = parameter.unit.partition("/")
    if rate in REPLACED_TIME_UNITS_WITHOUT_CLOCK:
        factor, unit = 1.0 / REPLACED_TIME_UNITS_WITHOUT_CLOCK[rate][1], f"{per}/row"
    elif parameter.unit in REPLACED_TIME_UNITS_WITHOUT_CLOCK:
        unit, factor = REPLACED_TIME_UNITS_WITHOUT_CLOCK[parameter.unit]
    else:
        return parameter
    value, sigma = factor * parameter.value, factor * parameter.sigma
    return ParameterEstimate(name=parameter.name, value=value, sigma=sigma, unit=unit)


def diagnosis_summary(
    verdict: str,
    findings: Sequence[Finding],
    p_value: float,
    misfit_before: Misfit,
    misfit_after: Misfit,
    *,
    noise_origin: str = "declared",
    n_withheld: int = 0,
    is_contradicted: bool = False,
) -> str:
    """Summary of a diagnosis in a few sentences.

    `verdict` is `consistent` or `mismatch`, and `p_value` the p-value of the global test. `misfit_before` and
    `misfit_after` are the misfits without and with the findings in the model. `noise_origin` is `declared` or
    `assumed`. `n_withheld` is the number of effects in the model that are not reported. `is_contradicted` is true if
    held-out readings contradict the effects in the model.
    """
    if verdict == "consistent" and not misfit_before.dof:
        return "The recording cannot be tested: there is no redundancy. Measure targets repeatedly."
    if verdict == "consistent":
        return (
            f"The recording agrees with the model and the {noise_origin} noise "
            f"(chi-square {misfit_before.chi2:.0f} for {misfit_before.dof} degrees of freedom). "
            f"A recording without errors shows at least this misfit with a probability of {100 * p_value:.0f} %."
        )
    if not findings:
        return (
            f"The recording does not agree with the model and the {noise_origin} noise "
            f"(chi-square {misfit_before.chi2:.0f} for {misfit_before.dof} degrees of freedom), "
            "but no cause is probable."
        )
    first_finding = findings[0]
    suffix = f" Further findings: {' '.join(f.sentence for f in findings[1:])}" if len(findings) > 1 else ""
    others = [effect_title_in_sentence(e.effect) for e in first_finding.equivalents]
    open_ = f" This recording cannot exclude another cause: {' or '.join(others)}." if others else ""
    further = "1 further effect is" if n_withheld == 1 else f"{n_withheld} further effects are"
    unreported_text = f" {further} in the model but not reported (small or uncertain)." if n_withheld else ""
    return (
        first_finding.sentence
        + open_
        + suffix
        + unreported_text
        + _held_out_sentence(misfit_before.held_out_rms, misfit_after.held_out_rms)
        + (CONTRADICTED_MODEL_SENTENCE if is_contradicted else "")
    )


def _held_out_sentence(error_before: float | None, error_after: float | None) -> str:
    """Sentence on the prediction error of held-out readings without (before) and with (after) the findings.

    The sentence is empty if both errors are equal or missing.
    """
    if error_before is None or error_after is None or error_before == error_after:
        return ""
    before_text, after_text = f"{error_before:.2f}", f"{error_after:.2f}"
    subject = "the prediction of readings that the fit has not used"
    if before_text == after_text:
        return f" The findings do not change {subject}: its error is {after_text} times the noise (rms)."
    verb = "improve" if error_after < error_before else "worsen"
    change = f"{'falls' if error_after < error_before else 'rises'} from {before_text} to {after_text}"
    return f" The findings {verb} {subject}: its error {change} times the noise (rms; noise alone gives 1)."


def law_text(law: EmpiricalLaw, regressor_phrase: str) -> str:
    """Description of an empirical law, such as ``distance correction follows cos(3 azimuth)``.

    `regressor_phrase` is the text of the function of covariates that the law follows, such as ``cos(3 azimuth)``.
    """
    phrase = f"{law.response.name} correction" if law.response.changed_part == "reading" else law.response.name
    suffix = law_suffix(law)
    return (
        f"{phrase} differs{suffix}"
        if law.regressor.kind == "constant"
        else f"{phrase} follows {regressor_phrase}{suffix}"
    )


def is_implausible_size(effect: CandidateEffect, estimates: Sequence[ParameterEstimate]) -> bool:
    """True if any size is much larger than plausible, or negative for a parameter that must be positive."""
    parameter_scales = zip(effect.parameters, effect.plausible_sizes.tolist(), strict=True)
    matches = [(e, p, size) for p, size in parameter_scales for e in estimates if e.name == p.name]
    is_large = any(
        abs(e.value) - 2 * e.sigma > MAX_DETECTABLE_TO_PLAUSIBLE_SIZE_RATIO * size / p.si_per_display_unit
        for e, p, size in matches
    )
    return is_large or any(p.is_nonnegative and e.value + 2 * e.sigma < 0.0 for e, p, _ in matches)
