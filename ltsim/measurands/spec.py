"""Content of a task file (ltsim-tasks/1): measurands, tolerances, and errors that are not visible in the readings."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from ltsim.core.errors import reraise_as_input_error
from ltsim.core.limits import MAX_ADDITIONAL_EFFECTS
from ltsim.recordings.air import AirUncertainty
from ltsim.recordings.keys import DistinctValues
from ltsim.recordings.settings import load_settings, validate_settings
from ltsim.recordings.setup import Finite, NonNegative, Positive, TomlSection, Vector

TASKS_FORMAT = "ltsim-tasks/1"
"""Format and version of a task file."""
TaskKind = Literal[
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
"""Kind of measurand of a task."""
NonEmptyNames = Annotated[tuple[str, ...], Field(min_length=1)]
"""Tuple of at least one name."""
CoverageProbability = Annotated[float, Field(gt=0.5, lt=1.0)]
"""Coverage probability, above 0.5 and below 1."""
N_TARGETS_BY_KIND = {"point": 1, "rod": 2, "distance": 2, "angle": 3}
"""Number of targets of a task, by kind, for the kinds of task that need a fixed number."""


class ToleranceLimits(TomlSection):
    """Tolerance limits of one result of a task, in the unit of the result; one limit may be missing."""

    lower: Finite | None = None
    """Lower tolerance limit, in the unit of the result; none if missing."""
    upper: Finite | None = None
    """Upper tolerance limit, in the unit of the result; none if missing."""

    @model_validator(mode="after")
    def _check_limit_order(self) -> Self:
        if self.lower is None and self.upper is None:
            raise ValueError("a tolerance should have lower, upper or both")
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise ValueError("lower should be below upper")
        return self


class Task(TomlSection):
    """Task: a measurand and its targets.

    `point` gives the coordinates of a target, `rod` those of a hidden point at the tip of a rod with two reflectors.
    `distance` takes two targets, `angle` three, with the vertex as second. Features are fitted by least squares.
    `transformation` and `pose` align `nominal_mm` to the targets by least squares; the results of `pose` are position
    and rotation of a part. `deviation` compares each target with its nominal point, after this alignment or (``align =
    false``) without it.
    """

    name: str
    """Name of the task in the results."""
    kind: TaskKind
    """Kind of measurand that is computed from the targets."""
    targets: NonEmptyNames
    """Names of the targets, in the order that the kind requires."""
    nominal_mm: dict[str, Vector] = Field(default_factory=dict)
    """Nominal coordinates [mm] of each target, by name, for `transformation`, `pose` and `deviation`."""
    align: bool = True
    """True if nominal points are aligned to the targets before deviations are computed."""
    align_with_scale: bool = False
    """True if the alignment of nominal points to targets also estimates a scale."""
    tip_distance_mm: Finite = 0.0
    """Distance [mm] from the second reflector of a rod to the tip of the rod."""
    radius_offset_mm: Finite = 0.0
    """Length [mm] that is added to the fitted radius of a circle, sphere or cylinder, such as the SMR radius."""
    tolerances: dict[str, ToleranceLimits] = Field(default_factory=dict)
    """Tolerance limits of each result by name, in tables `[task.tolerances.RESULT]`."""

    @model_validator(mode="after")
    def _check_targets(self) -> Self:
        n_required = N_TARGETS_BY_KIND.get(self.kind)
        if n_required is not None and len(self.targets) != n_required:
            raise ValueError(f"targets should be {n_required} names for kind = '{self.kind}'")
        if len(set(self.targets)) < len(self.targets):
            raise ValueError("targets should contain each name once")
        if (self.kind == "rod") != (self.tip_distance_mm != 0):
            raise ValueError("tip_distance_mm should be given (not 0) for kind = 'rod', and for no other kind")
        if self.kind in ("transformation", "pose", "deviation"):
            missing = [name for name in self.targets if name not in self.nominal_mm]
            if missing:
                raise ValueError(f"nominal_mm should contain the coordinates of {missing[0]}")
        return self


class TypeBEffect(TomlSection):
    """Effect that is not visible in the readings, with the distribution of its parameters (type B uncertainty).

    A parameter of the effect without an entry in `sizes` has the plausible size that `ltsim effects` lists as standard
    deviation.
    """

    effect: str
    """Name of the effect, as listed by `ltsim effects`."""
    distribution: Literal["normal", "rectangular", "triangular", "arcsine"] = "normal"
    """Distribution of the parameters of the effect."""
    sizes: dict[str, Positive] = Field(default_factory=dict)
    """Standard deviation (half-width, if the distribution is not normal) of each parameter of the effect, by name, in
    the units that `ltsim effects` lists."""
    draw_shared_by: Literal["all", "station", "instrument", "target", "pointing"] = "all"
    """Pointings that share one random draw of the parameters: all, those of one station, instrument or target, or each
    pointing alone."""
    stations: DistinctValues[str] = ()
    """Names of the stations where the effect acts; empty for all."""
    targets: DistinctValues[str] = ()
    """Names of the targets where the effect acts; empty for all."""
    shape: dict[str, Finite | str | tuple[Finite, ...]] = Field(default_factory=dict)
    """Shape parameters of the effect (period, time constant, onset time) by name, in the units that `ltsim effects`
    lists."""
    name: str = ""
    """Name of this source of uncertainty in the budget; default the name of the effect."""


class PartExpansion(TomlSection):
    """Thermal expansion of the measured part, from the temperature `reference_c` to its temperature `measured_c`."""

    expansion_per_k: Finite
    """Coefficient of thermal expansion of the part [1/K]."""
    sigma_expansion_per_k: NonNegative = 0.0
    """Standard deviation of the coefficient of thermal expansion [1/K]."""
    measured_c: Finite = 20.0
    """Temperature of the part during the measurement [deg C]."""
    sigma_temperature_k: NonNegative = 0.0
    """Standard deviation of the temperature of the part [K]."""
    reference_c: Finite = 20.0
    """Reference temperature [deg C], to which the results are converted."""


class MonteCarloSettings(TomlSection):
    """Settings of the Monte Carlo simulation (JCGM 101), which ends when all results are stable to `digits` digits."""

    coverage_probability: CoverageProbability = 0.95
    """Coverage probability of the intervals."""
    digits: Annotated[int, Field(ge=1, le=2)] = 2
    """Number of significant digits of the standard uncertainty to which the results must be stable."""
    max_trials: Annotated[int, Field(ge=10_000, le=5_000_000)] = 100_000
    """Largest number of Monte Carlo trials."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the random draws."""


