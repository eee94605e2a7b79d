"""Declared coordinates whose heights are above a level surface, such as levelled heights, in a Cartesian network."""

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.significance import MIN_LOG_EVIDENCE_CERTAIN
from ltsim.core.arrays import Floats
from ltsim.core.units import EARTH_RADIUS, MILLIMETRE

N_PLANE_COEFFICIENTS = 3
"""Number of coefficients of a plane, which a shift and two rotations of the axes fit to the heights."""


def levelled_heights_text(adjustment: Adjustment) -> str:
    """Clause on heights above a level surface among the coordinates that define the axes, with advice; or empty.

    A level surface departs from its tangent plane by d^2 / (2 R) at the horizontal distance d from the point of
    contact, with the radius R of the earth. The heights are levelled if this departure explains the differences between
    declared and adjusted heights.
    """
    tests = [test for test in adjustment.axes_point_tests if len(test.residual) == len("xyz")]
    if len(tests) <= N_PLANE_COEFFICIENTS:
        return ""
    points = adjustment.state.target_points[[adjustment.recording.targets.index(test.name) for test in tests]]
    offsets = points[:, :2] - points[:, :2].mean(axis=0)
    height_residuals = np.array([test.residual[2] for test in tests])
    if not level_surface_log_evidence(offsets, height_residuals) > MIN_LOG_EVIDENCE_CERTAIN:
        return ""
    departures = _level_surface_departures(offsets)
    farthest = int(np.argmax(departures))
    return (
        "; its heights are above a level surface (levelled heights), because their differences from the network grow "
        "with the squared distance d from the centroid of the points, by d^2 / (2 R) with the radius R = "
        f"{EARTH_RADIUS / 1000:.0f} km of the earth: subtract d^2 / (2 R) from each height of the file ("
        f"{departures[farthest] / MILLIMETRE:.3g} mm at {tests[farthest].name}), which makes its coordinates Cartesian "
        "as those of the network"
    )


def level_surface_log_evidence(offsets: Floats, height_residuals: Floats) -> float:
    """Log evidence of heights above a level surface against heights above a plane.

    It is the logarithm of the Bayes factor for residuals (k,) [m], declared minus adjusted heights, with one unknown
    standard deviation (prior density 1 / sigma) and an unknown plane (flat prior). The departure from a plane has no
    unknown. `offsets` (k, 2) [m] are the horizontal positions relative to the centroid of the points.
    """
    basis, _ = np.linalg.qr(np.column_stack([np.ones(len(offsets)), offsets]))
    sums = [
        float(np.sum((heights - basis @ (basis.T @ heights)) ** 2))
        for heights in (height_residuals, height_residuals - _level_surface_departures(offsets))
    ]
    smallest = float(np.finfo(float).tiny)
    return 0.5 * (len(offsets) - N_PLANE_COEFFICIENTS) * float(np.log(max(sums[0], smallest) / max(sums[1], smallest)))


def _level_surface_departures(offsets: Floats) -> Floats:
    """Departures (k,) [m] of a level surface from its tangent plane at the horizontal positions `offsets` (k, 2)."""
    return np.asarray(np.sum(offsets**2, axis=1) / (2.0 * EARTH_RADIUS))
