"""The question that a finding leaves open, and the measurement that answers it."""

from collections.abc import Iterable, Sequence

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.next_measurement import deciding, explanation, space_of
from ltsim.core.errors import ModelError
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.effect import NoiseEffect
from ltsim.physics.effects.signature import Signature


def separating_measurement(
    adjustment: Adjustment, effect: str, equivalents: Iterable[str], beside: Sequence[Signature]
) -> str:
    """A sentence: which further measurement would tell an effect from its equivalents; empty where that is no question.

    Parameters
    ----------
    beside : sequence of Signature
        The other findings.
    """
    names = _comparable(effect, equivalents)
    if not names:
        return ""
    space = space_of(adjustment, beside)
    try:
        explanations = [explanation(space, name) for name in names]
    except ModelError:  # One of them is all absorbed by the others.
        return ""
    return deciding(adjustment, explanations, beside, first_is_enough=True).advice


def open_question(diagnosis: Diagnosis) -> tuple[tuple[str, ...], tuple[Signature, ...]]:
    """The explanations between which a diagnosis leaves its first open finding, and the effects found beside it."""
    for finding in diagnosis.findings:
        names = _comparable(finding.effect, [other.effect for other in finding.equivalents]) if finding.known else ()
        if names:
            return names, tuple(e for e in diagnosis.adjusted.effects if e.name != finding.effect)
    return (), ()


def _comparable(effect: str, equivalents: Iterable[str]) -> tuple[str, ...]:
    """An effect and those of its equivalents that shift readings; none where nothing is left to compare."""
    others = [name for name in equivalents if name != "unknown" and _shifts(name)]
    return (effect, *others) if others and _shifts(effect) else ()


def _shifts(name: str) -> bool:
    return not issubclass(find_effect(name), NoiseEffect)
