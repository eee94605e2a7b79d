"""Sobol indices: against a case whose indices are known, and for the paper's size."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest

from ltsim.core.errors import ModelError
from ltsim.planning.expected_precision import DisagreementPredictor, ExpectedDisagreement, ExpectedPrecision
from tests.planning.fixtures import survey

sensitivity = import_module("experiments.14_what_drives_improvement.run").sensitivity


class AnalyticPredictor(DisagreementPredictor):
    """A predictor whose criteria are a sum of logarithms: variances 1, 4 and an interaction of 1 on the last output."""

    def __init__(self) -> None:
        pass

    def expected_disagreement(self, group_sizes=None):  # type: ignore[no-untyped-def]
        a, b = (np.sqrt(3) * np.log(group_sizes[name]) for name in ("a", "b"))
        return ExpectedDisagreement(np.ones_like(a), 1 - a / 100, np.ones_like(a), a + 2 * b + a * b)


def test_indices_of_a_case_with_an_analytic_answer() -> None:
    """a and b have mean 0 and variance 1: shares 1/6, 4/6 and 1/6 for both together."""
    indices = sensitivity(AnalyticPredictor(), {"a": (np.exp(-1), np.e), "b": (np.exp(-1), np.e)}, samples=1024, seed=0)
    by = {(row["output"], row["input"]): row for row in indices}
    assert by["distance improvement", "a"]["first"] == pytest.approx(1.0, abs=0.04)
    assert by["distance improvement", "b"]["total"] == pytest.approx(0.0, abs=1e-6)
    a, b = by["coordinate after", "a"], by["coordinate after", "b"]
    assert a["first"] == pytest.approx(1 / 6, abs=0.04)
    assert a["total"] == pytest.approx(2 / 6, abs=0.04)
    assert b["first"] == pytest.approx(4 / 6, abs=0.04)
    assert b["total"] == pytest.approx(5 / 6, abs=0.04)
    assert a["first_low"] < 1 / 6 < a["first_high"]


def test_disagreement_after_calibration_is_noise_and_not_the_instrument() -> None:
    predictor = DisagreementPredictor.from_expected_precision(ExpectedPrecision.from_survey(survey((1, 2), 2)))
    ranges = dict.fromkeys(("range noise", "angle noise", "angle errors"), (0.5, 2.0))
    indices = sensitivity(predictor, ranges, samples=128, seed=1)
    after = {row["input"]: row["total"] for row in indices if row["output"] == "distance after"}
    assert after["angle errors"] < 0.05 < after["angle noise"]
    improved = {row["input"]: row["total"] for row in indices if row["output"] == "distance improvement"}
    assert improved["angle errors"] > 0.2
    again = sensitivity(predictor, ranges, samples=128, seed=1)
    assert [row["total"] for row in again] == [row["total"] for row in indices]


def test_a_group_of_errors_that_does_not_exist_is_refused() -> None:
    predictor = DisagreementPredictor.from_expected_precision(ExpectedPrecision.from_survey(survey((1,), 2)))
    with pytest.raises(ModelError, match="did you mean"):
        sensitivity(predictor, {"range nose": (1.0, 2.0)}, samples=4, seed=0)
