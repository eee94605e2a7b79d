"""How numbers of statistics are put into words."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence


def p_text(p: float | None) -> str:
    """A p-value as a person writes it."""
    if p is None or not math.isfinite(p):
        return "–"
    if p < 1e-4:
        return "< 0.0001"
    return f"{p:.4f}" if p < 0.01 else f"{p:.2f}"


def duration(seconds: float) -> str:
    """A time span."""
    minutes = seconds / 60.0
    if minutes < 1:
        return f"{seconds:.0f} s"
    if minutes < 120:
        return f"{minutes:.0f} min"
    hours, rest = divmod(round(minutes), 60)
    return f"{hours} h {rest:02d} min"


def count(number: int, one: str, many: str = "") -> str:
    """`1 station`, `5 stations`."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def natural(name: str) -> list[tuple[int, str]]:
    """Sort key by which T9 comes before T10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", name) if part]


def listing(words: Sequence[str], most: int = 6) -> str:
    """Words with commas, the last few counted."""
    if len(words) <= most:
        return ", ".join(words)
    return ", ".join(words[:most]) + f" and {len(words) - most} more"


def typeset(sentence: str) -> str:
    """A sentence of a result file with the signs of print: plus-minus, micro."""
    return re.sub(r"\bu(m|rad)\b", "µ\\1", sentence.replace("+-", "±"))


def agreement(chi2: float, dof: int, p: float | None) -> tuple[bool, str]:
    """Whether readings agree with the model at the 1 % level, and the words for it."""
    if dof <= 0 or p is None or not math.isfinite(p):
        return True, "there is no redundancy to test the model with"
    agrees = p >= 0.01
    verb = "agree" if agrees else "do not agree"
    return agrees, f"the readings {verb} with the model and the stated noise (χ² {chi2:.0f} for {dof}, {p_is(p)})"


def p_is(p: float) -> str:
    """`p = 0.02` or `p < 0.0001`."""
    text = p_text(p)
    return f"p {text}" if text.startswith("<") else f"p = {text}"
