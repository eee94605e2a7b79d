"""Errors of the two graduated circles."""

from dataclasses import dataclass
from typing import Literal, Self

from ltsim.effects.effect import Lobe, Parameter, PriorKind, SlotEffect, Stage, Term
from ltsim.scene.sightings import Sightings
from ltsim.units import ARCSECOND, MICRORADIAN

ORDERS = range(3, 9)
COUNTS = (256, 360, 512, 720, 1024, 2048, 3600, 4096, 8192, 9000, 10_000, 16_384, 18_000, 20_000, 32_768, 36_000)
"""Periods per turn of encoders on the market: powers of two, and whole fractions of a degree."""
COLUMN = {"azimuth": 1, "elevation": 2}


def lobes(name: str, of: str, size: float, kind: PriorKind | None = None) -> tuple[Parameter, ...]:
    """Amplitudes of the cosine and the sine of an angle."""
    waves = ("cosine", "sine")
    return tuple(Parameter(f"{name}-{wave[:3]}", "urad", f"{wave} of {of}", size, kind) for wave in waves)


def waves(circle: str, order: int) -> tuple[Term, Term]:
    """Cosine and sine of a multiple of the raw reading of a circle, as corrections of that reading."""
    return Term(circle, Lobe("cos", COLUMN[circle], order)), Term(circle, Lobe("sin", COLUMN[circle], order))


class AzimuthEccentricity(SlotEffect):
    """Eccentricity of the azimuth circle: the circle turns off its centre, one lobe a turn.

    Delta_azimuth = A1 cos(x) + B1 sin(x), x the raw azimuth; the amplitude is the eccentricity over the circle's
    radius. Odd, so it flips with the face.

    Size: raw, 10 um on a radius of 50 mm are 200 urad; after the maker's map under 0.5 urad good, 5 to 10 urad bad.
    Like: bearing-wobble, radial run-out of order 2 (0.92 / 0).
    Separate by: two faces; another yaw at each station, without which it is a fixed pattern of the room.
    Valid: first order of one read head; two opposite heads cancel it to second order.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x6x, x6y); Muralikrishnan et
    al. 2010, J. Res. NIST 115, 291-301, doi:10.6028/jres.115.022.
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "azimuth-eccentricity"
    stage = Stage.ENCODERS
    observables = ("azimuth",)
    parameters = lobes("azimuth-eccentricity", "the raw azimuth", 3 * ARCSECOND, "angle")
    terms = waves("azimuth", 1)


class ElevationEccentricity(SlotEffect):
    """Eccentricity of the elevation circle: the circle turns off its centre, one lobe a turn.

    C1 cos(x) + D1 sin(x), x the raw elevation: Delta_elevation = C1 cos(el) + f D1 sin(el) in front-face terms. C1 is
    largest at the horizon and the same on both faces; D1 parts ceiling from floor and flips.

    Size: as for the azimuth circle: under 0.5 urad good, 5 to 10 urad bad, after the maker's map.
    Like: C1: head-sag exactly for upright trackers, vertical-index (0.96 / 0); D1: elevation-second-order sine (0.93 /
    0).
    Separate by: D1 by two faces; C1 from sag only with the tracker on its side.
    Valid: first order of one read head.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x7).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "elevation-eccentricity"
    stage = Stage.ENCODERS
    observables = ("elevation",)
    parameters = lobes("elevation-eccentricity", "the raw elevation", 3 * ARCSECOND, "angle")
    terms = waves("elevation", 1)


class AzimuthSecondOrder(SlotEffect):
    """Two-lobe error of the azimuth circle: the scale is stretched and squeezed twice a turn.

    Delta_azimuth = A2 cos(2 x) + B2 sin(2 x), x the raw azimuth: the same on both faces, so two-face tests see nothing;
    horizontal lengths breathe with the azimuth, with a period of half a turn.

    Size: under 0.5 urad in a good tracker; 65 um in a length of 7.75 m at 7 m, about 5.5 urad, in older ones.
    Like: bearing-wobble, radial run-out of order 3 (0.80 / 0).
    Separate by: one length measured at many azimuths; another yaw at each station.
    Valid: up to 10 urad.
    Source: Muralikrishnan et al. 2010, J. Res. NIST 115, 291-301, doi:10.6028/jres.115.022 (sizes and method);
    Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x9a, x9b).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "azimuth-second-order"
    stage = Stage.ENCODERS
    observables = ("azimuth",)
    parameters = lobes("azimuth-second-order", "twice the raw azimuth", 3 * ARCSECOND, "angle")
    terms = waves("azimuth", 2)


class ElevationSecondOrder(SlotEffect):
    """Two-lobe error of the elevation circle: the scale is stretched and squeezed twice a turn.

    C2 cos(2 x) + D2 sin(2 x), x the raw elevation: Delta_elevation = f C2 cos(2 el) + D2 sin(2 el); the cosine flips
    with the face, the sine does not.

    Size: under 0.5 urad in a good tracker, up to 6 urad in an old one.
    Like: D2: elevation-eccentricity sine (0.93 / 0), air-layer (0.59), vertical mesh-expansion (0.50).
    Separate by: two faces (C2); more elevations.
    Valid: up to 10 urad.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x10a, x10b).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "elevation-second-order"
    stage = Stage.ENCODERS
    observables = ("elevation",)
    parameters = lobes("elevation-second-order", "twice the raw elevation", 3 * ARCSECOND, "angle")
    terms = waves("elevation", 2)


