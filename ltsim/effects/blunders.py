"""Errors of the set-up and of the work."""

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal, Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Mistake, Parameter, Stage, along_axes
from ltsim.effects.motions import StationMotion, exact_target_change
from ltsim.effects.places import gaps_near, station_change_times
from ltsim.errors import unknown_name
from ltsim.recording.recording import OBSERVABLES
from ltsim.recording.slips import UNIT_SLIPS, Slip
from ltsim.scene.sightings import Sightings
from ltsim.units import MICROMETRE, MICRORADIAN


@dataclass(frozen=True)
class StationLevelling(StationMotion):
    """Levelling error: the level is wrong, and the station's axis leans although it was levelled.

    w = R_i (b_x, b_y, 0): the parameters are the true lean of the instrument, a rotation vector about its own x and y
    axes (no correction of a reading). One station with its own, or the same bias b at all of them (a level fixed to the
    head).

    Size: 2 urad for a good level, 10 to 20 urad for a bad one.
    Like: nothing, where the poses are free: then it is the pose, and leaves no residual.
    Separate by: freeing the tilts and comparing; plumb lines converge by 0.157 urad a metre.
    Valid: only levelled stations feel it.
    Source: the user manual of SpatialAnalyzer (weights of levels); ISO 10360-10:2021 (inclinometers).
    Status: first order validated against the exact motion.
    """

    name = "station-levelling"
    stage = Stage.STATION
    observables = ("azimuth", "elevation")
    covariates = ("place",)
    scope = "station"
    parameters = (
        Parameter("lean-x", "urad", "turn about the instrument's x axis", 20 * MICRORADIAN),
        Parameter("lean-y", "urad", "turn about the instrument's y axis", 20 * MICRORADIAN),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every station alone, and the same bias at all."""
        return [cls(), *(cls((name,)) for name in sightings.station_names)]

    def motion(self, sightings: Sightings) -> Floats:
        """Turn (n, 6, 2) about the instrument's x and y axes per unit of lean."""
        axes = sightings.rotation[sightings.station][:, :, :2] * self.mask(sightings)[:, None, None]
        return np.concatenate([np.zeros_like(axes), axes], axis=1)


def approach_rate(sightings: Sightings) -> Floats:
    """(n, 3): mean rate of the raw readings [m/s, rad/s] since the last pointing of the same station."""
    rate = np.zeros((len(sightings), 3))
    lapse = sightings.time - sightings.time[sightings.previous]
    going = (sightings.previous >= 0) & (lapse > 0)
    rate[going] = sightings.move[going] / lapse[going, None]
    return rate


@dataclass(frozen=True)
class TimingLag(Effect):
    """Timing lag: a reading is taken before the axis has come to rest, or a channel is late.

    Delta = rate of the reading times the lag, each channel with its own. The rate is that of the approach: the change
    since the last pointing of the station over the time between them; none for a station's first pointing.

    Size: 0.1 to 1 ms; a target moved at 0.1 m/s is off by 100 um in 1 ms.
    Like: backlash, where all moves take equally long.
    Separate by: dwell times of 0.1, 1 and 5 s.
    Valid: static targets in a steady rhythm; a head that hurries has a higher rate than the mean used here, so the lag
    comes out too long by that ratio.
    Source: general knowledge; the law is that of a delayed channel.
    Status: validated on a sequence of known rates; the size is general knowledge.
    """

    name = "timing-lag"
    stage = Stage.ELECTRONICS
    covariates = ("time", "approach")
    parameters = (
        Parameter("lag-distance", "ms", "how late the range is", 0.3e-3),
        Parameter("lag-azimuth", "ms", "how late the azimuth is", 0.3e-3),
        Parameter("lag-elevation", "ms", "how late the elevation is", 0.3e-3),
    )

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 3) of the raw readings per unit of lag."""
        late = approach_rate(sightings) * self.mask(sightings)[:, None]
        return -late[:, :, None] * np.eye(3)


@dataclass(frozen=True)
class StationBump(StationMotion):
    """Station bumped: somebody touched the tripod, and the station stands elsewhere from then on.

    pose(t) = pose + H(t - t_b) (translation, rotation). The parameters are the station's motion in the network frame,
    the rotation a vector through its origin (no correction of a reading).

    Size: 5 um and 5 urad up to millimetres; it shows from 5.6 um together with 4 urad on.
    Like: station-settling (smooth), range-step (ranges only), target-swap.
    Separate by: a drift check on the first three targets.
    Valid: one bump a visit, three pointings or more on either side; micrometres to millimetres.
    Source: the user manual of SpatialAnalyzer (drift check); the search over change points is derived here.
    Status: first order validated against the exact motion.
    """

    time: float = 0.0

    name = "station-bump"
    stage = Stage.STATION
    covariates = ("time",)
    scope = "station"
    parameters = (
        *along_axes("shift", "um", "motion of the station along", 100 * MICROMETRE),
        *along_axes("turn", "urad", "turn of the station about", 50 * MICRORADIAN),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every gap of a visit with three pointings on either side."""
        return [cls((name,), time=time) for name, time in station_change_times(sightings, least=3)]

    def finer(self, sightings: Sightings) -> list[Self]:
        """The gaps between pointings around this one."""
        times = sightings.time[self.mask(sightings) > 0]
        return [self.reshaped(time=t) for t in gaps_near(times, self.time)]

    def motion(self, sightings: Sightings) -> Floats:
        """Motion (n, 6, 6): none before the bump, the whole after it."""
        return (self.mask(sightings) * (sightings.time >= self.time))[:, None, None] * np.eye(6)


