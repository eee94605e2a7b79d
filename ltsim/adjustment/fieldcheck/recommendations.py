"""Next actions that are recommended to the user after a field check."""

from ltsim.adjustment.fieldcheck.result import Check, CheckItem, check_item_from_cause
from ltsim.adjustment.identification.recommendations import (
    RECOMMENDATION_BY_CAUSE_KIND,
    recommendations_for_causes,
)
from ltsim.core.notation import names_text

RECOMMENDATION_BY_FAILED_TESTS = {
    ("two-face",): "Run the two-face compensation of the tracker, or estimate its errors with ltsim calibrate.",
    ("gross", "bump", "drift", "instrument-drift", "closure", "level", "mistake"): (
        "Measure {place} again before moving the tripod."
    ),
    ("network",): "Run ltsim diagnose to locate the disagreement of the stations.",
    ("reference",): RECOMMENDATION_BY_CAUSE_KIND["reference-value"],
    ("reference-scale",): RECOMMENDATION_BY_CAUSE_KIND["reference-scale"],
}
"""Sentence on the next action, by the kinds of failed tests of a field check without an identified cause.

The kind `reference-scale` is the test of the common scale of all reference lengths. In the sentences `place` is
replaced by the names of the targets of the tests, or of their stations if they have no targets, and `at_place` by these
names after the word "at".
"""


def recommendations_after_check(check: Check) -> list[str]:
    """Sentences on next actions: first after identified causes, then after other failed tests, without repetitions."""
    actions = recommendations_for_causes(check.tests)
    causes = [check_item_from_cause(test) for test in check.tests]
    failed_items = [item for item in check.items if not item.passed and item not in causes]
    for kinds, action in RECOMMENDATION_BY_FAILED_TESTS.items():
        items = [item for item in failed_items if _recommendation_kind(item) in kinds]
        targets = list(dict.fromkeys(name for item in items for name in item.targets))
        stations = list(dict.fromkeys(item.station for item in items if item.station))
        place = names_text(targets or stations)
        if items:
            actions.append(action.format(place=place or "the set-ups", at_place=f" at {place}" if place else ""))
    return list(dict.fromkeys(actions))


def _recommendation_kind(item: CheckItem) -> str:
    """Kind of a failed test, as a key of `RECOMMENDATION_BY_FAILED_TESTS`."""
    return "reference-scale" if item.kind == "reference" and not (item.targets or item.station) else item.kind
