"""Reflectors that are not where they should be, or not seen there."""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Parameter, Stage, along_axes
from ltsim.effects.motions import TargetMotion
from ltsim.effects.places import gaps_near, start_time, visit_change_times, visited_pairs
from ltsim.scene.sightings import Sightings
from ltsim.units import FACTOR, MICROMETRE, MILLIMETRE

INDEX = 1.5
SHARES = (0.25, 0.12)
"""Lengths of the runs that are tried, as shares of a station's targets."""
TURNS = (-0.15, -0.05, 0.05, 0.15)
"""[rad] by which a pane is turned in refinement."""


def _around(sightings: Sightings, station: str) -> list[int]:
    """Targets that a station measured, in the order of their azimuths."""
    s = sightings.station_names.index(station)
    arm = sightings.points - sightings.position[s]
    seen = np.unique(sightings.target[sightings.station == s])
    return [int(t) for t in seen[np.argsort(np.arctan2(arm[seen, 1], arm[seen, 0]))]]


@dataclass(frozen=True)
class Window(TargetMotion):
    """Window in the path: a pane of glass stands between a station and some of its targets.

    With i the angle at the pane: range + w (sqrt(n^2 - sin^2 i) - cos i), lateral w sin i (1 - cos i / sqrt(n^2 - sin^2
    i)) away from the normal. The parameter is the thickness w (no correction of a reading).

    Size: 3 mm give 1.500 mm of range at normal incidence and 1.645 mm at 30 deg, and 0.58 mm across.
    Like: range-step over the whole visit (if all targets are behind it), smr-offset.
    Separate by: the window taken away.
    Valid: plane parallel glass of index 1.5, anywhere on the path.
    Source: Born and Wolf, Principles of Optics (refraction at a plane-parallel plate), derived here from Snell's law.
    Status: validated against the numbers above.
    """

    normal: tuple[float, float, float] = (0.0, 0.0, 0.0)

    name = "window"
    stage = Stage.AIR
    covariates = ("azimuth", "incidence")
    scope = "pointing"
    ways = 2
    parameters = (Parameter("thickness", "mm", "thickness of the glass", 3 * MILLIMETRE, positive=True),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """At every station an upright pane across runs of neighbouring targets, in the order of their azimuths."""
        found = []
        for station in sightings.station_names:
            order = _around(sightings, station)
            for share in SHARES:
                length = max(2, round(share * len(order)))
                for first in range(0, len(order), max(1, length // 2)):
                    block = [order[(first + k) % len(order)] for k in range(min(length, len(order)))]
                    found += cls._across(sightings, station, block)
        return found

    @classmethod
    def _across(cls, sightings: Sightings, station: str, block: list[int]) -> list[Self]:
        """A pane square to the middle of a run of targets; none where the run has no middle."""
        arm = sightings.points[block] - sightings.position[sightings.station_names.index(station)]
        across = arm[:, :2].sum(axis=0)
        if len(block) < 2 or not np.linalg.norm(across) > 0:
            return []
        x, y = (float(v) for v in across / np.linalg.norm(across))
        return [cls((station,), tuple(sightings.target_names[t] for t in sorted(block)), (x, y, 0.0))]

    def finer(self, sightings: Sightings) -> list[Self]:
        """One target more or less at either end of the run; the pane turned a little."""
        order = _around(sightings, self.stations[0])
        behind = {sightings.target_names.index(name) for name in self.targets}
        inside = [t in behind for t in order]
        found: list[Self] = []
        for k, t in enumerate(order):
            at_edge = inside[k] != inside[k - 1] or inside[k] != inside[(k + 1) % len(order)]
            if at_edge:
                found += self._across(sightings, self.stations[0], sorted(behind ^ {t}))
        x, y, _ = self.normal
        turned = [np.arctan2(y, x) + angle for angle in TURNS]
        return found + [self.reshaped(normal=(float(np.cos(a)), float(np.sin(a)), 0.0)) for a in turned]

    def displacement(self, sightings: Sightings) -> Floats:
        """Displacement (n, 3, 1) of the target that the readings describe, per unit of thickness."""
        beam = sightings.unit_vectors[0]
        normal = np.broadcast_to(np.asarray(self.normal), beam.shape) if any(self.normal) else beam
        cosine = np.sum(beam * normal, axis=1)[:, None]
        normal, cosine = normal * np.sign(cosine), np.abs(cosine)
        inside = np.sqrt(INDEX**2 - 1.0 + cosine**2)
        longer = (inside - cosine) * beam
        aside = (1.0 - cosine / inside) * (cosine * beam - normal)
        return ((longer + aside) * self.mask(sightings)[:, None])[:, :, None]


@dataclass(frozen=True)
class SmrOffset(TargetMotion):
    """Another reflector or adaptor: at one station a ball of another radius was used, and the old constant kept.

    D = (R_true - R_used) n along the nest's normal n. The parameter is the motion of the sphere's centre away from the
    nest (no correction of a reading).

    Size: 12.7 mm for 1.5 in taken for 0.5 in, 7.94 mm for 7/8 in: one of a few catalogue lengths.
    Like: nest-lift of many targets at once, a station-bump along a wall's normal.
    Separate by: nothing is needed, the size tells.
    Valid: nests with a known normal. At all stations alike it moves the targets, and only the gauge would show it.
    Source: nominal radii of reflectors: 1.5, 7/8 and 0.5 in across.
    Status: first order validated against the exact motion.
    """

    name = "smr-offset"
    stage = Stage.TARGET
    covariates = ("incidence", "place")
    scope = "station"
    parameters = (Parameter("radius-difference", "mm", "radius of the ball used, less that assumed", 5 * MILLIMETRE),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every station, where nests are known."""
        known = np.isfinite(sightings.nest_normal).all(axis=1).any()
        return [cls((name,)) for name in sightings.station_names] if known else []

    def displacement(self, sightings: Sightings) -> Floats:
        """Motion (n, 3, 1) of each pointing's sphere per unit of radius."""
        normal = np.nan_to_num(sightings.nest_normal[sightings.target])
        return (normal * self.mask(sightings)[:, None])[:, :, None]


SIZE = 50 * MICROMETRE
MOST_PAIRS = 600
"""Pairs of station and target beyond which no network is searched for single seatings: the w-test finds them."""


@dataclass(frozen=True)
class NestLift(TargetMotion):
    """Badly seated reflector: dirt or a burr lifts it in its nest during one visit of one station.

    D = h n along the nest's normal (kind `normal`), or any direction (kind `free`: a cone or three balls push
    sideways). The parameters are the motion of the reflector (no correction of a reading); all three readings of that
    visit share it.

    Size: 4 um in a clean nest, 5 to 50 um with dirt.
    Like: outlier in one reading (0.85).
    Separate by: reseating and repeating; a lift hits all three readings in a fixed direction.
    Valid: 5 to 200 um; one seating a visit, so both faces and all repeats share it.
    Source: Hughes et al. 2011, Meas. Sci. Technol. 22, 045103, doi:10.1088/0957-0233/22/4/045103 (repeatability of
    nests, second hand); Baarda 1968, A testing procedure for use in geodetic networks (its smallest detectable size).
    Status: first order validated against the exact motion.
    """

    kind: Literal["normal", "free"] = "normal"

    name = "nest-lift"
    stage = Stage.TARGET
    covariates = ("place",)
    scope = "pointing"
    plural = True
    parameters = (Parameter("lift", "um", "lift of the reflector along the nest's normal", SIZE),)

    def __post_init__(self) -> None:
        if self.kind == "free":
            moved = along_axes("lift", "um", "motion of the reflector along", SIZE)
            object.__setattr__(self, "parameters", moved)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every pair of station and target, free and, where the nest is known, along its normal."""
        pairs = visited_pairs(sightings)
        if len(pairs) > MOST_PAIRS:
            return []
        known = np.flatnonzero(np.isfinite(sightings.nest_normal).all(axis=1))
        nests = {sightings.target_names[t] for t in known}
        along = [cls((s,), (t,), "normal") for s, t in pairs if t in nests]
        return [*along, *(cls((s,), (t,), "free") for s, t in pairs)]

    def displacement(self, sightings: Sightings) -> Floats:
        """Motion (n, 3, p) of each pointing's reflector per unit."""
        acts = self.mask(sightings)[:, None, None]
        if self.kind == "free":
            return acts * np.eye(3)
        normal: Floats = np.nan_to_num(sightings.nest_normal[sightings.target])[:, :, None]
        return acts * normal


MOST_STEPS = 8
STEP, RATE = 60 * MICROMETRE, 40 * FACTOR["um/h"]


@dataclass(frozen=True)
class TargetMoved(TargetMotion):
    """Moved target: a nest is knocked, or its support creeps.

    step: P(t) = P + H(t - t_m) D. creep: P(t) = P + v (t - t_0), t_0 the first pointing. The parameters are the motion
    of the target in the network frame (no correction of a reading), the same as seen from all stations.

    Size: 10 to 100 um.
    Like: nest-lift, where the target was seen from one station afterwards.
    Separate by: the target measured first and last from each station.
    Valid: one step a target, between two stations' visits.
    Source: general knowledge of networks; Baarda 1968, A testing procedure for use in geodetic networks (its smallest
    detectable size).
    Status: first order validated against the exact motion.
    """

    time: float = 0.0
    kind: Literal["step", "creep"] = "step"

    name = "target-moved"
    stage = Stage.TARGET
    covariates = ("time",)
    scope = "target"
    plural = True
    parameters = along_axes("moved", "um", "motion of the target along", STEP)

    def __post_init__(self) -> None:
        if self.kind == "creep":
            rates = along_axes("creep", "um/h", "speed of the target along", RATE)
            object.__setattr__(self, "parameters", rates)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every target with a step between any two of its visits, and with a creep."""
        found = []
        for t, name in enumerate(sightings.target_names):
            steps = visit_change_times(sightings, t, most=MOST_STEPS)
            found += [cls((), (name,), time) for time in steps]
            found += [cls((), (name,), kind="creep")] if len(steps) > 1 else []
        return found

    def finer(self, sightings: Sightings) -> list[Self]:
        """For a step the gaps between pointings around this one, inside the stations' visits too."""
        times = sightings.time[self.mask(sightings) > 0]
        return [self.reshaped(time=t) for t in gaps_near(times, self.time)] if self.kind == "step" else []

    def displacement(self, sightings: Sightings) -> Floats:
        """Share (n, 3, 3) of the motion that each pointing's target has made, or time [s] since the start."""
        made = sightings.time >= self.time if self.kind == "step" else sightings.time - start_time(sightings)
        return (self.mask(sightings) * made)[:, None, None] * np.eye(3)
