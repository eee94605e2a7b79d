"""Trials with scale bars that share the error of their material."""

from __future__ import annotations

import numpy as np

import ltsim as lt
from ltsim.campaigns.batch_distance_calibrator import BatchDistanceCalibrator
from ltsim.campaigns.trial_calibrators import BatchCalibrator
from ltsim.campaigns.true_network import make_true_network

BARS = lt.scenario(
    "paper-workshop",
    {
        "gauge": "none",
        "instrument.errors": {"draw": True},
        "materials": {"steel": {"expansion_per_k": 11.5e-6, "sigma_expansion_per_k": 0.05e-6}},
        "lengths": [
            {"from": "T01", "to": "T24", "sigma_um": 1.0, "material": "steel", "sigma_temperature_k": 0.1},
            {"from": "T03", "to": "T20", "sigma_um": 1.0, "material": "steel", "measured_at_c": "air_temperature_c"},
            {"from": "T02", "to": "T10", "sigma_um": 40.0, "measured_in_place": True},
        ],
    },
)


def test_batches_are_the_single_calibrators_and_scatter_as_predicted() -> None:
    truth = make_true_network(BARS, 4, "campaign")
    block = truth.draw_batch(4, 0)
    engine = BatchCalibrator(truth, truth.construction)
    calibrated = engine.calibrate(block)
    assert max(engine.largest_solver_difference(block, k, calibrated) for k in (0, 100)) < 2e-4
    z = ((calibrated.instrument_values - block.instrument_values) / calibrated.instrument_sigmas[:, :, None])[0]
    np.testing.assert_allclose(z.std(axis=1), 1.0, atol=0.16)
    scale = truth.construction.parameter_index("range-scale")
    assert (
        calibrated.instrument_sigmas[0, scale] < 0.8 * truth.distributions.instrument_error_sigmas[0, scale]
    )  # the bars tell something
    dof = engine.batch_network.problem.dof
    assert abs(calibrated.chi2.mean() - dof) < 5 * np.sqrt(2 * dof / len(calibrated.chi2))
    distance = BatchDistanceCalibrator(truth, truth.construction)
    compared = distance.calibrate(block, np.arange(len(calibrated.chi2)))
    assert max(distance.largest_solver_difference(block, k, compared) for k in (0, 3)) < 1e-3
