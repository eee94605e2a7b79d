"""Minimum zones: the element whose zone around all points is the narrowest (Chebyshev, ISO 1101).

Flatness is the distance of two parallel planes, roundness of two concentric circles in the plane of the points,
sphericity and cylindricity of two coaxial surfaces; straightness in space is the diameter of a cylinder. Each is found
by linear programs on the element linearised at the last one, within a limit that shrinks where a step did not help.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ltsim.arrays import Floats
from ltsim.tasks.features import Feature, across, fit, unit

ROUNDS = 60
STOP = 1e-12
"""Share of the points' extent by which a round must narrow the zone."""
LAWSON = 400
"""Rounds after which a diameter is within about a thousandth of the narrowest."""
IDLE = 60
"""Draws in a row without a new set of contacts after which no further one is looked for: others come up in fewer than
one draw in twenty (at 95 %)."""


def minimum_zone(kind: str, points: Floats) -> Feature:
    """The element with the narrowest zone around points (n, 3) [m]; its deviations are symmetric about it.

    Raises
    ------
    ModelError
        When the points do not determine the element.
    """
    start = fit(kind, points)
    centre, extent = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    local = (points - centre) / extent
    axis, place = start.normal, (start.centre - centre) / extent
    width, signed = _zone(kind, local, place, axis)
    limit = 0.1
    for _ in range(ROUNDS):
        step = _program(*_linearised(kind, local, place, axis), limit)
        first, second = across(axis) if kind != "sphere" else (np.zeros(3), np.zeros(3))
        turned = axis if kind == "sphere" else unit(axis + step[3] * first + step[4] * second)
        tried_width, tried = _zone(kind, local, place + step[:3], turned)
        if tried_width < width - STOP:
            place, axis, width, signed = place + step[:3], turned, tried_width, tried
            limit = min(2.0 * limit, 0.3)
        else:
            limit /= 4.0
            if limit < STOP:
                break
    middle = 0.5 * (signed.max() + signed.min()) if kind != "line" else 0.0
    radius = np.array(middle * extent if kind in ("circle", "sphere", "cylinder") else np.nan)
    if kind == "plane":
        place = place + middle * axis
    return Feature(place * extent + centre, axis, radius, (signed - middle) * extent)


def _values(kind: str, local: Floats, place: Floats, axis: Floats) -> Floats:
    """The quantity (n,) whose spread is the zone; the distance itself for a line."""
    arm = local - place
    if kind == "plane":
        return arm @ axis
    if kind == "sphere":
        return np.linalg.norm(arm, axis=1)
    return np.linalg.norm(arm - np.outer(arm @ axis, axis), axis=1)


def _zone(kind: str, local: Floats, place: Floats, axis: Floats) -> tuple[float, Floats]:
    values = _values(kind, local, place, axis)
    return (2.0 * float(values.max()) if kind == "line" else float(np.ptp(values))), values


def _linearised(kind: str, local: Floats, place: Floats, axis: Floats) -> tuple[str, Floats, Floats]:
    """The kind, values (n,) and their derivative (n, 5) by a shift and by turns of the axis about its two sides.

    What does not change the zone (a shift along an axis, a circle's own plane) has columns of zeros.
    """
    values = _values(kind, local, place, axis)
    arm = local - place
    design = np.zeros((len(local), 5))
    if kind == "sphere":
        design[:, :3] = -arm / values[:, None]
        return kind, values, design
    first, second = across(axis)
    if kind == "plane":
        design[:, 3], design[:, 4] = arm @ first, arm @ second
        return kind, values, design
    side = arm - np.outer(arm @ axis, axis)
    outward = side / np.maximum(values, 1e-300)[:, None]
    design[:, :3] = -outward
    if kind != "circle":
        design[:, 3] = -(arm @ axis) * (outward @ first)
        design[:, 4] = -(arm @ axis) * (outward @ second)
    return kind, values, design


def _program(kind: str, values: Floats, design: Floats, limit: float) -> Floats:
    """The step (5,) within the limit that narrows the linearised zone most."""
    solved = _solved(kind, values, design, limit)
    return solved.x[:5] if solved.status == 0 else np.zeros(5)


def _solved(kind: str, values: Floats, design: Floats, limit: float) -> Any:
    """The linear program: least width over steps (5,) within the limit, upper and lower end of the zone."""
    from scipy.optimize import linprog  # slow to load

    count = len(values)
    ones, none = np.ones((count, 1)), np.zeros((count, 1))
    rows, right = np.hstack([design, -ones, none]), -values
    if kind != "line":
        rows, right = np.vstack([rows, np.hstack([-design, none, ones])]), np.concatenate([right, values])
    cost = np.array([0.0] * 5 + [1.0, 0.0 if kind == "line" else -1.0])
    bounds = [(-limit, limit)] * 5 + [(None, None)] * 2
    return linprog(cost, A_ub=rows, b_ub=right, bounds=bounds, method="highs")


def zone_widths(kind: str, points: Floats, near: Feature) -> Floats:
    """Widths (b,) of the minimum zones of points (b, n, 3) [m] that lie near those of a known zone.

    To first order the width is the largest of `weights @ values` over sets of weights, one a set of points in contact
    with both sides of the zone (the dual of the linear program). Sets are gathered until draws bring no new one.
    """
    if kind == "line":
        return _straightness(points, near)
    extent = float(np.ptp(points[0], axis=0).max())
    local = (points - near.centre) / extent
    values = np.stack([_values(kind, one, np.zeros(3), near.normal) for one in local])
    _, _, design = _linearised(kind, local[0], np.zeros(3), near.normal)
    contacts: list[Floats] = []
    idle = 0
    for i in range(len(values)):
        width = np.max([w @ values[i] for w in contacts], initial=-np.inf)
        solved = _solved(kind, values[i], design, 0.3)
        if solved.status == 0 and solved.fun > width + STOP:
            pressed = -solved.ineqlin.marginals
            count = values.shape[1]
            contacts.append(pressed[:count] - pressed[count:])
            idle = 0
        else:
            idle += 1
        if idle >= IDLE:
            break
    return np.max([values @ w for w in contacts], axis=0) * extent


def _straightness(points: Floats, near: Feature) -> Floats:
    """Diameters (b,) of the narrowest cylinders about points (b, n, 3) [m] along a known line.

    Offsets from the line are two-dimensional, and small: a straight line is fitted to them with weights that grow
    with each point's distance until the farthest ones alone hold it (Lawson's algorithm).
    """
    first, second = across(near.normal)
    arm = points - near.centre
    along = arm @ near.normal
    offset = np.stack([arm @ first, arm @ second], axis=2)
    weight = np.full(along.shape, 1.0 / along.shape[1])
    narrowest = np.full(len(points), np.inf)
    for _ in range(LAWSON):
        middle = np.sum(weight * along, axis=1, keepdims=True)
        centre = np.einsum("bn,bni->bi", weight, offset)
        lever = weight * (along - middle)
        slope = np.einsum("bn,bni->bi", lever, offset) / np.sum(lever * along, axis=1)[:, None]
        gap = offset - centre[:, None] - slope[:, None] * (along - middle)[..., None]
        reach = np.linalg.norm(gap, axis=2)
        narrowest = np.minimum(narrowest, 2.0 * reach.max(axis=1))
        weight = weight * reach
        weight /= weight.sum(axis=1, keepdims=True)
    return narrowest
