"""A layout of which hardly a station is left determines nothing, and is judged so."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.core.errors import NetworkError
from ltsim.physics.model.construction import misalignment_construction
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.tolerances import PointTolerances, check_tolerances, checks_after_required_losses
from tests.planning.test_search import site


def test_a_survey_without_a_station_or_a_target_is_no_network() -> None:
    survey = site().survey
    survey = survey.replace(is_visible=np.ones((len(survey.station_positions), len(survey.target_points)), dtype=bool))
    alone = survey
    while len(alone.station_positions) > 1:
        alone = alone.without_station(0)
    demands = PointTolerances(dict.fromkeys(survey.target_names, 1e-4))
    (lost,) = checks_after_required_losses(alone, demands, misalignment_construction())
    assert lost.max_tolerance_ratio == np.inf
    assert "not visible from any station" in lost.violations_clause
    assert not check_tolerances(alone.without_station(0), demands, misalignment_construction()).meets_all_tolerances
    for nothing in (alone.without_station(0), alone.with_targets_only(np.zeros(len(alone.target_points), dtype=bool))):
        with pytest.raises(NetworkError, match="no station sees any target"):
            ExpectedPrecision.from_survey(nothing)
