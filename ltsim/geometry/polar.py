"""Conversion between points and readings of range, azimuth and elevation in both faces, and its derivatives.

In face 1 (front face) raw readings are range, azimuth, and elevation within +-90 deg. In face 2 (back face) the raw
encoder readings of the same point are azimuth + 180 deg and 180 deg - elevation.
"""

import numpy as np

from ltsim.core.arrays import Floats, Ints, stack_columns


def wrap_angle(angle: Floats) -> Floats:
    """Angles [rad] reduced by full turns to the interval (-pi, pi], with the shape of `angle`."""
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)


def to_polar(points: Floats) -> Floats:
    """Range [m], azimuth and elevation [rad] in face 1, (n, 3), of n points (n, 3) [m] in the instrument frame."""
    x, y, z = points.T
    horizontal = np.hypot(x, y)
    return stack_columns(np.hypot(horizontal, z), np.arctan2(y, x), np.arctan2(z, horizontal))


def from_polar(readings: Floats) -> Floats:
    """Points (n, 3) [m] in the instrument frame from n readings of range [m], azimuth and elevation [rad], (n, 3).

    The readings may be raw readings in face 1 or face 2: both give the same point.
    """
    range_, azimuth, elevation = readings.T
    horizontal = range_ * np.cos(elevation)
    return stack_columns(horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), range_ * np.sin(elevation))


def swap_front_and_raw(polar_coordinates: Floats, face: Ints) -> Floats:
    """Raw readings (n, 3) in the faces `face` (n,), 1 or 2, from readings in face 1 (n, 3), or the inverse conversion.

    Columns are range, azimuth and elevation [m, rad, rad]. In face 2, raw azimuth is azimuth + 180 deg and raw
    elevation 180 deg - elevation, so that the conversion is its own inverse.
    """
    raw = polar_coordinates.copy()
    is_back_face = face == 2
    raw[is_back_face, 1] = wrap_angle(polar_coordinates[is_back_face, 1] + np.pi)
    raw[is_back_face, 2] = np.pi - polar_coordinates[is_back_face, 2]
    return raw


def beam_frame_axes(azimuth: Floats, elevation: Floats) -> tuple[Floats, Floats, Floats]:
    """Unit vectors along n beams (outwards), to the left and upwards across them, each (n, 3), from angles in face 1.

    `azimuth` and `elevation` (n,) are in rad.
    """
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    zero = np.zeros_like(ca)
    beam = stack_columns(ce * ca, ce * sa, se)
    across = stack_columns(-sa, ca, zero)
    up = stack_columns(-se * ca, -se * sa, ce)
    return beam, across, up


def components_across_beam(vectors: Floats, points: Floats) -> Floats:
    """Components (n, 2) of n vectors (n, 3) across n beams: to the left, and upwards.

    The beams go from the origin of the instrument frame to `points` (n, 3) [m].
    """
    _, azimuth, elevation = to_polar(points).T
    _, across, up = beam_frame_axes(azimuth, elevation)
    return stack_columns(np.einsum("ni,ni->n", vectors, across), np.einsum("ni,ni->n", vectors, up))


def polar_jacobian(polar_coordinates: Floats, face: Ints) -> Floats:
    """Derivatives (n, 3, 3) of n raw readings with respect to the measured points in the instrument frame.

    `polar_coordinates` (n, 3) are range [m], azimuth and elevation [rad] in face 1, `face` (n,) is the face, 1 or 2,
    of each pointing.

    Axis 1 of the result counts the readings (range, azimuth, elevation), axis 2 the coordinates x, y, z. In face 2 the
    raw elevation is 180 deg minus the elevation, so that its row has the opposite sign.
    """
    range_, azimuth, elevation = polar_coordinates.T
    beam, across, up = beam_frame_axes(azimuth, elevation)
    sign = np.where(face == 2, -1.0, 1.0)
    across = across / (range_ * np.cos(elevation))[:, None]
    up = up * (sign / range_)[:, None]
    return stack_columns(beam, across, up)
