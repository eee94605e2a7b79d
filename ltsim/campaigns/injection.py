"""Detectability of an effect in a recording: the effect is injected, and the changed recording is diagnosed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.requested_effects import RequestedEffect
from ltsim.calibration.verbs import parse_requested_effect
from ltsim.core.arguments import check_argument_bounds
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.verbs import diagnose
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.effect import Blunder, Effect, NoiseEffect
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.effects.verbs import SizedEffect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings.exchange import RecordingSource, load_recording
from ltsim.simulation.injector import DetectionCurve, InjectedEffect, InjectionTruth, Injector, RecordingWithInjection

LAW_AMPLITUDE_NAME = "size"
"""Name of the amplitude of a law (effect described by a formula), as in ``RESPONSE ~ REGRESSOR:size=VALUE``. The
amplitude is the rms change of the response, in um or urad."""
DEFAULT_NONCENTRALITIES = (25.0, 50.0, 100.0, 200.0, 400.0, 800.0)
"""Default noncentralities (expected decrease of chi-square) of the injections for a detection curve."""
MAX_EFFECT_DRAWS = 25
"""Largest number of attempts to draw the unspecified values of an effect. If no attempt changes the residuals, an error
is raised."""
MIN_LOCATION_OVERLAP = 0.5
"""Smallest overlap of a reported group of stations or targets with the group of the injected effect, for a correct
location. The overlap is the number of members in both groups divided by the number in at least one (Jaccard index)."""


def inject(
    recording: RecordingSource,
    *causes: str | CandidateEffect | SizedEffect,
    noncentrality: float | None = None,
    seed: int = 0,
) -> RecordingWithInjection:
    """Recording into which effects are injected: they change the readings by their exact model, and nothing else.

    Parameters
    ----------
    recording : Recording, str or Path
        Measured or simulated recording.
    *causes : str or Effect
        Effects that ltsim models, ``EFFECT`` or ``EFFECT:WHERE,...``, or formulas ``RESPONSE ~ REGRESSOR`` as for
        `calibrate`. WHERE lists stations, targets, and values of shape parameters and other parameters in their units
        (``range-step:S3,range-step=30``). A formula has ``size=VALUE`` (rms change of RESPONSE, um or urad).
        Everything that is not given is drawn. Vectors are in the axes of the recording's adjustment.
    noncentrality : float, optional
        Noncentrality to which each effect is scaled: weighted sum of squares of the part of the effect that remains in
        the residuals. By default the effects are not scaled.
    seed : int
        Seed of all random draws.

    Returns
    -------
    recording : Recording
    truth : InjectionTruth
        Injected effects with their true parameters, which no calibration or diagnosis reads.

    Raises
    ------
    ModelError
        If an effect does not exist, or changes no residual.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> made, truth = lt.inject(recording, "range-step:S3", noncentrality=100, seed=1)
    >>> round(truth.injected_effects[0].noncentrality)
    100
    """
    check_argument_bounds(seed=seed, noncentrality=noncentrality, required_argument="seed")
    if not causes:
        raise ModelError(
            "no effect is given: name an effect (ltsim effects lists them) or a formula such as 'azimuth ~ time'"
        )
    for cause in causes:
        if isinstance(cause, (list, tuple)):
            raise ModelError("effects are separate arguments, not a list: inject(recording, first, second)")
    changed_recording = load_recording(recording)
    injector, injected = (
        Injector(
            changed_recording,
            ResidualSpace.from_adjustment(adjust(changed_recording, declared_construction(changed_recording))),
        ),
        [],
    )
    for number, cause in enumerate(causes):
        rng = random_stream(seed, "inject", number)
        drawn, values = _scaled_effect(injector, cause, noncentrality, rng)
        changed_recording, entry = injector.inject(drawn, values, _name_of_effect(cause), rng)
        injector = injector.with_recording(changed_recording)
        injected.append(entry)
    return RecordingWithInjection(changed_recording, InjectionTruth(seed, tuple(injected)))


def injection_curve(
    recording: RecordingSource,
    cause: str | CandidateEffect | SizedEffect,
    *,
    strengths: Sequence[float] = DEFAULT_NONCENTRALITIES,
    injections: int = 5,
    seed: int = 0,
) -> DetectionCurve:
    """Detection curve: fraction of injections of an effect that the diagnosis detects, locates and names, by strength.

    Parameters
    ----------
    recording : Recording, str or Path
        Measured or simulated recording.
    cause : str
        Effect or formula, as for `inject`. Values that are not given, such as the station, are drawn for each
        injection.
    strengths : sequence of float
        Noncentralities of the injections.
    injections : int
        Number of injections at each noncentrality; after each injection the recording is diagnosed.
    seed : int
        Seed of all random draws.

    Returns
    -------
    DetectionCurve
        Fractions of detected, located and named injections. A finding that the diagnosis reports in the recording
        without an injection does not count.

    Raises
    ------
    ModelError
        If the effect does not exist or changes no residual, or without a positive strength and an injection.
    """
    check_argument_bounds(injections=injections, seed=seed, required_argument="injections seed")
    if not len(strengths) or any(not s > 0.0 for s in strengths):
        raise ModelError("a detection curve needs at least one noncentrality (strengths), each of them above 0")
    original = load_recording(recording)
    background = diagnose(original, held_out=False)
    curve_rows = []
    for strength in strengths:
        draws = [inject(original, cause, noncentrality=strength, seed=seed + k) for k in range(injections)]
        judged = [
            compare_with_injection(diagnose(made, held_out=False), truth.injected_effects[0], background)
            for made, truth in draws
        ]
        curve_rows.append(_detection_curve_row(strength, [truth.injected_effects[0] for _, truth in draws], judged))
    effect_names = tuple(sorted({f.effect for f in background.findings}))
    return DetectionCurve(_name_of_effect(cause), effect_names, tuple(curve_rows))


def _name_of_effect(cause: str | CandidateEffect | SizedEffect) -> str:
    """Name of an effect object; a text is returned unchanged."""
    return cause if isinstance(cause, str) else cause.effect.name if isinstance(cause, SizedEffect) else cause.name


def compare_with_injection(
    diagnosis: Diagnosis, cause: InjectedEffect, background_diagnosis: Diagnosis
) -> dict[str, bool]:
    """Success of a diagnosis for an injected effect, as flags `detected`, `placed` (located), `named` and `right`.

    A finding does not count if `background_diagnosis`, the diagnosis of the recording without injection, also reports
    it. The flag `right` is true if the first new finding has the name and the stations and targets of the effect.
    """
    background_keys = {_finding_key(f) for f in background_diagnosis.findings}
    new_findings = [f for f in diagnosis.findings if _finding_key(f) not in background_keys]
    located_findings = [f for f in new_findings if _has_same_location(cause.effect, f)]
    name = cause.effect.name
    identified_findings = [f for f in located_findings if name in (f.effect, *(e.effect for e in f.equivalents))]
    first_finding = new_findings[:1]
    return {
        "detections": bool(new_findings),
        "placed": bool(located_findings),
        "named": bool(identified_findings),
        "right": bool(first_finding) and first_finding[0].effect == name and first_finding[0] in located_findings,
    }


def _finding_key(finding: Any) -> tuple[Any, ...]:
    """Effect, stations, targets and observables of a finding, as a key by which findings are compared."""
    scope = finding.where
    return finding.effect, tuple(scope.stations), tuple(scope.targets), tuple(scope.observables)


def _has_same_location(cause: CandidateEffect, finding: Any) -> bool:
    """True if a finding has the stations and targets of the injected effect `cause`, and one of its observables."""
    scope = finding.where
    place_pairs = [(set(cause.stations), set(scope.stations)), (set(cause.targets), set(scope.targets))]
    overlaps = all(a == b if len(a) < 2 else len(a & b) >= MIN_LOCATION_OVERLAP * len(a | b) for a, b in place_pairs)
    observables = set(scope.observables) or set(cause.observables)
    return overlaps and bool(observables & set(cause.observables))


def _detection_curve_row(
    noncentrality: float, injected_effects: Sequence[InjectedEffect], comparisons: Sequence[Mapping[str, bool]]
) -> dict[str, float]:
    """Row of a detection curve at one noncentrality: counts, and confidence intervals of the fractions.

    `comparisons` are the results of `compare_with_injection` for each effect in `injected_effects`.
    """
    row: dict[str, float] = {"noncentrality": noncentrality, "injections": len(comparisons)}
    row["largest_um"] = float(np.mean([c.largest_changes["distance_um"] for c in injected_effects]))
    row["largest_urad"] = float(
        np.mean([max(c.largest_changes["azimuth_urad"], c.largest_changes["elevation_urad"]) for c in injected_effects])
    )
    for key in ("detections", "placed", "named", "right"):
        row[key] = sum(outcome[key] for outcome in comparisons)
        if key != "right":
            interval = binomtest(int(row[key]), len(comparisons)).proportion_ci(method="wilson")
            row[f"{key}_low"], row[f"{key}_high"] = interval.low, interval.high
    return row


def _scaled_effect(
    injector: Injector,
    cause: str | CandidateEffect | SizedEffect,
    noncentrality: float | None,
    random_generator: np.random.Generator,
) -> tuple[CandidateEffect, Floats]:
    """Effect with its stations and targets, and its parameter values (parameters,) [SI], scaled to a noncentrality.

    `noncentrality` is None if the effect is not scaled. If the drawn effect changes no residual, its unspecified values
    are drawn again.
    """
    for attempt in range(MAX_EFFECT_DRAWS):
        drawn, values = _drawn_effect(injector, cause, random_generator)
        if noncentrality is None:
            break
        try:
            return drawn, injector.scale_to_noncentrality(drawn, values, noncentrality)
        except ModelError:
            if attempt == MAX_EFFECT_DRAWS - 1:
                raise
    return drawn, values


def _drawn_effect(
    injector: Injector, cause: str | CandidateEffect | SizedEffect, random_generator: np.random.Generator
) -> tuple[CandidateEffect, Floats]:
    """Effect with its stations and targets, and its parameter values (parameters,) [SI]; unspecified ones are drawn."""
    if isinstance(cause, str):
        text, sizes = _split_parameter_values(cause)
        requested_effect = parse_requested_effect(text, injector.recording)
    else:
        given, sizes = (
            (cause.effect, dict(cause.parameter_values_in_display_units))
            if isinstance(cause, SizedEffect)
            else (cause, {})
        )
        requested_effect = (
            parse_requested_effect(given, injector.recording) if isinstance(given, Effect) else RequestedEffect(given)
        )
    effect, sightings = requested_effect.effect, injector.residual_space.sightings
    candidates: Sequence[CandidateEffect] = [effect]
    if isinstance(effect, Blunder) and not effect.place_text:
        candidates = type(effect).possible_blunders(sightings)
    elif isinstance(effect, Effect) and not isinstance(effect, Blunder):
        candidates = requested_effect.candidates(injector.residual_space.adjustment)
    if not candidates:
        raise ModelError(f"{effect.name} cannot act on any reading of this recording")
    chosen = candidates[int(random_generator.integers(len(candidates)))]
    return chosen, _parameter_values(chosen, sizes, injector, random_generator)


def _split_parameter_values(effect_specification: str) -> tuple[str, dict[str, float]]:
    """Specification of an effect without its parameter values, as text, and the parameter values by name."""
    name, _, rest = effect_specification.partition(":")
    names = {LAW_AMPLITUDE_NAME} if "~" in name else {p.name for p in find_effect(name.strip()).parameters}
    items, sizes = [part.strip() for part in rest.split(",") if part.strip()], {}
    for item in items:
        key, _, value = item.partition("=")
        if key.strip() in names:
            try:
                sizes[key.strip()] = float(value)
            except ValueError:
                raise ModelError(f"'{effect_specification}': {key.strip()} is {value!r}, expected a number") from None
    words = [item for item in items if item.partition("=")[0].strip() not in sizes]
    return f"{name}:{','.join(words)}" if words else name, sizes


def _parameter_values(
    cause: CandidateEffect, given_values: Mapping[str, float], injector: Injector, random_generator: np.random.Generator
) -> Floats:
    """Parameter values (parameters,) [SI] of an effect: `given_values` by name, all others drawn from their priors."""
    drawn_values = np.array([p.prior_sigma for p in cause.parameters]) * random_generator.standard_normal(
        len(cause.parameters)
    )
    positive = [p.is_nonnegative or isinstance(cause, NoiseEffect) for p in cause.parameters]
    drawn_values = np.where(positive, np.abs(drawn_values), drawn_values)
    if isinstance(cause, Blunder):
        return np.ones(len(cause.parameters))
    if not given_values:
        return drawn_values
    if isinstance(cause, EmpiricalLaw):
        law_changes = (
            cause.columns(injector.residual_space.sightings) @ drawn_values.reshape(-1, cause.regressor.n_columns).T
        )
        rms = float(
            np.sqrt(
                np.mean(
                    np.sum(law_changes[cause.pointing_indicator(injector.residual_space.sightings) > 0] ** 2, axis=1)
                )
            )
        )
        return drawn_values * given_values[LAW_AMPLITUDE_NAME] * cause.parameters[0].si_per_display_unit / rms
    return np.array([given_values.get(p.name, 0.0) * p.si_per_display_unit for p in cause.parameters])
