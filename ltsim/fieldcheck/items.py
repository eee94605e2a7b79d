"""What a check says of one thing that it looked at, and how the price of many looks is paid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scipy import special

Kind = Literal["two-face", "gross", "bump", "drift", "instrument-drift", "closure", "network", "level", "mistake"]


@dataclass(frozen=True)
class Item:
    """One thing that was looked at: whether it passes, in a sentence, with its chance over everything looked at.

    `p_value` is None where a limit was compared; `rows` are rows of the recording from 1, `between` the two times
    [s] that enclose an event.
    """

    station: str
    kind: Kind
    passed: bool
    sentence: str
    p_value: float | None = None
    targets: tuple[str, ...] = ()
    rows: tuple[int, ...] = ()
    between: tuple[float, float] | None = None


@dataclass(frozen=True)
class Family:
    """The tests of a recording: `adjusted` chances count all of them and every place that one looked at."""

    level: float
    tests: int

    @property
    def share(self) -> float:
        """Part of the level that one test has."""
        return self.level / self.tests

    def adjusted(self, p: float, looks: int = 1) -> float:
        """Chance of one such result or more among all that was looked at (Bonferroni)."""
        return min(1.0, p * looks * self.tests)


def two_sided(chi2: float, dof: int) -> tuple[float, bool]:
    """Chance of a chi-square so far out on either side, and whether it is too small."""
    low, high = float(special.chdtr(dof, chi2)), float(special.chdtrc(dof, chi2))
    return min(1.0, 2 * min(low, high)), low < high
