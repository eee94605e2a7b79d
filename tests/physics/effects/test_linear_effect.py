"""A law that is no effect of the catalogue is fitted and tested like one: all it takes is a signature."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats
from ltsim.physics.effects.linear_effect import LinearEffect, Parameter, design_from_front_face_corrections
from ltsim.scene.sightings import Sightings
from tests.networks import network


class Ripple(LinearEffect):
    """Azimuths that are off to either side by turns, both faces of a target alike."""

    name = "ripple"
    parameters = (Parameter("ripple", "urad", "half the difference of two targets in turn", 5e-6),)

    def design(self, sightings: Sightings) -> Floats:
        sign = np.where(np.arange(len(sightings)) // 2 % 2, -1.0, 1.0)
        return design_from_front_face_corrections(sightings, azimuth=sign[:, None])


def test_a_signature_is_estimated_next_to_poses_and_targets() -> None:
    recording, truth = network(faces=2, seed=3)
    readings = recording.readings.copy()
    law = Ripple()
    readings += 20e-6 * law.design(adjust(recording, truth.construction).sightings)[:, :, 0]
    fitted = adjust(recording.with_readings(readings), truth.construction, effects=[law])
    sigma = float(np.sqrt(fitted.effect_covariance[0, 0]))
    assert sigma < 0.5e-6
    assert fitted.state.extra_parameters[0] == pytest.approx(20e-6, abs=4 * sigma)


def test_what_an_adjustment_leaves_of_a_signature_holds_its_size() -> None:
    recording, truth = network(faces=2, seed=3)
    space = ResidualSpace.from_adjustment(adjust(recording, truth.construction))
    whole = space.whitened_design(Ripple())
    projected = space.project(whole)
    assert whole.shape == (space.n_equations, 1)
    assert 0.5 < float(projected[:, 0] @ projected[:, 0]) / float(whole[:, 0] @ whole[:, 0]) < 1.0


def test_a_law_without_a_design_is_refused() -> None:
    class Empty(LinearEffect):
        name = "empty"
        parameters = ()

    with pytest.raises(TypeError, match="design"):
        Empty()  # type: ignore[abstract]
