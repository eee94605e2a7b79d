"""Exact model of a tracker with 16 constants and two faces; each pointing has its own pose, target and constants.

Raw readings (d, a, e) describe this point in the frame of the tracker, with x forward at azimuth zero and z up:

    a' = a + A1 cos a + B1 sin a + A2 cos 2a + B2 sin 2a
    e' = e + index + C1 cos e + D1 sin e + C2 cos 2e + D2 sin 2e
    d' = d (1 + scale) + zero
    forward = d' cos(c) cos e' - b_v sin e'          beam tilt c to the left, vertical beam offset b_v
    height  = d' cos(c) sin e' + b_v cos e'
    left    = d' sin(c) + b_l                        lateral beam offset b_l
    left, height rotated by the transit tilt about the forward axis; transit offset added to forward;
    forward, left rotated by a' about the standing axis.

Each constant is a correction, which is added to a reading or to a zero of the tracker to get the true value. On the
back face the raw readings are (d, a + pi, pi - e); the signs of the errors on the back face follow from this.
Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35 (errors); Loser and Kyle 1998 (beam and axes).
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_CIRCLES = [f"{circle}-{order}" for circle in ("azimuth", "elevation") for order in ("eccentricity", "second-order")]
CONSTANTS = (
    *("range-offset", "range-scale", "transit-offset", "beam-offset-lateral", "beam-offset-vertical"),
    *("beam-tilt", "transit-tilt", "vertical-index", *(f"{c}-{wave}" for c in _CIRCLES for wave in ("cos", "sin"))),
)
ARCSECOND = np.pi / 648_000
GUARANTEED = np.array([10e-6, 2e-6, *[20e-6] * 3, *[3 * ARCSECOND] * 11])
"""(16,) [m, 1, rad] Standard deviations of the constants by a maker's guarantee, the default prior of a recording."""
STEPS = 8


def described(raw: Array, constants: Array) -> Array:
    """Points (n, 3) [m] in the tracker frame for raw readings (n, 3) [m, rad, rad] and constants (n, 16)."""
    d, a, e = raw.T
    zero, scale, transit, lateral, vertical, beam, tilt, index, a1, b1, a2, b2, c1, d1, c2, d2 = constants.T
    azimuth = a + a1 * np.cos(a) + b1 * np.sin(a) + a2 * np.cos(2 * a) + b2 * np.sin(2 * a)
    elevation = e + index + c1 * np.cos(e) + d1 * np.sin(e) + c2 * np.cos(2 * e) + d2 * np.sin(2 * e)
    length = d * (1 + scale) + zero
    along = length * np.cos(beam)
    forward = along * np.cos(elevation) - vertical * np.sin(elevation) + transit
    height = along * np.sin(elevation) + vertical * np.cos(elevation)
    across = length * np.sin(beam) + lateral
    across, height = (
        across * np.cos(tilt) - height * np.sin(tilt),
        across * np.sin(tilt) + height * np.cos(tilt),
    )
    x = forward * np.cos(azimuth) - across * np.sin(azimuth)
    y = forward * np.sin(azimuth) + across * np.cos(azimuth)
    return np.stack([x, y, height], axis=1)


def sphere(points: Array) -> Array:
    """Distance [m], azimuth and elevation [rad] (n, 3) of points (n, 3) [m]."""
    x, y, z = points.T
    return np.stack([np.sqrt(x * x + y * y + z * z), np.arctan2(y, x), np.arctan2(z, np.sqrt(x * x + y * y))], axis=1)


def within_a_turn(angle: Array) -> Array:
    """Angle [rad] reduced to the interval from -pi to pi."""
    return np.asarray(np.arctan2(np.sin(angle), np.cos(angle)))


