"""What changes with the time and with heat."""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.effects.effect import Effect, Parameter, ShapeParameter, Stage, along_axes
from ltsim.effects.motions import StationMotion, TargetMotion
from ltsim.effects.places import Drift, start_time
from ltsim.scene.sightings import Sightings
from ltsim.units import FACTOR, MICROMETRE, MICRORADIAN, PPM


@dataclass(frozen=True)
class IndexDrift(Drift):
    """Drift of the vertical index: the head warms up and the zero of the elevation circle moves.

    Correction of the raw elevation = r t (anew in every visit, or over the recording) or A exp(-t / tau). It flips with
    the face in front-face terms, as the index does.

    Size: under 2 urad/h after the warm-up; tens of urad over two hours from cold.
    Like: the index itself (0.63 / 0.86) and elevation-second-order cosine (0.84) where points are taken level by level;
    station-settling.
    Separate by: a random order of the targets, the first three again before leaving, two faces.
    Valid: the same law at every station, or one station's own; time constants of 10 min to 4 h.
    Source: Pollack Periodica 15(3), 2020, on the warm-up of a Leica AT960 (size); patents GB 2497910 B and US 8511891
    (the two-face error followed over time measures stability).
    Status: validated against the vertical index at a given time, face parity and sign.
    """

    name = "index-drift"
    stage = Stage.ENCODERS
    observables = ("elevation",)
    slot = "elevation"
    rate = Parameter("index-drift", "urad/h", "growth of the index", 20 * FACTOR["urad/h"])
    amplitude = Parameter("index-drift-amplitude", "urad", "index at the start, dying away", 20 * MICRORADIAN)
    parameters = (rate,)

    laws = ("linear", "visit")
    alone = True


@dataclass(frozen=True)
class AzimuthDrift(Drift):
    """Drift of the azimuth zero: the base or the tripod's head turns, the circle warms.

    Correction of the azimuth = r t (in every visit, or in one) or A exp(-t / tau). The station's yaw takes the mean, so
    only the change within a visit is seen: a linear drift over the recording and one in every visit are the same.

    Size: under 2 urad/h after the warm-up; tens of urad over two hours from cold, or on an unsteady stand.
    Like: transit-tilt (0.67 / 0) where points are taken level by level.
    Separate by: a random order of the targets, the first three again before leaving.
    Valid: the same law at every station, or one station's own; time constants of 10 min to 4 h.
    Source: Pollack Periodica 15(3), 2020, on the warm-up of a Leica AT960 (size); Dvořáček 2016, Acta Polytechnica 56,
    88-98 (tests of a Leica AT401).
    Status: validated against the azimuth slot at a given time, and the equality of both linear laws up to yaw.
    """

    name = "azimuth-drift"
    stage = Stage.ENCODERS
    observables = ("azimuth",)
    slot = "azimuth"
    rate = Parameter("azimuth-drift", "urad/h", "growth of the correction", 20 * FACTOR["urad/h"])
    amplitude = Parameter("azimuth-drift-amplitude", "urad", "correction at the start, dying away", 20 * MICRORADIAN)
    parameters = (rate,)

    laws = ("visit",)
    alone = True


MOVES = [3, 4, 2]
"""Components of a station's motion: rotation about x, about y, translation along z."""


@dataclass(frozen=True)
class StationSettling(StationMotion):
    """Settling of a station: tripod, stand or floor give way after the set-up, or the stand warms.

    pose(t) = pose + (1 - exp(-t_i / tau)) (tilts, height), t_i since the station's first pointing. The parameters are
    the final motion of the station itself in the network frame (no correction of a reading): rotation vectors about x
    and y through its origin, and up. It starts anew at the next station and is the same on both faces.

    Size: under 1 urad on a good stand, 5 to 20 urad over 10 to 20 min on a bad one; a steel stand of 1.2 m grows 14
    um/K.
    Like: index-drift (one face), air-layer.
    Separate by: two faces; the first targets again before leaving; a level on the head.
    Valid: time constants of 2 to 40 min.
    Source: the user manual of SpatialAnalyzer (drift check); the exponential is a choice.
    Status: first order validated against the exact motion.
    """

    time_constant: float = 600.0

    name = "station-settling"
    stage = Stage.STATION
    covariates = ("time",)
    scope = "station"
    parameters = (
        Parameter("tilt-x", "urad", "final turn of the station about the network's x axis", 15 * MICRORADIAN),
        Parameter("tilt-y", "urad", "final turn of the station about the network's y axis", 15 * MICRORADIAN),
        Parameter("rise", "um", "final rise of the station", 20 * MICROMETRE),
    )
    shape = (
        ShapeParameter(
            "time_constant", "min", "time constant after the set-up", 120.0, 2400.0, logarithmic=True, steps=5
        ),
    )

    def motion(self, sightings: Sightings) -> Floats:
        """Motion (n, 6, 3) already made, per unit of the final one."""
        settled = self.mask(sightings) * (1.0 - np.exp(-sightings.station_time / self.time_constant))
        return settled[:, None, None] * np.eye(6)[:, MOVES]