@dataclass(frozen=True)
class TargetSwap(Mistake):
    """Swapped targets: two reflectors carry each other's name at a station.

    The reading of one is that of the other: the change is the partner's reading less the own one, times 1.

    Size: the distance between the two.
    Like: two outliers, equal and opposite.
    Separate by: nothing is needed; the length of the miss is the distance of the two.
    Valid: the parameter is 1 where it happened and 0 elsewhere; nothing in between means anything. A mistake of this
    size is mended before an adjustment, so `candidates` is empty and `possible` lists the pairs.
    Source: general knowledge of networks.
    Status: validated against a recording with two names exchanged.
    """

    name = "target-swap"
    stage = Stage.ELECTRONICS
    covariates = ("place",)
    scope = "pointing"
    parameters = (Parameter("swapped", "", "1 where the two are exchanged", 1.0),)

    @classmethod
    def possible(cls, sightings: Sightings) -> list[Self]:
        """Every pair at every station."""
        pairs = list(combinations(sightings.target_names, 2))
        return [cls((station,), pair) for station in sightings.station_names for pair in pairs]

    def done(self, sightings: Sightings) -> Sightings:
        """The other of the two was measured."""
        if len(self.targets) != 2:
            return sightings
        a, b = (sightings.target_names.index(name) for name in self.targets)
        other = np.where(sightings.target == a, b, a)
        return replace(sightings, target=np.where(self.mask(sightings) > 0, other, sightings.target))

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings when the two are exchanged, exact."""
        if len(self.targets) != 2:
            return np.zeros((len(sightings), 3, 1))
        a, b = (sightings.target_names.index(name) for name in self.targets)
        partner = np.where(sightings.target == a, b, a)
        gap = sightings.points[partner] - sightings.points[sightings.target]
        acts = self.mask(sightings)[:, None]
        return exact_target_change(sightings, gap * acts)[:, :, None]


Observable = Literal["distance", "azimuth", "elevation"]
COLUMN: dict[Observable, int] = {"distance": 0, "azimuth": 1, "elevation": 2}
MOST_ROWS = 1500


@dataclass(frozen=True)
class Outlier(Effect):
    """Outlier: one reading of one pointing is wrong.

    Correction of that reading alone, whatever its cause.

    Size: any; from 16 um on a range shows.
    Like: nest-lift (0.85), which hits all three readings of a pointing in one direction.
    Separate by: the pointing repeated.
    Valid: any size below a millimetre; larger ones are screened before an adjustment. In large recordings `candidates`
    is empty: the w-test of the residuals finds single readings without trying each.
    Source: Baarda 1968, A testing procedure for use in geodetic networks (data snooping).
    Status: validated on a single row.
    """

    row: int = 0
    observable: Observable = "distance"

    name = "outlier"
    stage = Stage.ELECTRONICS
    scope = "reading"
    plural = True
    parameters = (Parameter("outlier", "um", "correction of the range", 300 * MICROMETRE),)

    def __post_init__(self) -> None:
        object.__setattr__(self, "observables", (self.observable,))
        if self.observable != "distance":
            angle = Parameter("outlier", "urad", f"correction of the raw {self.observable}", 100 * MICRORADIAN)
            object.__setattr__(self, "parameters", (angle,))

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every reading of a recording of ordinary size."""
        if len(sightings) > MOST_ROWS:
            return []
        places = [
            ((sightings.station_names[s],), (sightings.target_names[t],))
            for s, t in zip(sightings.station, sightings.target, strict=True)
        ]
        return [cls(*place, row, o) for o in COLUMN for row, place in enumerate(places)]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of correction."""
        design = np.zeros((len(sightings), 3, 1))
        if self.row < len(sightings):
            design[self.row, COLUMN[self.observable], 0] = -self.mask(sightings)[self.row]
        return design


SLIPS = {slip.name: slip for slip in UNIT_SLIPS}


@dataclass(frozen=True)
class WrongUnit(Mistake):
    """Wrong unit: the readings of a station are in other units, count another way, or hold zeniths for elevations.

    The reading becomes the reading times a factor, or its complement to a right angle, or counts clockwise; the slips
    are those of `recording.slips`.

    Size: metres.
    Like: nothing; the pose fit misses by metres.
    Separate by: nothing is needed.
    Valid: the parameter is 1 where it happened and 0 elsewhere. A mistake of this size is mended before an adjustment,
    so `candidates` is empty and `possible` lists the mistakes. Weather in a wrong unit is station-weather.
    Source: definitions of the units; BIPM, The International System of Units (SI Brochure).
    Status: validated on the readings: what the mend gives back is what was read.
    """

    mistake: str = "gon"

    name = "wrong-unit"
    stage = Stage.ELECTRONICS
    scope = "station"
    parameters = (Parameter("mistaken", "", "1 where the unit is wrong", 1.0),)

    def __post_init__(self) -> None:
        if self.mistake not in SLIPS:
            raise unknown_name("slip", self.mistake, SLIPS)
        object.__setattr__(self, "observables", tuple(OBSERVABLES[c] for c in self.slip.columns))

    @property
    def slip(self) -> Slip:
        """What is written for what."""
        return SLIPS[self.mistake]

    @classmethod
    def at(cls, station: str) -> list[Self]:
        """Every slip at a station."""
        return [cls((station,), mistake=name) for name in SLIPS]

    @classmethod
    def possible(cls, sightings: Sightings) -> list[Self]:
        """Every slip at every station."""
        return [effect for name in sightings.station_names for effect in cls.at(name)]

    def written(self, sightings: Sightings, readings: Floats) -> Floats:
        """The readings in the wrong unit."""
        return np.where(self.mask(sightings)[:, None] > 0, self.slip.written(readings), readings)

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings when the unit is wrong, exact."""
        return (self.written(sightings, sightings.raw) - sightings.raw)[:, :, None]


