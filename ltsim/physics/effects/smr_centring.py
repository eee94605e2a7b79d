from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE
from ltsim.geometry.rigid import VERTICAL
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_displacements
from ltsim.scene.sightings import Sightings


def reflector_axes(sightings: Sightings) -> Floats:
    """Axes (axial, side, up) of the reflector of each of n pointings, network frame, as columns of matrices (n, 3, 3).

    The axis of a re-aimed reflector, or of one in an unknown nest, points to the station; otherwise it is the nest's
    normal.
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

    The tracker measures the vertex, which is displaced from the centre by e = e_a axial + e_s side + e_u up; the unit
    vector axial is perpendicular to the open face. With the incidence angle alpha to this vector and its direction chi
    around it, Delta_d = e_a cos(alpha) + e_t sin(alpha) cos(chi - chi_0), where e_t and chi_0 are length and direction
    of the part across the axis; the lateral correction is the component of -e across the beam. A fixed reflector has
    the same e in all pointings. The axis of a re-aimed reflector points to the tracker. Its axial part is therefore an
    error of the range zero, and the other parts are constant lateral lengths that are the same on both faces, if the
    marker on the reflector is always up. Otherwise these parts are noise.

    Size: 2.5 um in a good reflector, 12 to 25 um in a bad one.
    Like: fixed: the target's position, exactly. Re-aimed: range-offset, exactly (axial, all); beam-offset (one face).
    Separate by: the reflector turned by 4 x 90 deg in one nest, or swapped.
    Valid: up to 25 um; independent of the point where the beam meets the mirrors.
    Source: patent US 2015/0285615 A1 (run-out, and the marker that keeps it constant); Yan et al. 2010 (geometric
    errors of a spherically mounted reflector); the equation follows from a ray trace of three mirrors.
    Status: validated: a fixed reflector against a displacement, the axial part of a re-aimed one against a range
    offset.
    """

    name = "smr-centring"
    light_path_stage = LightPathStage.TARGET
    covariates = ("incidence", "place")
    scope = "target"
    may_recur = True
    parameters = (
        Parameter("vertex-axial", "um", "displacement of the vertex outwards, along the axis", 15 * MICROMETRE),
        Parameter("vertex-side", "um", "displacement of the vertex to the side, horizontally", 15 * MICROMETRE),
        Parameter("vertex-up", "um", "displacement of the vertex upwards", 15 * MICROMETRE),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Effects that a diagnosis tries: one reflector carried to all targets, and a separate reflector per target."""
        return [cls(), *(cls((), (name,)) for name in sightings.target_names)]

    def design(self, sightings: Sightings) -> Floats:
        return design_from_displacements(
            sightings, reflector_axes(sightings) * self.pointing_indicator(sightings)[:, None, None]
        )
