"""Entries of result files for linear combinations of parameters.

The recording either does not determine a reported combination, or determines it far better than its parameters.
"""

from pydantic import Field

from ltsim.core.results import Column, Table, text_columns
from ltsim.recordings.result_file import Entry, Finite, NonZero, OptionalFloat


class CombinationTerms(Entry):
    """Linear combination of parameters, with the coefficient of each parameter."""

    combination: dict[str, Finite]
    """Coefficient by the name of the parameter."""

    @property
    def text(self) -> str:
        """Text of the combination, such as `a + 0.7 b`, in one line."""
        return " ".join(f"{weight:+.2f} {name}" for name, weight in self.combination.items())


class UndeterminedEntry(CombinationTerms):
    """Combination of parameters, in prior standard deviations, that the recording does not determine."""

    gain: OptionalFloat = None
    """Fraction by which the readings reduce the prior variance of the combination."""
    cure: str = ""
    """Sentence on the measurement that would determine the combination, and on its benefit."""
    measurement: str = ""
    """Instruction for the measurement that would determine the combination; empty if no tested measurement does."""


class DeterminedEntry(CombinationTerms):
    """Combination of parameters that the recording determines far better than the parameters themselves."""

    combination: dict[str, NonZero] = Field(min_length=1)
    """Coefficient by the name of the parameter. The first parameter has the coefficient 1 and gives the combination
    its name."""
    value: Finite
    """Estimate of the combination."""
    sigma: OptionalFloat = None
    """Standard deviation of the estimate."""
    unit: str = ""
    """Unit of value and standard deviation."""
    instrument: str = ""
    """Name of the instrument; empty for a single unnamed instrument."""


UNDETERMINED_TABLE = Table(
    "undetermined.csv",
    "combinations of parameters that are not determined",
    (
        *text_columns(
            combination="coefficients, in units of the prior sigma",
            determined_by="measurement that determines the combination",
        ),
        Column("information_percent", "fraction by which the readings reduce the prior variance", display_format=".1f"),
    ),
)
