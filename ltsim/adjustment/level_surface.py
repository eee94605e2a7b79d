"""Declared coordinates whose heights are above a level surface, such as levelled heights, in a Cartesian network."""

from collections.abc import Mapping

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.significance import MIN_LOG_EVIDENCE_CERTAIN
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError
from ltsim.core.units import EARTH_RADIUS, MILLIMETRE
from ltsim.geometry.rigid import align_robustly

N_PLANE_COEFFICIENTS = 3
"""Number of coefficients of a plane, which a shift and two rotations of the axes fit to the heights."""


def levelled_heights_notes(
    adjustment: Adjustment, points_by_target: Mapping[str, Floats], source_text: str
) -> list[str]:
    """Note, in a list, on heights above a level surface in declared coordinates, with advice; otherwise empty.

    A level surface departs from its tangent plane by d^2 / (2 R) at the horizontal distance d from the point of
    contact, with the radius R of the earth. The heights are levelled if this departure explains the differences between
    declared and adjusted heights.

    Parameters
    ----------
    adjustment : Adjustment
        Adjustment of the network without the declared coordinates.
    points_by_target : mapping of str to (3,) float, [m]
        Declared coordinates of measured targets.
    source_text : str
        Name of their file.
    """
    names = [name for name in points_by_target if name not in adjustment.undetermined_targets]
    if len(names) <= N_PLANE_COEFFICIENTS:
        return []
    declared_points = np.array([points_by_target[name] for name in names])
    points = adjustment.state.target_points[[adjustment.recording.targets.index(name) for name in names]]
    try:
        turn, shift = align_robustly(points, declared_points)
    except NetworkError:
        return []
    height_residuals = (declared_points - points @ turn.T - shift)[:, 2]
    offsets = declared_points[:, :2] - declared_points[:, :2].mean(axis=0)
    if not level_surface_log_evidence(offsets, height_residuals) > MIN_LOG_EVIDENCE_CERTAIN:
        return []
    departures = _level_surface_departures(offsets)
    farthest = int(np.argmax(departures))
    return [
        f"the heights in {source_text} are above a level surface (levelled heights), because their differences from "
        "the network grow with the squared distance d from the centroid of the points, by d^2 / (2 R) with the radius "
        f"R = {EARTH_RADIUS / 1000:.0f} km of the earth: subtract d^2 / (2 R) from each height of the file ("
        f"{departures[farthest] / MILLIMETRE:.3g} mm at {names[farthest]}), which makes its coordinates Cartesian as "
        "those of the network"
    ]


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