@dataclass(frozen=True)
class Harmonic(SlotEffect):
    """Harmonic `order` of a circle, the only one of its observables."""

    order: int = 3

    @property
    def terms(self) -> tuple[Term, ...]:  # type: ignore[override]
        """The slot and the two waves."""
        return waves(self.observables[0], self.order)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every order that can be told."""
        return [cls(order=m) for m in ORDERS]


@dataclass(frozen=True)
class AzimuthHarmonic(Harmonic):
    """Higher graduation harmonic of the azimuth circle: lines of the scale are off, as its read heads see them.

    Delta_azimuth = A cos(m x) + B sin(m x), x the raw azimuth, m from 3 up. Odd m flips with the face, even m does not;
    of several read heads, orders that are multiples of their number survive.

    Size: 0.2 urad in a good circle, 2 urad in a bad one.
    Like: noise and errors of single targets; bearing-wobble, radial run-out of order m + 1.
    Separate by: a turn of the base between stations, which moves the pattern; a repeat, which does not change it.
    Valid: m up to 8; with some thirty directions nothing higher can be told.
    Source: Lu, Graetz, Amin-Shahidi and Smeds 2010, On-axis self-calibration of angle encoders, CIRP Annals 59,
    529-534; Muralikrishnan et al. 2010, J. Res. NIST 115, 291-301, doi:10.6028/jres.115.022 (parity).
    Status: validated against the exact chain in first order, face parity and sign.
    """

    name = "azimuth-harmonic"
    stage = Stage.ENCODERS
    observables = ("azimuth",)
    covariates = ("azimuth",)
    parameters = lobes("azimuth-harmonic", "`order` times the raw azimuth", 2 * MICRORADIAN)


@dataclass(frozen=True)
class ElevationHarmonic(Harmonic):
    """Higher graduation harmonic of the elevation circle: lines of the scale are off, as its read heads see them.

    Delta_elevation = A cos(m x) + B sin(m x), x the raw elevation, m from 3 up. In front-face terms the cosine flips
    with the face for even m, the sine for odd m.

    Size: 0.2 urad in a good circle, 2 urad in a bad one.
    Like: noise and errors of single targets; over the 110 deg that a network uses, its own neighbours in order.
    Separate by: two faces; more elevations.
    Valid: m up to 8.
    Source: Lu, Graetz, Amin-Shahidi and Smeds 2010, On-axis self-calibration of angle encoders, CIRP Annals 59,
    529-534.
    Status: validated against the exact chain in first order, face parity and sign.
    """

    name = "elevation-harmonic"
    stage = Stage.ENCODERS
    observables = ("elevation",)
    covariates = ("elevation",)
    parameters = lobes("elevation-harmonic", "`order` times the raw elevation", 2 * MICRORADIAN)


@dataclass(frozen=True)
class EncoderInterpolation(SlotEffect):
    """Interpolation error of an encoder: the signal between two lines of the scale is no pure sine.

    Delta = A cos(N x) + B sin(N x) on one circle, x its raw reading, N the periods a turn, 1e3 to 1e5. It looks like
    white noise of that angle, but repeats where the same angle is read again.

    Size: 0.05 urad in a good encoder, 0.5 to 1 urad in a bad one.
    Like: white noise of that angle.
    Separate by: a repeat with the base turned by a known fraction; a dense sweep of one target along an arc.
    Valid: where N is known, from the data sheet: a network of some hundred pointings cannot search N over all integers,
    so the usual counts are tried. An error e of x blurs the phase by N e, 15 urad by 0.5 rad at N = 36 000: an
    adjustment takes it at the reading with the instrument's own errors in it (`sightings.read`), as the exact chain
    does.
    Source: Heydemann 1981, Appl. Opt. 20, 3382, doi:10.1364/AO.20.003382 (why a quadrature signal leaves such an
    error); sizes are general knowledge.
    Status: validated against the exact chain for N up to 36 000.
    """

    circle: Literal["azimuth", "elevation"] = "azimuth"
    periods: int = 36_000

    name = "encoder-interpolation"
    stage = Stage.ENCODERS
    observables = ("azimuth", "elevation")
    covariates = ("azimuth", "elevation")
    parameters = lobes("interpolation", "`periods` times the raw angle", MICRORADIAN)

    def __post_init__(self) -> None:
        object.__setattr__(self, "observables", (self.circle,))
        object.__setattr__(self, "covariates", (self.circle,))

    @property
    def terms(self) -> tuple[Term, ...]:  # type: ignore[override]
        """The slot and the two waves."""
        return waves(self.circle, self.periods)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Both circles with the usual counts."""
        circles: tuple[Literal["azimuth", "elevation"], ...] = ("azimuth", "elevation")
        return [cls(circle=circle, periods=n) for circle in circles for n in COUNTS]
