"""Estimated factor of a selected noise hypothesis, and sentence with the noise to declare in `setup.toml`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import CauseHypothesis, NoiseFactorChange
from ltsim.adjustment.stochastic_model import converged_variance_components, noise_declaration_texts
from ltsim.core.notation import names_text
from ltsim.recordings.recording import OBSERVABLES, SIGMA_COLUMNS
from ltsim.recordings.specification import noise_origin

DECLARE_NOISE_TEXT = "declare this noise in setup.toml, [instrument.noise]"
"""Advice on noise that differs from the declared noise, if its values for `[instrument.noise]` are unknown."""
NOISE_READING_TEXTS = {"noise": "the readings", "angles": "the azimuths and elevations"}
"""Texts for the readings whose noise may differ from the declared noise, for hypotheses on more than one observable."""


def estimated_noise_factor(fit: NetworkFit, hypothesis: CauseHypothesis) -> float:
    """Estimated factor of a selected hypothesis on the declared standard deviations (median over readings)."""
    assert isinstance(hypothesis.model_change, NoiseFactorChange)
    mask = hypothesis.model_change.reading_mask & fit.problem.is_used_reading
    return float(np.median(fit.problem.reading_sigmas[mask] / fit.fit_input.recording.reading_sigmas()[mask]))


def noise_sentence(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Sentence on a hypothesis on the noise, with the factor on the declared noise and the noise to declare."""
    place_text = ", ".join((*hypothesis.stations, *hypothesis.targets))
    readings_text = NOISE_READING_TEXTS.get(hypothesis.acts_on, f"the readings of the {hypothesis.acts_on}")
    place_phrase = f" {'from' if hypothesis.stations else 'to'} {place_text}" if place_text else ""
    cure = _noise_declaration(fit, hypothesis) if not place_text else "measure again, or correct the declared noise"
    factor = estimated_noise_factor(fit, hypothesis)
    origin = noise_origin(fit.fit_input.recording.notes)
    return f"The standard deviation of {readings_text}{place_phrase} is {factor:.2g} times the {origin} one: {cure}."


def _noise_declaration(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Advice to declare the estimated noise in `setup.toml`, as the end of a sentence.

    For a single instrument and a recording without columns of standard deviations it contains the values to declare.
    """
    assert isinstance(hypothesis.model_change, NoiseFactorChange)
    recording, mask = fit.fit_input.recording, hypothesis.model_change.reading_mask & fit.problem.is_used_reading
    if len(recording.instruments) > 1 or any(column in recording.covariates for column in SIGMA_COLUMNS):
        return DECLARE_NOISE_TEXT
    declared = replace(fit.problem, reading_sigmas=recording.reading_sigmas())
    factors = {c.observable: c.noise_factor for c in converged_variance_components(declared, fit.state)}
    settings = [
        setting
        for k, observable in enumerate(OBSERVABLES)
        if mask[:, k].any() and observable in factors
        for setting in noise_declaration_texts(recording, observable, factors[observable])
    ]
    return f"set {names_text(settings, len(settings))} in [instrument.noise]" if settings else DECLARE_NOISE_TEXT
