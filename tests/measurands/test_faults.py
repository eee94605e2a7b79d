"""Errors of a recording that the model corrects: uncertainty, compare and the section of a recording name them."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.core.errors import ConvergenceError
from ltsim.recordings.recording import Recording
from ltsim.reports.sections import result_section
from ltsim.reports.sections.network import recording_section
from ltsim.reports.workshop_scene import workshop_from_recording
from tests.adjustment.identification.test_verbs_agree import longer, moved_target, rows_of, workshop

LENGTH: dict[str, Any] = {"name": "length", "kind": "distance", "targets": ["T07", "T01"]}
PRISM_CONSTANT = 34.4e-3
"""Reflector constant of a round prism [m]."""


def uncertainty_of_length(recording: Recording) -> lt.Uncertainty:
    task = LENGTH | {"tolerances": {"distance": {"lower": 0.0, "upper": 1e5}}}
    return lt.uncertainty(recording, {"task": [task], "monte_carlo": {"digits": 1}})


@cache
def clean_uncertainty() -> lt.Uncertainty:
    """Uncertainty of the length in the recording without any error, computed once for all tests."""
    return uncertainty_of_length(workshop())


def wrong_constant() -> Recording:
    return longer(rows_of("S3"), offset=PRISM_CONSTANT)


def distorted() -> Recording:
    """Recording whose azimuths have an error of six periods per turn, which no cause explains."""
    readings = workshop().readings.copy()
    readings[:, 1] += 60e-6 * np.sin(6.0 * readings[:, 1])
    return workshop().with_readings(readings)


def test_an_uncertainty_corrects_a_target_that_moved_and_a_wrong_constant() -> None:
    clean = clean_uncertainty()
    assert (clean.tests, clean.corrections_text, clean.uncertainty_factor) == ((), "", 1.0)
    for recording, place in ((moved_target(0.25e-3)[0], "T07"), (wrong_constant(), "S3")):
        uncertainty = uncertainty_of_length(recording)
        sentence = f"The model corrects 1 error at {place}"
        text = result_section(uncertainty).terminal_text()
        assert sentence in text
        assert uncertainty.tests[0].sentence in text
        assert result_section(uncertainty).assessment == "caution"
        assert abs(uncertainty.results[0].value - clean.results[0].value) < uncertainty.results[0].expanded_uncertainty
        assert uncertainty.results[0].expanded_uncertainty < 2.0 * clean.results[0].expanded_uncertainty
        assert max(uncertainty.results[0].nonlinearity_ratio, clean.results[0].nonlinearity_ratio) < 0.1


def test_an_uncertainty_is_larger_where_the_readings_contradict_the_model() -> None:
    clean, uncertainty = clean_uncertainty(), uncertainty_of_length(distorted())
    assert uncertainty.sigma0 is not None
    assert uncertainty.uncertainty_factor == uncertainty.sigma0 > 1.2
    observed = [{p.source: p.standard_uncertainty for p in u.results[0].budget} for u in (clean, uncertainty)]
    assert observed[1]["azimuth readings"] == pytest.approx(
        uncertainty.sigma0 * observed[0]["azimuth readings"], rel=0.01
    )
    assert "multiplied by sigma0" in result_section(uncertainty).terminal_text()


def test_a_comparison_corrects_each_recording() -> None:
    for recording, place in ((moved_target(0.25e-3)[0], "T07"), (wrong_constant(), "S3")):
        comparison = lt.compare(workshop(), recording, same_instrument=True)
        assert f"In the second epoch: The model corrects 1 error at {place}" in result_section(comparison).summary
        assert (comparison.tests, comparison.moved_points) == ((), ())
        assert comparison.second_tests
        assert result_section(comparison).assessment == "caution"


def test_a_recording_with_a_wrong_constant_has_a_floor_plan(tmp_path: Path) -> None:
    lt.write(wrong_constant(), tmp_path / "prism")
    section = recording_section(tmp_path / "prism", hall_view="floor-plan")
    assert "The model corrects 1 error at S3" in section.summary
    assert "Floor plan" in [getattr(block, "title", "") for block in section.blocks]
    distance = np.linalg.norm(np.diff(workshop_from_recording(wrong_constant()).station_positions[[0, 2]], axis=0))
    clean_distance = np.linalg.norm(np.diff(workshop_from_recording(workshop()).station_positions[[0, 2]], axis=0))
    assert distance == pytest.approx(clean_distance, abs=1e-4)


def test_a_message_names_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise ConvergenceError("the adjustment did not converge", None)

    monkeypatch.setattr("ltsim.calibration.identified_network.adjust_with_cause_selection", fail)
    with pytest.raises(ConvergenceError, match=r"^the first recording: .*; run ltsim diagnose on this recording$"):
        lt.compare(workshop(), workshop())
