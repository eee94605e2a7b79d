"""Next actions after identified causes: one for each kind, with its place."""

from __future__ import annotations

from typing import get_args

from ltsim.adjustment.identification.cause_tests import CausePlace, CauseTest
from ltsim.adjustment.identification.hypothesis import CauseKind
from ltsim.adjustment.identification.recommendations import (
    corrections_sentence,
    recommendation_for_cause,
    recommendations_for_causes,
)


def cause(kind: str, acts_on: str = "distance", estimate: float = 1.0) -> CauseTest:
    place = CausePlace(stations=("ST3",), targets=("T7",) if kind == "outlier" else ())
    return CauseTest(kind=kind, acts_on=acts_on, where=place, statistic=99.0, dof=1, estimate=estimate, rows=(4,))


def test_each_kind_of_cause_has_an_action() -> None:
    for kind in get_args(CauseKind):
        action = recommendation_for_cause(cause(kind))
        assert action.endswith(".") and "{" not in action, kind
        assert "ST3" in action or kind == "reference-scale", kind
    assert recommendation_for_cause(cause("outlier")) == "Measure again T7 from ST3 (row 4)."
    assert "vertical index" in recommendation_for_cause(cause("constant-offset", "elevation"))


def test_different_vertical_indices_at_set_ups_suggest_a_drift() -> None:
    first = cause("constant-offset", "elevation")
    second = first.model_copy(update={"where": CausePlace(stations=("ST4",))})
    assert "both faces" in recommendation_for_cause(first)
    assert recommendations_for_causes([first]) == [recommendation_for_cause(first)]
    actions = recommendations_for_causes([first, second])
    assert len(actions) == 3
    assert "(ST3, ST4), which suggests a drift: run ltsim diagnose" in actions[-1]


def test_noise_smaller_than_declared_is_no_fault() -> None:
    quiet, loud, again = (cause("noise-level", "noise", size) for size in (0.5, 3.0, 4.0))
    assert not quiet.is_fault and loud.is_fault
    assert recommendations_for_causes([quiet, loud, again]) == [recommendation_for_cause(loud)]
    assert not cause("names").model_copy(update={"accepted": False}).is_fault


def test_an_error_whose_pointings_are_not_used_is_not_in_the_coordinates() -> None:
    """Of an exchange, one sentence said that its pointings are not used, another that it remains in the coordinates."""
    exchange = cause("names", "position")
    exchange = exchange.model_copy(update={"is_in_model": False, "sentence": "T1 is T2.", "rows": (4, 9)})
    assert corrections_sentence([exchange]) == "T1 is T2. This error remains in the coordinates."
    assert corrections_sentence([exchange], [4]) == corrections_sentence([exchange])
    assert corrections_sentence([exchange], [9, 4, 2]) == (
        "T1 is T2. The coordinates do not contain this error, because these pointings are not used."
    )
