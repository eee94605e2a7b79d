"""Findings on changes of the noise for the report, each with place, sizes, probability and sentence."""

import numpy as np

from ltsim.adjustment.significance import MIN_SIGNIFICANT_SIGMAS
from ltsim.core.notation import number_text, with_sigma
from ltsim.diagnosis.global_test import GlobalTestResult
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.diagnosis.schema import Finding, FindingEvidence, ParameterEstimate
from ltsim.diagnosis.scopes import effect_scope
from ltsim.diagnosis.sentences import catalogue_effect_sentence, unknown_noise_sentence
from ltsim.physics.laws.centring import CentringVariance
from ltsim.physics.laws.text_form import covariate_value_text, region_text
from ltsim.physics.laws.variance import VarianceFunction
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

MAX_REPORTED_NOISE_SIZES = 12
"""Largest number of targets, set-ups or readings whose noise a finding reports separately."""


def noise_finding(
    hypothesis: NoiseHypothesis, sightings: Sightings, global_test: GlobalTestResult, *, has_clock: bool = True
) -> Finding:
    """Finding that reports a change of the noise, limited to the observables in which the change is significant."""
    effect = hypothesis.effect
    scope = effect_scope(effect, _observables_with_changed_noise(hypothesis, sightings))
    size_estimates = zip(effect.parameters, hypothesis.sizes, hypothesis.size_sigmas, strict=True)
    estimates = [ParameterEstimate.from_si(*estimate) for estimate in size_estimates if np.isfinite(estimate[2])]
    sentence, further_values = "", dict[str, object]()
    if isinstance(effect, VarianceFunction):
        further_values = {"formula": effect.text, "carrier": effect.response_text, "driver": effect.regressor_text}
        most = ""
        if effect.group_kind:
            estimates = sorted(estimates, key=lambda e: -e.value)[:MAX_REPORTED_NOISE_SIZES]
            sure = [e for e in estimates if e.value > MIN_SIGNIFICANT_SIGMAS * e.sigma] or estimates
            worst = {e.name.partition(" at ")[2]: number_text(np.sqrt(1.0 + e.value), 2) for e in reversed(sure)}
            names = [f"{name} ({times})" for name, times in reversed(worst.items())][:2]
            most = f", most at {' and '.join(names)}, as a factor on the declared standard deviation"
        if effect.covariate_band:
            ends = [covariate_value_text(effect.covariates[0], x, has_clock=has_clock) for x in effect.covariate_band]
            most = f", from {', '.join(f'{low} to {high}' for low, high in zip(ends[::2], ends[1::2], strict=True))}"
        if effect.region is not None:
            most += f", {region_text(effect.region)}"
            estimates += [
                ParameterEstimate(name=f"centre-{axis}", value=value, sigma=effect.region.width, unit="m")
                for axis, value in zip(effect.region.bounded_axes, effect.region.centre, strict=True)
            ]
        sentence = unknown_noise_sentence(scope, effect.text + most)
        if isinstance(effect, CentringVariance):
            sentence = effect.sentence(with_sigma(estimates[0].value, estimates[0].sigma, estimates[0].unit))
    return Finding(
        effect=effect.name,
        known=not isinstance(effect, VarianceFunction),
        where=scope,
        parameters=tuple(estimates),
        evidence=FindingEvidence(
            chi2_drop=hypothesis.chi2_drop,
            parameters=len(estimates),
            p_value=global_test.p_value_of(hypothesis.log_evidence),
            probability=hypothesis.probability,
        ),
        sentence=sentence or catalogue_effect_sentence(effect.name, scope, estimates, hypothesis.probability),
        equivalents=hypothesis.equivalents,
    ).with_values(**{name: value for name, value in further_values.items() if value})


def _observables_with_changed_noise(hypothesis: NoiseHypothesis, sightings: Sightings) -> tuple[str, ...]:
    """Observables whose noise is significantly larger than declared, or smaller if the largest change is a decrease."""
    plausible_sizes = hypothesis.effect.plausible_sizes
    sizes_in_units = np.array(hypothesis.sizes) / plausible_sizes
    signed_sizes = (
        sizes_in_units * np.sign(sizes_in_units[np.argmax(np.abs(sizes_in_units))])
        > MIN_SIGNIFICANT_SIGMAS * np.array(hypothesis.size_sigmas) / plausible_sizes
    )
    unit_variance = np.ones((len(sightings), len(OBSERVABLES)))
    is_changed = (
        hypothesis.effect.variance(sightings, unit_variance, np.where(signed_sizes, plausible_sizes, 0.0))
        != unit_variance
    ).any(axis=0)
    return tuple(name for name, act in zip(OBSERVABLES, is_changed, strict=True) if act)
