"""A task file (ltsim-tasks/1): what is measured, how well it has to be known, and what the readings do not tell."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from ltsim.core.errors import as_setup_error
from ltsim.recordings.air import Air
from ltsim.recordings.settings import checked, load_settings
from ltsim.recordings.setup import Finite, NonNegative, Positive, TomlSection, Vector

FORMAT = "ltsim-tasks/1"
Kind = Literal[
    "point",
    "rod",
    "distance",
    "angle",
    "line",
    "plane",
    "circle",
    "sphere",
    "cylinder",
    "transformation",
    "pose",
    "deviation",
]
Names = Annotated[tuple[str, ...], Field(min_length=1)]
Level = Annotated[float, Field(gt=0.5, lt=1.0)]
POINTS = {"point": 1, "rod": 2, "distance": 2, "angle": 3}
"""Targets of the kinds that take a fixed number."""


class Tolerance(TomlSection):
    """Limits of one result of a task, in its unit; either may be left open."""

    lower: Finite | None = None
    """Lower limit."""
    upper: Finite | None = None
    """Upper limit."""

    @model_validator(mode="after")
    def _positive_width(self) -> Self:
        if self.lower is None and self.upper is None:
            raise ValueError("it should give lower, upper or both")
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise ValueError("it should give a lower limit below the upper one")
        return self


class Task(TomlSection):
    """A task: a measurand and its targets.

    `point` gives coordinates, `rod` those of a hidden point `beyond_mm` past the second of two reflectors on a rod,
    `distance` takes two targets, `angle` three (the vertex in the middle). Features are fitted by least squares.
    `transformation` moves `nominal_mm` onto the targets by a best fit, `pose` gives the same as the place and the turn
    of a part; `deviation` compares each target with its nominal point after that fit, or as they are with
    ``fit = false``.
    """

    name: str
    """Name of the task in the results."""
    kind: Kind
    """Kind of measurand that is computed from the targets."""
    targets: Names
    """Names, in the order that the kind asks for."""
    nominal_mm: dict[str, Vector] = Field(default_factory=dict)
    """Nominal points by target, for `transformation`, `pose` and `deviation`."""
    fit: bool = True
    """Fit the targets to their nominal points first."""
    scale: bool = False
    """The fit has a scale."""
    beyond_mm: Finite = 0.0
    """Distance from the second reflector of a rod to its tip."""
    radius_offset_mm: Finite = 0.0
    """Added to fitted radii: the SMR's own."""
    tolerances: dict[str, Tolerance] = Field(default_factory=dict)
    """Limits by result, tables `[task.tolerances.RESULT]`."""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        wanted = POINTS.get(self.kind)
        if wanted is not None and len(self.targets) != wanted:
            raise ValueError(f"it should name {wanted} targets for a {self.kind}")
        if len(set(self.targets)) < len(self.targets):
            raise ValueError("it should name each target once")
        if (self.kind == "rod") != (self.beyond_mm != 0):
            raise ValueError("it should give beyond_mm, not 0, for a rod and for nothing else")
        if self.kind in ("transformation", "pose", "deviation"):
            missing = [name for name in self.targets if name not in self.nominal_mm]
            if missing:
                raise ValueError(f"it should give nominal_mm of {missing[0]}")
        return self


class TypeB(TomlSection):
    """An effect that the readings do not show, with the distribution of its size.

    `sizes` holds a standard deviation (`normal`) or a half-width (the others) for parameters of the effect, in their
    units; without them each has its plausible size as standard deviation. `shared` says how far one draw reaches:
    one for all pointings, or one a station, an instrument, a target or a pointing.
    """

    effect: str
    """Name of the effect as `ltsim effects` lists it."""
    distribution: Literal["normal", "rectangular", "triangular", "arcsine"] = "normal"
    """Distribution of the sizes."""
    sizes: dict[str, Positive] = Field(default_factory=dict)
    """Standard deviation or half-width by parameter, in display units."""
    shared: Literal["all", "station", "instrument", "target", "pointing"] = "all"
    """Reach of one draw: all pointings, or those of a station, an instrument, a target, or a single pointing."""
    stations: tuple[str, ...] = ()
    """Names of the stations where it acts; empty for all."""
    targets: tuple[str, ...] = ()
    """Names of the targets where it acts; empty for all."""
    shape: dict[str, Finite | str | tuple[Finite, ...]] = Field(default_factory=dict)
    """Constants by name, as in a scenario."""
    name: str = ""
    """Name in the budget; the effect's name where it is not given."""


class PartExpansion(TomlSection):
    """The part's own expansion: results hold at `reference_c`, the points were measured at `measured_c`."""

    expansion_per_k: Finite
    """Coefficient of thermal expansion."""
    sigma_expansion_per_k: NonNegative = 0.0
    """Standard deviation of the coefficient of expansion."""
    measured_c: Finite = 20.0
    """Temperature of the part at the measurement."""
    sigma_temperature_k: NonNegative = 0.0
    """Standard deviation of the temperature."""
    reference_c: Finite = 20.0
    """Temperature at which results hold."""


class MonteCarlo(TomlSection):
    """Propagation of distributions (JCGM 101), until every figure is stable to `digits` of its uncertainty."""

    coverage: Level = 0.95
    """Coverage probability of the intervals."""
    digits: Annotated[int, Field(ge=1, le=2)] = 2
    """Significant digits of the standard uncertainty that have to be stable."""
    most_trials: Annotated[int, Field(ge=10_000, le=5_000_000)] = 100_000
    """Largest number of trials, at which it stops in any case."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Root of the random draws."""


class Decision(TomlSection):
    """Decision on conformity (JCGM 106): `risk` is the probability of a wrong acceptance that is allowed."""

    rule: Literal["guarded", "simple"] = "guarded"
    """Decision rule: limits reduced by a guard band for the risk, or the limits themselves."""
    risk: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.05
    """Probability of a wrong acceptance that is allowed."""


class Tasks(TomlSection):
    """The whole file."""

    format: Literal["ltsim-tasks/1"] = "ltsim-tasks/1"
    """Format and version of this file."""
    title: str = ""
    """Free text."""
    source: str
    """A recording or a scenario, seen from this file."""
    calibrate: bool = True
    """Estimate the instrument's parameters too."""
    datum: tuple[str, ...] = ()
    """Targets that define the datum by inner constraints."""
    robust: bool = False
    """Leave out readings that do not belong."""
    task: Annotated[tuple[Task, ...], Field(min_length=1)]
    """Tables `[[task]]`."""
    type_b: tuple[TypeB, ...] = ()
    """Effects that the readings do not show (type B), tables `[[type_b]]`."""
    air: Air | None = None
    """Uncertainty of the air, where ranges are long, less the effects in `type_b`; default that of the recording."""
    growth: PartExpansion | None = None
    """Expansion of the part."""
    monte_carlo: MonteCarlo = MonteCarlo()
    """Settings of the propagation of distributions."""
    decision: Decision = Decision()
    """Rule of the decision on conformity."""

    @model_validator(mode="after")
    def _names_once(self) -> Self:
        names = [task.name for task in self.task]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"it should not name two tasks '{twice}'")
        return self


def load_tasks(path: Path) -> Tasks:
    """The tasks of a file; raises SetupError."""
    return load_settings(path, Tasks, "task file")


def tasks_from(data: Mapping[str, Any], file: object) -> Tasks:
    """Check the tables of a task file; `file` is named in errors (raises SetupError)."""
    with as_setup_error():
        return checked(data, Tasks, "task file", file)