@dataclass(frozen=True)
class FaceConfusion(Mistake):
    """Confused faces: readings of one face are stored as those of the other.

    Rows stored as `face` hold what the other face read: azimuth + 180 deg and 180 deg - elevation of what is expected.

    Size: metres: a point lands behind the tracker.
    Like: nothing.
    Separate by: nothing is needed: the raw elevation itself says on which face it was read.
    Valid: the parameter is 1 where it happened and 0 elsewhere. A mistake of this size is mended before an adjustment,
    so `candidates` is empty and `possible` lists the mistakes.
    Source: definition of the two faces of a theodolite; Deumlich and Staiger 2002, Instrumentenkunde der
    Vermessungstechnik.
    Status: validated: twice the same mistake gives the reading back.
    """

    face: int = 2

    name = "face-confusion"
    stage = Stage.ELECTRONICS
    observables = ("azimuth", "elevation")
    covariates = ("face",)
    scope = "station"
    parameters = (Parameter("confused", "", "1 where the faces are confused", 1.0),)

    @classmethod
    def possible(cls, sightings: Sightings) -> list[Self]:
        """Either face of every station."""
        return [cls((name,), face=face) for name in sightings.station_names for face in (1, 2)]

    def done(self, sightings: Sightings) -> Sightings:
        """The other face was measured."""
        confused = (self.mask(sightings) > 0) & (sightings.face == self.face)
        return replace(sightings, face=np.where(confused, 3 - sightings.face, sightings.face))

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings when the faces are confused, exact."""
        acts = self.mask(sightings) * (sightings.face == self.face)
        azimuth, elevation = sightings.raw[:, 1], sightings.raw[:, 2]
        turned = np.where(azimuth > 0, -np.pi, np.pi)
        change = np.stack([np.zeros_like(azimuth), turned, np.pi - 2 * elevation], axis=1)
        confused: Floats = change * acts[:, None]
        return confused[:, :, None]