MODES = {"uniform": np.ones(3), "vertical": np.array([0.0, 0.0, 1.0])}


@dataclass(frozen=True)
class MeshExpansion(TargetMotion):
    """Thermal expansion of the mesh: walls and floor carry the targets along as the hall warms.

    P(t) = P + a t A (P - centroid), t since the first pointing, A = 1 (uniform) or the z axis alone (vertical). The
    parameter is the growth of the structure itself (no correction of a reading).

    Size: steel and concrete grow 11 to 12 ppm/K, 69 um over 6 m and 1 K: often more than all errors of the tracker.
    Like: refractivity-drift and station-weather (uniform mode, exact where it grows between visits), range-drift
    (0.955).
    Separate by: thermometers on the structure; a gauge of another material read at each station; the first station
    again.
    Valid: linear over the recording; the fixed point does not matter, poses take a common motion.
    Source: Bryan 1990, International status of thermal error research, CIRP Annals 39, 645-656; the law is derived
    here.
    Status: first order validated against the exact motion, and against the range scale drift in the network.
    """

    mode: Literal["uniform", "vertical"] = "uniform"

    name = "mesh-expansion"
    stage = Stage.TARGET
    covariates = ("time", "place")
    parameters = (Parameter("mesh-expansion", "ppm/h", "growth of the structure", 10 * FACTOR["ppm/h"]),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Both modes."""
        return [cls(mode="uniform"), cls(mode="vertical")]

    def displacement(self, sightings: Sightings) -> Floats:
        """Motion (n, 3, 1) of each pointing's target per unit of the rate."""
        since = self.mask(sightings) * (sightings.time - start_time(sightings))
        arm = sightings.points[sightings.target] - sightings.points.mean(axis=0)
        return (since[:, None] * arm * MODES[self.mode])[:, :, None]


@dataclass(frozen=True)
class GaugeScale(Effect):
    """Scale of the gauge: its temperature or its coefficient of expansion is wrong.

    True length = stated length (1 + s); a stated length changes by -s L. No reading changes.

    Size: a coefficient from a table is wrong by some percent, 8 ppm for aluminium over 7 K; a gauge one kelvin off 23
    ppm.
    Like: range-scale, one index of air for all, a uniform warming of the mesh: exactly.
    Separate by: a thermometer on the gauge; a bar of another material; a maker's guarantee on the range scale.
    Valid: all known lengths share one gauge.
    Source: Sensors 2021, 21, 7479, doi:10.3390/s21227479, eq. 15, which lacks the length: L (1 + a dT) is meant.
    Status: validated on the known lengths.
    """

    name = "gauge-scale"
    stage = Stage.TARGET
    observables = ()
    covariates = ("temperature",)
    parameters = (Parameter("gauge-scale", "ppm", "share missing from every known length", 20 * PPM),)

    def design(self, sightings: Sightings) -> Floats:
        """No reading changes: zeros (n, 3, 1)."""
        return np.zeros((len(sightings), 3, 1))

    def gauge_design(self, first: Ints, second: Ints, points: Floats) -> Floats:
        """Change (g, 1) of the stated lengths per unit of scale."""
        lengths: Floats = np.linalg.norm(points[first] - points[second], axis=1)
        return -lengths[:, None]


@dataclass(frozen=True)
class GaugeShape(Effect):
    """Shape of the gauge: a nest moved, or the gauge bent, after its lengths were measured.

    One nest has moved by D since: true length = stated length + D . unit vector towards the nest. The parameters are
    the nest's motion in the network frame (no correction of a reading); no reading changes, the target is where it is
    today.

    Size: 1 K across a frame 20 mm thick with nests 40 mm above it turns into 28 um on 590 mm; a nest moves by 5 to 50
    um.
    Like: smr-centring or dirt in the gauge's nest.
    Separate by: the gauge measured again; reflectors swapped. Of the lengths' freedoms one is scale, the rest is shape.
    Valid: motions small against the lengths; a bend out of the plane of a flat gauge leaves its lengths as they are.
    Source: Sensors 2021, 21, 7479, doi:10.3390/s21227479, table 2 and section 2.3 (the gauge; 2.3 + L/300 um of the
    machine that measured it).
    Status: validated against moved points on the known lengths.
    """

    index: int = 0

    name = "gauge-shape"
    stage = Stage.TARGET
    observables = ()
    covariates = ("place",)
    scope = "target"
    plural = True
    parameters = along_axes("nest", "um", "motion of the nest along", 30 * MICROMETRE)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every target; those that end no known length change nothing and are dropped as invisible."""
        return [cls((), (name,), i) for i, name in enumerate(sightings.target_names)]

    def design(self, sightings: Sightings) -> Floats:
        """No reading changes: zeros (n, 3, 3)."""
        return np.zeros((len(sightings), 3, 3))

    def gauge_design(self, first: Ints, second: Ints, points: Floats) -> Floats:
        """Change (g, 3) of the stated lengths per unit of the nest's motion."""
        gap = points[first] - points[second]
        unit = gap / np.linalg.norm(gap, axis=1, keepdims=True)
        ends = (second == self.index).astype(float) - (first == self.index)
        return unit * ends[:, None]
