"""Texts for sections and figures: counts, durations, sentences, the verdict of the global test."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from itertools import takewhile
from typing import TYPE_CHECKING

from ltsim.core.notation import count_text as count_text, names_text as names_text
from ltsim.core.probability import TWO_SIDED_GLOBAL_TEST_LEVEL, p_value_relation_text, two_sided_p_value

if TYPE_CHECKING:
    from ltsim.campaigns.schema import ScenarioSettings
    from ltsim.simulation.scenario import Scenario

CORRECTIONS_NOTE = "Corrections, true value minus reading, +- one sigma."
"""Note on tables and texts with parameters of instruments, whose sign is that of a correction."""
QUALITY_MEASURE_BY_GOAL = {
    "instrument": ("instrument: sigma / prior sigma", 1.0),
    "targets": ("targets: weighted point error [um]", 1e6),
    "diagnosis": ("effects: detectable / plausible size", 1.0),
}
"""Quality measure of each goal of a plan: name with unit, and factor from SI to the displayed unit."""


def is_determined_by_readings(sigma: float | None, prior_sigma: float | None) -> bool:
    """True if a parameter has no prior, or if the readings at least halve its prior variance (sigma < 0.7 prior)."""
    return prior_sigma is None or (sigma or 0.0) < 0.7 * prior_sigma


def duration_text(seconds: float) -> str:
    """Text of a time span of `seconds` [s], in s, min or h."""
    minutes = seconds / 60.0
    if minutes < 1:
        return f"{seconds:.0f} s"
    if minutes < 120:
        return f"{minutes:.0f} min"
    hours, rest = divmod(round(minutes), 60)
    return f"{hours} h {rest:02d} min"


def tracker_preset_names_text(scenarios: Iterable[Scenario | ScenarioSettings]) -> str:
    """Names of the presets of all trackers in scenarios, each once, as text such as `preset leica-at901`."""
    trackers = [t for s in scenarios for t in (*s.instruments.values(),) or (s.instrument,)]
    return ", ".join(f"preset {name}" for name in dict.fromkeys(t.preset for t in trackers))


def natural_sort_key(name: str) -> list[tuple[int, str]]:
    """Sort key of a `name` in natural order: T9 before T10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", name) if part]


def capitalised_sentence(text: str) -> str:
    """Text as a sentence, with a capital letter and a full stop."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}." if text else ""


def typographic_text(text: str) -> str:
    """Text with typographic signs: plus-minus, minus, micro, chi, a dash for a missing value."""
    with_signs = re.sub(
        r"\bu(m|rad)\b",
        "µ\\1",
        text.replace("+-", "±")
        .replace("chi2", "χ²")
        .replace("um2/m3", "µm²/m³")
        .replace("[deg]", "[°]")
        .replace(" %", "\u00a0%"),
    )
    return "–" if with_signs == "-" else re.sub(r"(?<![\w.,)\]-])-(?=\.?\d)", "−", with_signs)


def global_test_verdict(chi2: float, dof: int, p_value: float | None) -> tuple[bool, str]:
    """Verdict of the two-sided global test: True if readings and model agree, and a text without full stop.

    `chi2` is chi-square with `dof` degrees of freedom, and `p_value` the probability of a larger chi-square.
    """
    if dof <= 0 or p_value is None or not math.isfinite(p_value):
        return True, "the model cannot be tested, because there is no redundancy"
    agrees, statistic_text = (
        two_sided_p_value(p_value) >= TWO_SIDED_GLOBAL_TEST_LEVEL,
        f"(chi2 {chi2:.0f} for {dof}, two-sided {p_value_relation_text(two_sided_p_value(p_value))})",
    )
    if not agrees and p_value > 0.5:
        return False, f"the scatter of the readings is smaller than the declared noise {statistic_text}"
    verb = "agree" if agrees else "do not agree"
    return agrees, f"the readings {verb} with the model and the declared noise {statistic_text}"


def labels_without_common_prefix(labels: Sequence[str]) -> tuple[str, ...]:
    """Labels without the words with which all labels begin; unchanged if a label would then be empty."""
    if len(set(labels)) < 2:
        return tuple(labels)
    common_letters = takewhile(lambda letters: len(set(letters)) == 1, zip(*labels, strict=False))
    common_prefix = "".join(letters[0] for letters in common_letters)
    begin = 1 + max(common_prefix.rfind(separator) for separator in "_- .")
    short = tuple(label[begin:] for label in labels)
    return short if all(short) else tuple(labels)
