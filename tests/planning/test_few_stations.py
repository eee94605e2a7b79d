"""A layout of which hardly a station is left determines nothing, and is judged so."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.core.errors import NetworkError
from ltsim.physics.model.construction import misalignment_construction
from ltsim.planning.information import LayoutInformation
from ltsim.planning.tolerances import Tolerances, judged, losses_of
from tests.planning.test_search import site


def test_a_survey_without_a_station_or_a_target_is_no_network() -> None:
    survey = site().survey
    survey = survey.replace(visible=np.ones((len(survey.position), len(survey.points)), dtype=bool))
    alone = survey
    while len(alone.position) > 1:
        alone = alone.without(0)
    demands = Tolerances(dict.fromkeys(survey.target_names, 1e-4))
    (lost,) = losses_of(alone, demands, misalignment_construction())
    assert lost.ratio == np.inf
    assert "not visible from any station" in lost.remaining
    assert not judged(alone.without(0), demands, misalignment_construction()).good
    for nothing in (alone.without(0), alone.only(np.zeros(len(alone.points), dtype=bool))):
        with pytest.raises(NetworkError, match="no station sees a target"):
            LayoutInformation.of(nothing)
