"""Result of `uncertainty`: content of `uncertainty.json`, and tables."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field
from scipy import special

from ltsim.adjustment.identification import CauseTest
from ltsim.adjustment.identification.recommendations import corrected_faults
from ltsim.core.arrays import Floats
from ltsim.core.notation import with_expanded_uncertainty
from ltsim.core.results import Column, Table, number_columns, text_columns
from ltsim.measurands.spec import DecisionRule, ToleranceLimits
from ltsim.recordings.result_file import Entry, OptionalFloat, ResultFile

RESULTS_TABLE = Table(
    "uncertainty.csv",
    "results of the tasks",
    (
        *text_columns(task="name of the task", result="name of the result", unit="unit of all numbers in the row"),
        Column("value", "estimate of the result", csv_format=".9g", uncertainty_column="U"),
        Column("u", "standard uncertainty", csv_format=".9g", display_format=".2g"),
        Column("U", "expanded uncertainty for the coverage probability", csv_format=".9g", uncertainty_column="U"),
        Column("mc_u", "standard uncertainty by Monte Carlo", csv_format=".9g", display_format=".2g"),
        Column("mc_low", "lower limit of the interval by Monte Carlo", csv_format=".9g", uncertainty_column="U"),
        Column("mc_high", "upper limit of the interval by Monte Carlo", csv_format=".9g", uncertainty_column="U"),
        Column("agrees", "True if the interval by propagation and the one by Monte Carlo agree", "flag"),
        *text_columns(
            judgement="accepted, rejected or undecided; empty without a tolerance",
            largest_source="largest source of uncertainty, and its fraction of the variance",
        ),
    ),
)
"""Table uncertainty.csv: results of the tasks with their uncertainty."""
BUDGET_TABLE = Table(
    "budget.csv",
    "contributions of the sources to the uncertainty of each result",
    (
        *text_columns(task="name of the task", result="name of the result", source="source of uncertainty"),
        *text_columns(type="A, B, or not included: an error that changes no reading", unit="unit of u"),
        *number_columns(".6g", share="fraction of the result's variance", u="standard uncertainty from this source"),
    ),
)
"""Table budget.csv: contribution of each source to the uncertainty of each result."""
CONFORMITY_TABLE = Table(
    "conformity.csv",
    "results compared with their tolerances (JCGM 106)",
    (
        *text_columns(task="name of the task", result="name of the result"),
        Column("lower", "lower limit of the tolerance", n_digits=6),
        Column("upper", "upper limit of the tolerance", n_digits=6),
        Column("guard_band", "difference between a tolerance limit and the acceptance limit", n_digits=6),
        *text_columns(unit="unit of limits and guard band"),
        Column("conforms_percent", "probability that the true value lies within the tolerance", display_format=".1f"),
        *text_columns(judgement="accepted, rejected or undecided"),
    ),
)
"""Table conformity.csv: results with their tolerances and decisions."""
HIDDEN_ERRORS_TABLE = Table(
    "hidden.csv",
    "undetectable errors that the uncertainty does not include",
    (
        *text_columns(task="name of the task", result="name of the result", error="description of the error"),
        Column("change", "change of the result by the error", n_digits=3),
        *text_columns(unit="unit of the change"),
    ),
)
"""Table hidden.csv: errors that change results but no reading, so that the uncertainty does not include them."""
HIDDEN_ERROR_TYPE_TEXT = "not included"
"""Text in the column `type` of the budget table for an error that the uncertainty does not include."""
NonNegativeFloat = Annotated[float, Field(ge=0)]
"""Number that is not negative."""
MAX_RESULTS_IN_SUMMARY = 8
"""Largest number of results that the printed summary lists."""


class MonteCarloDistribution(Entry):
    """Distribution of a result by Monte Carlo simulation (JCGM 101), in the unit of the result."""

    mean: float
    """Mean of the result over the trials."""
    standard_uncertainty: NonNegativeFloat
    """Standard deviation of the result over the trials."""
    symmetric_interval: tuple[float, float]
    """Limits of the probabilistically symmetric coverage interval."""
    shortest_interval: tuple[float, float]
    """Limits of the shortest coverage interval."""
    is_stable: bool
    """True if the result is stable to the requested number of digits."""
    intervals_agree: bool
    """True if the interval by propagation agrees with that by Monte Carlo (JCGM 101, clause 8)."""


class BudgetEntry(Entry):
    """Contribution of one source of uncertainty to the uncertainty of a result."""

    source: str
    """Name of the source of uncertainty."""
    evaluation_type: Literal["A", "B"]
    """Type of the evaluation by the GUM: A by statistics, B by other means."""
    variance_fraction: float
    """Fraction (0 to 1) of the variance of the result that comes from this source."""
    standard_uncertainty: NonNegativeFloat
    """Standard uncertainty of the result from this source, in the unit of the result."""


class HiddenErrorEntry(Entry):
    """Error that does not change the readings, so that the uncertainty does not include it."""

    error_text: str
    """Description of the error with its size."""
    result_change: NonNegativeFloat
    """Absolute change of the result by this error, in the unit of the result."""


class Conformity(Entry):
    """Conformity of a result with its tolerance (JCGM 106); limits and guard band are in the unit of the result."""

    lower: float | None
    """Lower limit of the tolerance."""
    upper: float | None
    """Upper limit of the tolerance."""
    rule: Literal["guarded", "simple"]
    """Decision rule of the task file: `guarded` (with guard bands) or `simple`."""
    guard_band: float
    """Width of the guard band: distance of the acceptance limit from the tolerance limit, inside the tolerance."""
    conformity_probability: float
    """Probability that the true value lies within the tolerance."""
    judgement: Literal["accepted", "rejected", "undecided"]
    """Decision: `accepted` within the tolerance limits reduced by the guard bands, `rejected` outside the tolerance
    limits extended by the guard bands, otherwise `undecided`."""
    wrong_decision_probability: float
    """Probability that the decision is wrong."""


class TaskResult(Entry):
    """Result of a task with its uncertainty; all values are in the unit `unit`."""

    task: str
    """Name of the task."""
    kind: str
    """Kind of the task, such as `distance`."""
    name: str
    """Name of the result, such as `x` or `distance`; a task can have several results."""
    unit: str
    """Unit of all values of this entry."""
    value: float
    """Estimate of the result, in `unit`."""
    standard_uncertainty: NonNegativeFloat
    """Standard uncertainty of the result by the law of propagation (GUM), in `unit`."""
    coverage_factor: float
    """Coverage factor: expanded uncertainty divided by standard uncertainty."""
    expanded_uncertainty: NonNegativeFloat
    """Expanded uncertainty of the result for the coverage probability, in `unit`."""
    monte_carlo: MonteCarloDistribution
    """Distribution of the result by Monte Carlo simulation."""
    nonlinearity_ratio: float
    """Difference of the result between the exact and the linearised adjustment, divided by the standard uncertainty."""
    budget: tuple[BudgetEntry, ...] = Field(min_length=1)
    """Contributions of the sources of uncertainty, the largest first."""
    hidden_errors: tuple[HiddenErrorEntry, ...] = ()
    """Errors that change the result noticeably but no reading, the largest first; the uncertainty does not include
    them."""
    conformity: Conformity | None = None
    """Conformity with the tolerance; null for a result without a tolerance."""

    @property
    def text(self) -> str:
        """Text of the result with its expanded uncertainty: `length, distance: 1.234 mm, U = 0.020 mm (k = 2)`."""
        figures = with_expanded_uncertainty(self.value, self.expanded_uncertainty, self.unit, self.coverage_factor)
        return f"{self.task}, {self.name}: {figures}"

    @property
    def table_row(self) -> list[Any]:
        """Row of this result in the table uncertainty.csv."""
        largest, drawn = self.budget[0], self.monte_carlo
        numbers = self.value, self.standard_uncertainty, self.expanded_uncertainty
        judgement = self.conformity.judgement if self.conformity else ""
        monte_carlo = drawn.standard_uncertainty, *drawn.symmetric_interval, drawn.intervals_agree, judgement
        return [
            self.task,
            self.name,
            self.unit,
            *numbers,
            *monte_carlo,
            f"{largest.source} ({100 * largest.variance_fraction:.0f} %)",
        ]


class Uncertainty(ResultFile):
    """Result of `uncertainty`, the content of `uncertainty.json`: results of tasks with their uncertainty."""

    FILE: ClassVar[str] = "uncertainty.json"
    COMPANION_TABLES: ClassVar[Mapping[str, Table]] = {"results": RESULTS_TABLE, "budget": BUDGET_TABLE}
    format: Literal["ltsim-uncertainty/1"] = "ltsim-uncertainty/1"
    """Format and version of this file."""
    title: str
    """Title of the tasks, free text."""
    source: str
    """Name of the recording or scenario, as in the task file."""
    coverage_probability: float
    """Coverage probability of all intervals."""
    trials: int
    """Number of Monte Carlo trials."""
    frame: str
    """Description of the coordinate frame of all coordinates."""
    sigma0: OptionalFloat
    """Standard deviation of unit weight: square root of chi-square divided by the degrees of freedom of the adjustment;
    null for a list of coordinates."""
    results: tuple[TaskResult, ...] = Field(min_length=1)
    """Results of all tasks, one entry for each number (a task such as `point` has three results)."""
    correlation: tuple[tuple[OptionalFloat, ...], ...]
    """Correlation matrix of the results, in the order of `results`."""
    warnings: tuple[str, ...] = ()
    """Warnings about the validity of the results."""
    uncertainty_factor: float = 1.0
    """Factor by which the uncertainties from the adjustment are multiplied: sigma0 if the readings contradict the
    model, otherwise 1."""
    corrections_text: str = ""
    """Sentence on the errors of the recording that the model corrects; empty if it corrects none."""
    tests: tuple[CauseTest, ...] = ()
    """Tests of the possible causes of a misfit of the recording, and of its outliers."""

    def _summary_lines(self) -> list[str]:
        lines = [r.text for r in self.results[:MAX_RESULTS_IN_SUMMARY]]
        n_more = len(self.results) - len(lines)
        head = f"{len(self.results)} results, {100 * self.coverage_probability:g} % intervals, {self.trials} trials"
        lines += [f"and {n_more} more: to_dataframe()"] if n_more > 0 else []
        return [head, *lines, *([self.corrections_text] if self.corrections_text else [])]

    @property
    def has_faults_or_misfit(self) -> bool:
        """True if the model corrects errors of the recording, or if the readings contradict the model."""
        return self.uncertainty_factor > 1.0 or bool(corrected_faults(self.tests))

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        budget_rows = [(r, p) for r in self.results for p in r.budget]
        task_rows: list[tuple[Any, ...]] = [
            (r.task, r.name, p.source, p.evaluation_type, r.unit, p.variance_fraction, p.standard_uncertainty)
            for r, p in budget_rows
        ]
        task_rows += [
            (r.task, r.name, p.error_text, HIDDEN_ERROR_TYPE_TEXT, r.unit, None, p.result_change)
            for r in self.results
            for p in r.hidden_errors
        ]
        return {
            "results": lambda: RESULTS_TABLE.with_rows(r.table_row for r in self.results),
            "budget": lambda: BUDGET_TABLE.with_rows(task_rows),
            "conformity": self._conformity_table,
            "hidden": lambda: HIDDEN_ERRORS_TABLE.with_rows(
                [r.task, r.name, part.error_text, part.result_change, r.unit]
                for r in self.results
                for part in r.hidden_errors
            ),
        }

    def _conformity_table(self) -> Table:
        return CONFORMITY_TABLE.with_rows(
            [r.task, r.name, c.lower, c.upper, c.guard_band, r.unit, 100 * c.conformity_probability, c.judgement]
            for r in self.results
            if (c := r.conformity)
        )


def evaluate_conformity(
    result_value: float,
    sigma: float,
    tolerance: ToleranceLimits,
    decision_rule: DecisionRule,
    trial_results: Floats | None = None,
) -> Conformity:
    """Decision on the conformity of a result with its tolerance.

    The distribution of the result is that of `trial_results` (trials,), by default a normal distribution with the
    standard deviation `sigma`. All values are in the unit of the tolerance.

    References
    ----------
    JCGM 106:2012, clauses 7 (probability of conformity) and 8 (guard bands).
    """
    lower = -np.inf if tolerance.lower is None else tolerance.lower
    upper = np.inf if tolerance.upper is None else tolerance.upper
    if trial_results is not None:
        probability = float(np.mean((trial_results >= lower) & (trial_results <= upper)))
    elif sigma > 0:
        probability = float(special.ndtr((upper - result_value) / sigma) - special.ndtr((lower - result_value) / sigma))
    else:
        probability = float(lower <= result_value <= upper)
    guard = float(-special.ndtri(decision_rule.consumer_risk)) * sigma if decision_rule.rule == "guarded" else 0.0
    judgement: Literal["accepted", "rejected", "undecided"] = "undecided"
    wrong = min(probability, 1.0 - probability)
    if lower + guard <= result_value <= upper - guard:
        judgement, wrong = "accepted", 1.0 - probability
    elif result_value < lower - guard or result_value > upper + guard:
        judgement, wrong = "rejected", probability
    return Conformity(
        lower=tolerance.lower,
        upper=tolerance.upper,
        rule=decision_rule.rule,
        guard_band=guard,
        conformity_probability=probability,
        judgement=judgement,
        wrong_decision_probability=wrong,
    )


def normalised_errors_of_files(first_result: Uncertainty, second_result: Uncertainty) -> list[tuple[str, float]]:
    """Normalised error E_n of each result that two files contain in the same unit, with its name ``task, result``.

    E_n applies to independent results, for example from two recordings or two instruments.
    """
    others = {(r.task, r.name, r.unit): r for r in second_result.results}
    result_pairs = [(r, others[key]) for r in first_result.results if (key := (r.task, r.name, r.unit)) in others]
    return [
        (f"{r.task}, {r.name}", normalised_error(r.value, r.expanded_uncertainty, o.value, o.expanded_uncertainty))
        for r, o in result_pairs
    ]


def normalised_error(
    value: float, expanded_uncertainty: float, other_value: float, other_expanded_uncertainty: float
) -> float:
    """Normalised error E_n of two results: difference divided by the root sum of squares of their uncertainties.

    The uncertainties are expanded uncertainties. The results agree if |E_n| <= 1 (ISO 13528).
    """
    together = float(np.hypot(expanded_uncertainty, other_expanded_uncertainty))
    gap = value - other_value
    return gap / together if together > 0 else (0.0 if gap == 0 else float(np.copysign(np.inf, gap)))