class DecisionRule(TomlSection):
    """Rule for the decision on conformity with a tolerance (JCGM 106)."""

    rule: Literal["guarded", "simple"] = "guarded"
    """Rule for the acceptance limits: tolerance limits reduced by a guard band (`guarded`), or the tolerance limits
    themselves (`simple`)."""
    consumer_risk: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.05
    """Permitted probability that an accepted result does not conform; it determines the guard band."""


class Tasks(TomlSection):
    """Content of a task file: tasks, and options for the evaluation of their uncertainty."""

    format: Literal["ltsim-tasks/1"] = "ltsim-tasks/1"
    """Format and version of this file."""
    title: str = ""
    """Title of the tasks, free text."""
    source: str
    """Path of the recording or scenario, relative to the task file."""
    calibrate: bool = True
    """True if the instrument parameters are estimated together with the network."""
    datum: DistinctValues[str] = ()
    """Names of the targets that define the datum by inner constraints; empty for the datum of `ltsim adjust`."""
    robust: bool = False
    """True if outliers among the readings are excluded."""
    task: Annotated[tuple[Task, ...], Field(min_length=1)]
    """Tasks, in tables `[[task]]`."""
    type_b: Annotated[tuple[TypeBEffect, ...], Field(max_length=MAX_ADDITIONAL_EFFECTS)] = ()
    """Effects that are not visible in the readings (type B uncertainty), in tables `[[type_b]]`."""
    air: AirUncertainty | None = None
    """Uncertainty of the air, which matters for long ranges, without the properties for which `type_b` has an effect;
    default the table `[air]` of the recording."""
    part_expansion: PartExpansion | None = None
    """Thermal expansion of the part between the reference temperature and its temperature in the measurement."""
    monte_carlo: MonteCarloSettings = MonteCarloSettings()
    """Settings of the Monte Carlo simulation (JCGM 101)."""
    decision: DecisionRule = DecisionRule()
    """Rule for the decision on conformity with a tolerance."""

    @model_validator(mode="after")
    def _check_unique_names(self) -> Self:
        names = [task.name for task in self.task]
        twice = next((name for name, count in Counter(names).items() if count > 1), None)
        if twice is not None:
            raise ValueError(f"two tasks have the name '{twice}'; give each task a different name")
        return self


def load_tasks(path: Path) -> Tasks:
    """Tasks read from a task file; raises InputError."""
    return load_settings(path, Tasks, "task file")


def validate_tasks(tables: Mapping[str, Any], file: object) -> Tasks:
    """Tasks from the tables of a task file, which are checked; raises InputError, which names `file`."""
    with reraise_as_input_error():
        return validate_settings(tables, Tasks, "task file", file)
