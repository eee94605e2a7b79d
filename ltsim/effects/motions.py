"""What readings do when targets or stations move: exact, and first order. Shared by the effects that move things."""

import numpy as np

from ltsim.arrays import Floats
from ltsim.geometry.polar import to_face, to_polar, wrap
from ltsim.geometry.rigid import pose_design
from ltsim.geometry.rotations import from_rotation_vector
from ltsim.scene.sightings import Sightings


def exact_target_change(sightings: Sightings, displacement: Floats) -> Floats:
    """Change (n, 3) of the raw readings when each pointing's target moves by (n, 3) [m] in the network frame."""
    local = np.einsum("nji,nj->ni", sightings.rotation[sightings.station], displacement)
    return reading_change(sightings, sightings.local + local)


def exact_station_change(sightings: Sightings, motion: Floats) -> Floats:
    """Change (n, 3) of the raw readings when the station of each pointing moves by (n, 6).

    `motion` is a translation [m] and a rotation vector [rad] about the station's origin, both in the network frame.
    """
    turn = from_rotation_vector(motion[:, 3:]) @ sightings.rotation[sightings.station]
    local = np.einsum("nji,nj->ni", turn, sightings.arm - motion[:, :3])
    return reading_change(sightings, local)


def station_design(sightings: Sightings) -> Floats:
    """Change (n, 3, 6) of the raw readings per unit of the same motion, first order."""
    return pose_design(sightings.by_target, sightings.arm)


def reading_change(sightings: Sightings, local: Floats) -> Floats:
    """Change (n, 3) of the raw readings when the targets appear at (n, 3) [m] in the instruments' frames."""
    change: Floats = to_face(to_polar(local), sightings.face) - sightings.raw
    change[:, 1] = wrap(change[:, 1])
    return change
