"""Combinations of parameters in result files: not determined, or determined far better than their members."""

from pydantic import Field

from ltsim.core.results import Column, Table, texts
from ltsim.recordings.result_file import Entry, Finite, NonZero, OptionalFloat


class Terms(Entry):
    """A combination of parameters."""

    combination: dict[str, Finite]
    """Coefficient of each parameter."""

    @property
    def terms(self) -> str:
        """The combination in a line."""
        return " ".join(f"{weight:+.2f} {name}" for name, weight in self.combination.items())


class Combination(Terms):
    """A combination of parameters, in prior sigmas, that is not determined."""

    gain: OptionalFloat = None
    """Share of the prior variance that the readings removed."""
    cure: str = ""
    """The measurement that would determine it."""


class DeterminedEntry(Terms):
    """A combination of parameters that the recording determines far better than each of them."""

    combination: dict[str, NonZero] = Field(min_length=1)
    """Coefficient of each parameter; the first one names the combination and gives its scale."""
    value: Finite
    """Size of the effect's parameter."""
    sigma: OptionalFloat = None
    """Standard deviation of the size."""
    unit: str = ""
    """Unit of value and standard deviation."""
    instrument: str = ""
    """Name of the instrument, where there are several."""


UNDETERMINED = Table(
    "undetermined.csv",
    "combinations of parameters that are not determined",
    (
        *texts(combination="coefficients, in units of the prior sigma", determined_by="the measurement that would"),
        Column("information_percent", "share of the prior variance that the readings removed", shown=".1f"),
    ),
)
