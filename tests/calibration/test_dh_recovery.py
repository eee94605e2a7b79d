"""Every combination of D-H coefficients that a network determines is found, however far off its prior, and it is said.

Of the 78 coefficients a network with a known length determines 47 combinations (`DH_CHAIN` of
`ltsim.geometry.kinematics`). Each is injected with 20 standard deviations of its prior.
"""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.calibration.network import calibrate_network
from ltsim.calibration.prior_information import EarlierCalibrationPrior, ParameterSelection
from ltsim.core.arrays import Floats
from ltsim.physics.model.construction import dh_construction
from tests.networks import network

DETERMINED, FAR, WIDER = 47, 20.0, 100.0
VISIBLE_RATIO = 3.0
"""Prior sigmas: a combination that is known worse cannot be told to be 20 of them off."""
BUILT = dh_construction()
SIGMA = np.array([p.prior_sigma for p in BUILT.parameters])


def wide() -> ParameterSelection:
    """Priors so wide that they say next to nothing."""
    covariance = np.diag((WIDER * SIGMA) ** 2)[None]
    return ParameterSelection(
        earlier_calibration_prior=EarlierCalibrationPrior(
            "dh",
            BUILT.parameter_names,
            ("",),
            np.zeros((1, BUILT.n_parameters)),
            covariance,
            np.zeros(BUILT.n_parameters),
        )
    )


@pytest.fixture(scope="module")
def directions() -> Floats:
    """(78, 47) combinations in prior sigmas, the best determined first."""
    calibration = calibrate_network(
        network(faces=2, seed=0, construction=BUILT)[0], BUILT, recommend_measurements=False, parameter_selection=wide()
    )
    unit = WIDER * SIGMA
    eigenvalues, vectors = np.linalg.eigh(calibration.covariance / np.outer(unit, unit))
    assert eigenvalues[DETERMINED - 1] < 0.9 < eigenvalues[DETERMINED]
    return vectors[:, :DETERMINED]


@pytest.mark.parametrize(
    "number", [n if n % 16 == 0 else pytest.param(n, marks=pytest.mark.long) for n in range(DETERMINED)]
)
def test_a_combination_far_off_its_prior_is_recovered_and_its_misfit_is_reported(
    directions: Floats, number: int
) -> None:
    injected = FAR * directions[:, number]
    recording = network(faces=2, seed=number, values=injected * SIGMA, construction=BUILT)[0]
    calibration = calibrate_network(recording, BUILT, recommend_measurements=False, parameter_selection=wide())
    error = directions.T @ (calibration.estimates[0] / SIGMA - injected)
    spread = directions.T @ (calibration.covariance / np.outer(SIGMA, SIGMA)) @ directions
    z = error / np.sqrt(np.diag(spread))
    assert abs(z[number]) < 3.9
    assert z @ z < 100.0  # chi-square of 47 combinations, of which one trial in 100,000 would be larger
    if spread[number, number] < VISIBLE_RATIO**2:
        calibration = calibrate_network(recording, BUILT, recommend_measurements=False)
        assert any("contradict" in note for note in calibration.notes)
