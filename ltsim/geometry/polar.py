"""Conversion between points and readings of range, azimuth and elevation in either face, and its derivatives.

Face 1 is the front: elevation within +-90 deg. Face 2 holds raw encoder values: azimuth + 180 deg and
180 deg - elevation.
"""

import numpy as np

from ltsim.core.arrays import Floats, Ints, stack_columns


def wrap_angle(angle: Floats) -> Floats:
    """Angles [rad] reduced by full turns to the interval (-pi, pi], with the shape of `angle`."""
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)


def to_polar(points: Floats) -> Floats:
    """Front-face range [m], azimuth and elevation [rad], (n, 3), of n points (n, 3) [m] in the instrument frame."""
    x, y, z = points.T
    horizontal = np.hypot(x, y)
    return stack_columns(np.hypot(horizontal, z), np.arctan2(y, x), np.arctan2(z, horizontal))


def from_polar(readings: Floats) -> Floats:
    """Points (n, 3) [m] in the instrument frame from n readings of range [m], azimuth and elevation [rad], (n, 3).

    Raw face-2 values give the same point as face-1 values.
    """
    range_, azimuth, elevation = readings.T
    horizontal = range_ * np.cos(elevation)
    return stack_columns(horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), range_ * np.sin(elevation))


def to_face(polar_coordinates: Floats, face: Ints) -> Floats:
    """Raw readings (n, 3) of n pointings in the faces `face` (n,), 1 or 2, from front-face coordinates (n, 3).

    The function is its own inverse: it also converts raw readings to front-face values.
    """
    raw = polar_coordinates.copy()
    is_back_face = face == 2
    raw[is_back_face, 1] = wrap_angle(polar_coordinates[is_back_face, 1] + np.pi)
    raw[is_back_face, 2] = np.pi - polar_coordinates[is_back_face, 2]
    return raw


def unit_vectors(azimuth: Floats, elevation: Floats) -> tuple[Floats, Floats, Floats]:
    """Unit vectors along n beams (outwards), to their left and upwards, each (n, 3), from front-face angles [rad]."""
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    zero = np.zeros_like(ca)
    beam = stack_columns(ce * ca, ce * sa, se)
    across = stack_columns(-sa, ca, zero)
    up = stack_columns(-se * ca, -se * sa, ce)
    return beam, across, up


def components_across_beam(vectors: Floats, points: Floats) -> Floats:
    """Components (n, 2) of n vectors (n, 3) perpendicular to the beam: to the left of it, and upwards across it.

    The beam of each vector goes from the origin of the instrument to its point (n, 3) [m].
    """
    _, azimuth, elevation = to_polar(points).T
    _, across, up = unit_vectors(azimuth, elevation)
    return stack_columns(np.einsum("ni,ni->n", vectors, across), np.einsum("ni,ni->n", vectors, up))


def polar_jacobian(polar_coordinates: Floats, face: Ints) -> Floats:
    """Derivative (n, 3, 3) of n raw readings with respect to the points measured, in the instrument frame.

    `polar_coordinates` (n, 3) are the front-face range [m], azimuth and elevation [rad] of the n points, `face` (n,) is
    the face of each pointing.

    Axis 1 of the result is the reading (range, azimuth, elevation), axis 2 the coordinate. On face 2 the raw elevation
    is 180 deg minus the elevation, so that its row has the opposite sign.
    """
    range_, azimuth, elevation = polar_coordinates.T
    beam, across, up = unit_vectors(azimuth, elevation)
    sign = np.where(face == 2, -1.0, 1.0)
    across = across / (range_ * np.cos(elevation))[:, None]
    up = up * (sign / range_)[:, None]
    return stack_columns(beam, across, up)