def readings_of(local: Array, back: NDArray[np.bool_], constants: Array) -> Array:
    """Raw readings (n, 3) of points (n, 3) [m] in the frame of the tracker; `back` (n,) is True on the back face.

    The model is inverted by fixed-point iteration, which converges because the errors are small.
    """
    true = sphere(local)
    raw = true.copy()
    raw[back, 1] += np.pi
    raw[back, 2] = np.pi - raw[back, 2]
    sign = np.where(back, -1.0, 1.0)
    for _ in range(STEPS):
        missing = true - sphere(described(raw, constants))
        raw += np.stack([missing[:, 0], within_a_turn(missing[:, 1]), sign * missing[:, 2]], axis=1)
    raw[:, 1] = within_a_turn(raw[:, 1])
    return raw


def turned(vectors: Array, about: Array) -> Array:
    """Vectors (n, 3) rotated by rotation vectors (n, 3) [rad]."""
    return np.asarray(Rotation.from_rotvec(about).apply(vectors))


@dataclass(frozen=True)
class Change:
    """Change of each pointing by a cause of size one: arrays (n, 3), constants (n, 16); None for no change."""

    reading: Array | None = None
    """Change of raw range, azimuth, elevation [m, rad, rad]."""
    target: Array | None = None
    """Displacement [m] of the target in the network frame."""
    station: Array | None = None
    """Displacement [m] of the station in the network frame."""
    turn: Array | None = None
    """Rotation vector [rad] of the station in the network frame."""
    constants: Array | None = None
    variance: Array | None = None
    """Variance added to the readings, relative to their declared variance."""
    lengths: Array | None = None
    """(g,) [m] Error of the certified reference lengths."""

    def scaled(self, factor: float) -> Self:
        """Change multiplied by a factor."""
        return replace(self, **{name: factor * part for name, part in self.parts.items()})

    @property
    def parts(self) -> dict[str, Array]:
        """Arrays of the change that are not None, by name."""
        return {name: part for name, part in vars(self).items() if part is not None}

    def __add__(self, other: Self) -> Self:
        """Sum of two changes."""
        names = self.parts.keys() | other.parts.keys()
        return type(self)(**{n: self.parts.get(n, 0.0) + other.parts.get(n, 0.0) for n in sorted(names)})


NOTHING = Change()


@dataclass(frozen=True)
class Pointings:
    """n pointings with S stations, T targets and K trackers, and their true values; SI units."""

    station: Index
    target: Index
    tracker: Index
    face: Index
    repeat: Index
    """Indices (n,) of station, target and tracker, and numbers (n,) of face and repeat."""
    time: Array
    """(n,) [s] Time, increasing in the order of the measurements."""
    position: Array
    """(S, 3) [m] Positions of the stations."""
    rotation: Array
    """(S, 3, 3) Rotations from the tracker frame to the network frame."""
    points: Array
    """(T, 3) [m] Targets."""
    constants: Array
    """(K, 16) Constants of each tracker."""

    def __len__(self) -> int:
        return len(self.station)

    def local(self, change: Change = NOTHING) -> Array:
        """(n, 3) [m] Targets in the frame of the tracker."""
        arm = self.points[self.target] - self.position[self.station]
        arm = arm if change.target is None else arm + change.target
        arm = arm if change.station is None else arm - change.station
        arm = arm if change.turn is None else turned(arm, -change.turn)
        return np.asarray((arm[:, None, :] @ self.rotation[self.station])[:, 0])

    @property
    def local_points(self) -> Array:
        """(n, 3) Range [m], azimuth and elevation [rad] of an ideal tracker on the front face."""
        return sphere(self.local())

    def readings(self, change: Change = NOTHING) -> Array:
        """(n, 3) [m, rad, rad] Raw readings without noise."""
        constants = self.constants[self.tracker]
        constants = constants if change.constants is None else constants + change.constants
        raw = readings_of(self.local(change), self.face == 2, constants)
        raw = raw if change.reading is None else raw + change.reading
        raw[:, 1] = within_a_turn(raw[:, 1])
        return raw
