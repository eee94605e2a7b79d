from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE
from ltsim.geometry.rigid import VERTICAL
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_displacements
from ltsim.scene.sightings import Sightings


def reflector_axes(sightings: Sightings) -> Floats:
    """Axes (axial, side, up) of the reflector in each of n pointings, network frame: columns of matrices (n, 3, 3).

    Seen from the front of the reflector, `side` is horizontal to the right. The axial direction is the normal of the
    nest. For a reflector that is turned to the tracker, or in a nest with unknown normal, the axial direction points to
    the station.
    """
    normal = sightings.nest_normals[sightings.target]
    is_turned = sightings.is_reaimed[sightings.target] | ~np.isfinite(normal).all(axis=1)
    axial = np.where(is_turned[:, None], -sightings.beam_vectors[0], normal)
    lateral = np.cross(VERTICAL, axial)
    is_vertical = np.linalg.norm(lateral, axis=1) < 1e-6
    lateral[is_vertical] = [1.0, 0.0, 0.0]
    lateral /= np.linalg.norm(lateral, axis=1, keepdims=True)
    return np.stack([axial, lateral, np.cross(axial, lateral)], axis=2)


class SmrCentring(Effect):
    """Centring error of a reflector: the vertex of its mirrors is not at the centre of its sphere.

    The tracker measures the vertex, which is displaced from the centre by e = e_a axial + e_s side + e_u up, with unit
    vectors along the axis (perpendicular to the open face), to the right as seen from the front, and up. Let alpha be
    the angle of incidence to the axis and chi its direction around the axis. Then the correction (true value minus
    reading) of the range is Delta_d = e_a cos(alpha) + e_t sin(alpha) cos(chi - chi_0), where e_t and chi_0 are length
    and direction of the part of e across the axis. The lateral correction is minus the component of e across the beam.
    A fixed reflector has the same e in all pointings. A re-aimed reflector is turned so that its axis points to the
    tracker. Its axial part is then an error of the range zero. Its other parts are constant lateral lengths, the same
    in both faces, if a marker on the reflector is always up; otherwise they are noise.

    Size: 2.5 um in a good reflector, 12 to 25 um in a bad one.
    Similar to: for a fixed reflector, a displaced target (exactly); for a re-aimed reflector, range-offset (its axial
    part, exactly) and beam-offset (in one face).
    Separate by: the reflector turned by 4 x 90 deg in one nest, or swapped.
    Validity: up to 25 um; independent of the point where the beam meets the mirrors.
    Source: patent US 2015/0285615 A1 (run-out, and the marker that keeps it constant); Yan et al. 2010 (geometric
    errors of a spherically mounted reflector); the equation follows from a ray trace of three mirrors.
    Validation: validated: a fixed reflector against a displacement, the axial part of a re-aimed one against a range
    offset.
    """

    name = "smr-centring"
    light_path_stage = LightPathStage.TARGET
    covariates = ("incidence", "place")
    scope = "target"
    may_recur = True
    parameters = (
        Parameter("vertex-axial", "um", "displacement of the vertex outwards, along the axis", 15 * MICROMETRE),
        Parameter("vertex-side", "um", "displacement of the vertex to the right, seen from the front", 15 * MICROMETRE),
        Parameter("vertex-up", "um", "displacement of the vertex upwards", 15 * MICROMETRE),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Effects that a diagnosis tries: one reflector carried to all targets, or a separate one at each target."""
        return [cls(), *(cls((), (name,)) for name in sightings.target_names)]

    def design(self, sightings: Sightings) -> Floats:
        return design_from_displacements(
            sightings, reflector_axes(sightings) * self.pointing_indicator(sightings)[:, None, None]
        )
