from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects.effect import LightPathStage, Parameter
from ltsim.physics.effects.motions import TargetDisplacementEffect
from ltsim.scene.sightings import Sightings

GLASS_REFRACTIVE_INDEX = 1.5
"""Refractive index of glass."""
CANDIDATE_PANE_TARGET_FRACTIONS = (0.25, 0.12)
"""Numbers of neighbouring targets behind a glass pane that a diagnosis tries, as fractions of the number of targets
that the station measured."""
CANDIDATE_PANE_ROTATIONS = (-0.15, -0.05, 0.05, 0.15)
"""Rotations [rad] of a glass pane about the vertical that a local search tries."""


def _targets_in_azimuth_order(sightings: Sightings, station: str) -> list[int]:
    """Indices of the targets that a station measured, in the order of their azimuths."""
    s = sightings.station_names.index(station)
    arm = sightings.target_points - sightings.station_positions[s]
    sighted = np.unique(sightings.target[sightings.station == s])
    return [int(t) for t in sighted[np.argsort(np.arctan2(arm[sighted, 1], arm[sighted, 0]))]]


@dataclass(frozen=True)
class Window(TargetDisplacementEffect):
    """Window in the path: a pane of glass is between a station and some of its targets.

    The range is too long by w (sqrt(n^2 - sin^2 i) - cos i), with the thickness w, the refractive index n and the angle
    of incidence i at the pane. The target appears displaced by w sin i (1 - cos i / sqrt(n^2 - sin^2 i)) across the
    beam, away from the pane's normal. The parameter is w (no correction of a reading).

    Size: a pane of 3 mm changes the range by 1.500 mm at normal incidence and by 1.645 mm at 30 deg, where it displaces
    the target by 0.58 mm across the beam.
    Similar to: range-step at the start of the station (if all its targets are behind the pane), smr-offset.
    Separate by: the glass pane removed.
    Validity: plane-parallel glass of index 1.5, anywhere on the path.
    Source: Born and Wolf, Principles of Optics (refraction at a plane-parallel plate), derived here from Snell's law.
    Validation: validated against the numbers above.
    """

    pane_normal: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Unit normal of the glass pane in the network frame."""

    name = "window"
    base_rate = 0.5
    light_path_stage = LightPathStage.AIR
    covariates = ("azimuth", "incidence")
    scope = "pointing"
    n_neighbour_directions = 2
    parameters = (Parameter("thickness", "mm", "thickness of the glass", 3 * MILLIMETRE, is_nonnegative=True),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Upright glass panes that a diagnosis tries, at each station in front of targets with similar azimuths."""
        candidates = []
        for station in sightings.station_names:
            order = _targets_in_azimuth_order(sightings, station)
            for share in CANDIDATE_PANE_TARGET_FRACTIONS:
                length = max(2, round(share * len(order)))
                for first in range(0, len(order), max(1, length // 2)):
                    block = [order[(first + k) % len(order)] for k in range(min(length, len(order)))]
                    candidates += cls._panes_across_sights(sightings, station, block)
        return candidates

    @classmethod
    def _panes_across_sights(cls, sightings: Sightings, station: str, target_sequence: list[int]) -> list[Self]:
        """List with an upright glass pane perpendicular to the direction from a station to the middle of some targets.

        `target_sequence` are the indices of the targets behind the pane. The list is empty if their middle is
        undefined.
        """
        arm = (
            sightings.target_points[target_sequence]
            - sightings.station_positions[sightings.station_names.index(station)]
        )
        across = arm[:, :2].sum(axis=0)
        if len(target_sequence) < 2 or not np.linalg.norm(across) > 0:
            return []
        x, y = (float(v) for v in across / np.linalg.norm(across))
        return [cls((station,), tuple(sightings.target_names[t] for t in sorted(target_sequence)), (x, y, 0.0))]

    def neighbours(self, sightings: Sightings) -> list[Self]:
        """Similar panes that a local search tries: rotated, or with one target more or fewer behind either edge."""
        order = _targets_in_azimuth_order(sightings, self.stations[0])
        behind = {sightings.target_names.index(name) for name in self.targets}
        inside = [t in behind for t in order]
        windows: list[Self] = []
        for k, t in enumerate(order):
            at_edge = inside[k] != inside[k - 1] or inside[k] != inside[(k + 1) % len(order)]
            if at_edge:
                windows += self._panes_across_sights(sightings, self.stations[0], sorted(behind ^ {t}))
        x, y, _ = self.pane_normal
        angles = [np.arctan2(y, x) + angle for angle in CANDIDATE_PANE_ROTATIONS]
        return windows + [
            self.with_shape_parameters(pane_normal=(float(np.cos(a)), float(np.sin(a)), 0.0)) for a in angles
        ]

    def displacement(self, sightings: Sightings) -> Floats:
        acts = np.flatnonzero(self.pointing_indicator(sightings))
        beam = sightings.beam_vectors[0][acts]
        normal = np.broadcast_to(np.asarray(self.pane_normal), beam.shape) if any(self.pane_normal) else beam
        cosine = np.sum(beam * normal, axis=1)[:, None]
        normal, cosine = normal * np.sign(cosine), np.abs(cosine)
        inside = np.sqrt(GLASS_REFRACTIVE_INDEX**2 - 1.0 + cosine**2)
        longer = (inside - cosine) * beam
        aside = (1.0 - cosine / inside) * (cosine * beam - normal)
        displacement = np.zeros((len(sightings), 3, 1))
        displacement[acts, :, 0] = longer + aside
        return displacement
