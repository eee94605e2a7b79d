from dataclasses import dataclass
from typing import Literal, Self

from ltsim.core.units import MICRORADIAN
from ltsim.physics.effects.circles import cos_sin_parameters, cos_sin_terms
from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, LightPathStage
from ltsim.scene.sightings import Sightings

CANDIDATE_SIGNAL_PERIODS = (
    256,
    360,
    512,
    720,
    1024,
    2048,
    3600,
    4096,
    8192,
    9000,
    10_000,
    16_384,
    18_000,
    20_000,
    32_768,
    36_000,
)
"""Numbers of signal periods per turn that a diagnosis tries, because encoders on the market have them: powers of two,
and whole fractions of a degree."""


@dataclass(frozen=True)
class EncoderInterpolation(ChainErrorEffect):
    """Interpolation error of an encoder: the signal between two lines of the scale is not an exact sine.

    The correction (true value minus reading) of the raw reading x of one circle is Delta = A cos(N x) + B sin(N x).
    Here N = 1e3 to 1e5 is the number of signal periods per turn, and A and B are the parameters. The error resembles
    white noise of that angle, but it is the same if the same angle is read again.

    Size: 0.05 urad in a good encoder, 0.5 to 1 urad in a bad one.
    Similar to: white noise of that angle.
    Separate by: a repeat with the base turned by a known fraction of the period; a target moved in small steps along an
    arc.
    Validity: N known from the data sheet, or one of the usual numbers, which a diagnosis tries; some hundred pointings
    cannot determine N among all integers. An error e of x changes the phase by N e, for example 15 urad by 0.5 rad at N
    = 36 000. The phase is therefore computed from readings that include the instrument's errors.
    Source: Heydemann 1981, Appl. Opt. 20, 3382, doi:10.1364/AO.20.003382 (why a quadrature signal leaves such an
    error); sizes are general knowledge.
    Validation: validated against the exact kinematic chain for N up to 36 000.
    """

    circle: Literal["azimuth", "elevation"] = "azimuth"
    """Circle whose encoder has the error."""
    periods: int = 36_000
    """Number of signal periods of the encoder per turn."""

    name = "encoder-interpolation"
    base_rate = 0.5
    light_path_stage = LightPathStage.ENCODERS
    observables = ("azimuth", "elevation")
    covariates = ("azimuth", "elevation")
    parameters = cos_sin_parameters("interpolation", "`periods` times the raw angle", MICRORADIAN)

    def __post_init__(self) -> None:
        object.__setattr__(self, "observables", (self.circle,))
        object.__setattr__(self, "covariates", (self.circle,))

    @property
    def terms(self) -> tuple[ChainErrorTerm, ...]:  # type: ignore[override]
        return cos_sin_terms(self.circle, self.periods)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Effects that a diagnosis tries: each number of periods in `CANDIDATE_SIGNAL_PERIODS`, for both circles."""
        circles: tuple[Literal["azimuth", "elevation"], ...] = ("azimuth", "elevation")
        return [cls(circle=circle, periods=n) for circle in circles for n in CANDIDATE_SIGNAL_PERIODS]
