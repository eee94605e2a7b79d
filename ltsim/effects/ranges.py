"""Errors of the range: its zero, its scale, and what changes them."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, Power, ShapeParameter, SlotEffect, Stage, Term, on_readings
from ltsim.effects.places import Drift, gaps_near, start_time, station_change_times
from ltsim.recording.recording import MODE_COLUMN
from ltsim.scene.sightings import Sightings
from ltsim.units import FACTOR, MICROMETRE, PPM


class RangeOffset(SlotEffect):
    """Range zero: the bird-bath distance, or the offset of the absolute distance meter, is wrong.

    Delta_d = rho_0: all ranges off by one length, the same on both faces.

    Size: a current absolute meter 2.5 um, 5 um at most; a bad one 20 to 50 um.
    Like: transit-offset (0.83 / 0), the axial part of smr-centring exactly. Stations and targets absorb 99.6 % of it:
    it shows from 73 um on in one face, from 13 um on in two.
    Separate by: a length in line, from outside and from between its ends: the difference is twice the zero.
    Valid: one mode of distance measurement: absolute meter and interferometer have zeros of their own.
    Source: Muralikrishnan et al. 2009, J. Res. NIST 114, 21-35, doi:10.6028/jres.114.003 (x8, bird-bath error); Rüeger
    1996, Electronic Distance Measurement (length in line).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "range-offset"
    stage = Stage.RANGE
    observables = ("distance",)
    parameters = (
        Parameter("range-offset", "um", "constant missing from every range", 10 * MICROMETRE, "range_offset"),
    )
    terms = (Term("range"),)


@dataclass(frozen=True)
class RangeMode(Effect):
    """Range zero by mode: the interferometer starts from another zero than the absolute distance meter.

    Delta_d = rho for the ranges of the interferometer, where a recording holds both modes (column `distance_mode`): the
    difference of the two zeros. The zero that both share is range-offset.

    Size: 5 um in a good tracker, 20 to 50 um in a bad one.
    Like: range-step, where the mode changes once in a visit; range-offset, where all ranges are of one mode.
    Separate by: the same targets in both modes.
    Valid: one zero a mode for the whole recording: an interferometer homed anew gets another (range-step).
    Source: the manual of a Brunson laser-tracker kit (both zeros are checked apart).
    Status: validated on the rows of either mode, and by a recording with both.
    """

    name = "range-mode"
    stage = Stage.RANGE
    observables = ("distance",)
    covariates = (MODE_COLUMN,)
    parameters = (Parameter("interferometer-zero", "um", "missing from ranges of the interferometer", 30 * MICROMETRE),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """One, where both modes were used."""
        return [cls()] if MODE_COLUMN in sightings.covariates else []

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of the difference."""
        interferometer = sightings.covariates.get(MODE_COLUMN, np.zeros(len(sightings)))
        return on_readings(sightings, distance=self.mask(sightings) * interferometer)[:, :, None]


@dataclass(frozen=True)
class RangeStep(Effect):
    """Step of the range zero: the beam is lost and found again, and the zero is another one afterwards.

    Delta_d = rho from a time on, until the station is left.

    Size: 5 um in a current tracker, 20 to 50 um in a bad one.
    Like: station-weather (0.965, where the step is at the station's start), a station-bump along the beams.
    Separate by: near and far targets at that station; a target measured before and after.
    Valid: one step a station; the next station starts with a new zero of its own.
    Source: general knowledge: an interferometer is homed anew after each lost beam, an absolute meter keeps its own
    zero.
    Status: validated on rows before and after the step.
    """

    time: float = 0.0

    name = "range-step"
    stage = Stage.RANGE
    observables = ("distance",)
    covariates = ("time",)
    scope = "station"
    parameters = (Parameter("range-step", "um", "missing from every range after the step", 30 * MICROMETRE),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """The start of every visit, and the gaps between its pointings."""
        starts = [
            (name, float(sightings.time[sightings.station == s].min(initial=0.0)))
            for s, name in enumerate(sightings.station_names)
        ]
        changes = station_change_times(sightings, least=2)
        return [cls((name,), time=time) for name, time in [*starts, *changes]]

    def finer(self, sightings: Sightings) -> list[Self]:
        """The gaps between pointings around this one."""
        times = sightings.time[self.mask(sightings) > 0]
        return [self.reshaped(time=t) for t in gaps_near(times, self.time)]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of step."""
        after = self.mask(sightings) * (sightings.time >= self.time)
        return on_readings(sightings, distance=after)[:, :, None]


class RangeScale(SlotEffect):
    """Range scale: the frequency of the laser, or one refractive index of air for all, is wrong.

    Delta_d = s d, the same on both faces. Air enters with 0.955 ppm/K, -0.268 ppm/hPa and 0.0085 ppm/%RH (633 nm, 20
    C): s = 0.955 ppm/K (T_true - T_used) and so on.

    Size: laser 0.1 ppm, absolute meter 0.3 ppm, air 0.3 ppm good and 3 to 5 ppm bad; 20 C kept at 27 C is 6.6 ppm,
    sea-level pressure at 850 m altitude 26 ppm.
    Like: gauge-scale and every uniform change of the mesh, exactly: without a known length it is the network's scale.
    Separate by: thermometers and a barometer; a second, long length standard of another material.
    Valid: up to 100 ppm.
    Source: Ciddor 1996, Appl. Opt. 35, 1566, doi:10.1364/AO.35.001566 (sensitivities by `effects.ciddor`).
    Status: validated against the exact chain in first order, and against the columns of the D-H chain.
    """

    name = "range-scale"
    stage = Stage.RANGE
    observables = ("distance",)
    parameters = (Parameter("range-scale", "ppm", "share missing from every range", 2 * PPM, "range_scale"),)
    terms = (Term("range", Power()),)


@dataclass(frozen=True)
class StationWeather(Effect):
    """Wrong weather at one station: a thermometer in the sun, a pressure in another unit.

    Delta_d = d s_i at station i: 0.955 ppm a kelvin that the used temperature is too low, -0.268 ppm a hPa that the
    used pressure is too low. That station sees the whole mesh larger or smaller.

    Size: 1 K is 0.95 ppm, a slip of 10 hPa 2.7 ppm, mmHg for hPa (250 hPa) 67 ppm.
    Like: mesh-expansion between stations (exact), range-step at the station's start (0.965).
    Separate by: a log of the structure's temperature; the first station again at the end.
    Valid: one constant index a visit.
    Source: Ciddor 1996, Appl. Opt. 35, 1566, doi:10.1364/AO.35.001566 (sensitivities by `effects.ciddor`).
    Status: validated against the range scale on the station's rows.
    """

    name = "station-weather"
    stage = Stage.AIR
    observables = ("distance",)
    covariates = ("distance",)
    scope = "station"
    parameters = (Parameter("station-weather", "ppm", "share missing from every range of the station", 5 * PPM),)

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of scale."""
        return on_readings(sightings, distance=self.mask(sightings) * sightings.range_)[:, :, None]


COLUMN = "air_temperature_c"
STEADY = 0.05
"""[K] span of temperature below which nothing can be learnt."""


@dataclass(frozen=True)
class DeadPath(Effect):
    """Dead path: a part of the reference path inside the head warms with the air, and nobody corrects it.

    Delta_d = k (T - T_0), T the recorded air temperature, T_0 that of the first pointing. For an interferometer
    k = -beta D_0, with beta = 0.955 ppm/K the change of the air's index; for an absolute meter the fibre's own.

    Size: 0.15 um/K for a path D_0 of 0.15 m, negligible; 1 to 5 um/K for the fibre of a bad absolute meter.
    Like: range-drift, where the temperature follows the clock.
    Separate by: a new homing; both distance modes along the same line.
    Valid: needs the column air_temperature_c; without it, or with a constant one, there is nothing to try.
    Source: Bobroff 1993, Recent advances in displacement measuring interferometry, Meas. Sci. Technol. 4, 907-926.
    Status: validated on a temperature column; the size is general knowledge.
    """

    name = "dead-path"
    stage = Stage.RANGE
    observables = ("distance",)
    covariates = ("temperature",)
    parameters = (Parameter("dead-path", "um/K", "missing from every range a kelvin warmer", 3 * MICROMETRE),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """One, where the temperature varies."""
        known = sightings.covariates.get(COLUMN)
        varies = known is not None and np.isfinite(known).any() and np.nanmax(known) - np.nanmin(known) > STEADY
        return [cls()] if varies else []

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of the coefficient."""
        temperature = sightings.covariates.get(COLUMN, np.full(len(sightings), np.nan))
        ordered = temperature[sightings.order]
        known = ordered[np.isfinite(ordered)]
        warmer = np.nan_to_num(temperature - (known[0] if len(known) else 0.0))
        return on_readings(sightings, distance=self.mask(sightings) * warmer)[:, :, None]


SHORTEST, LONGEST = 0.02, 2.0
PHASE = 0.125
"""Share of a period by which the phase may be wrong at the ends of the span when it is right in the middle."""
MOST = 1200


@dataclass(frozen=True)
class RangeCyclic(Effect):
    """Cyclic range error: crosstalk of the modulation, periodic in the range with its unit length.

    Delta_d = A cos(2 pi d / L) + B sin(2 pi d / L), the unit length L = c / (2 n f): 150 mm for a modulation of 1 GHz,
    53.5 mm for 2.8 GHz. Ranges that differ by L have the same error.

    Size: under 1 um in a good meter, 5 to 10 um in a bad one.
    Like: noise that repeats; biases the range zero where it is left out.
    Separate by: one reflector slid along a rail over one L; the modulation frequency of the data sheet.
    Valid: L from 20 mm to 2 m: a network tells two wavelengths apart whose phases differ over its span of ranges. An
    interferometer's 0.3 um cannot be seen.
    Source: Rüeger 1996, Electronic Distance Measurement (unit length; zero and cyclic terms are estimated together);
    Lichti 2007, ISPRS J. Photogramm. Remote Sens. 61, 307-324, doi:10.1016/j.isprsjprs.2006.10.004.
    Status: validated on wave and sign; the density of the search by the share of power kept between its steps.
    """

    wavelength: float = 0.15

    name = "range-cyclic"
    stage = Stage.RANGE
    observables = ("distance",)
    covariates = ("distance",)
    parameters = (
        Parameter("cyclic-cos", "um", "cosine of the range's phase", 8 * MICROMETRE),
        Parameter("cyclic-sin", "um", "sine of the range's phase", 8 * MICROMETRE),
    )
    shape = (ShapeParameter("wavelength", "mm", "unit length", SHORTEST, LONGEST, steps=600, reciprocal=True),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Wavelengths as close as the span of ranges can tell apart, from the longest down."""
        span = float(np.ptp(sightings.range_)) if len(sightings) else 0.0
        step = 4 * PHASE / max(span, 0.5)
        highest = min(1 / SHORTEST, 1 / LONGEST + MOST * step)
        return [cls(wavelength=float(1 / f)) for f in np.arange(1 / LONGEST, highest, step)]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 2) of the raw readings per unit of either amplitude."""
        phase = 2 * np.pi * sightings.range_ / self.wavelength
        acts = self.mask(sightings)
        columns = [on_readings(sightings, distance=acts * wave(phase)) for wave in (np.cos, np.sin)]
        return np.stack(columns, axis=2)


@dataclass(frozen=True)
class RefractivityDrift(Effect):
    """Drift of the air's index: the hall warms up, the weather entered in the morning is kept.

    Delta_d = d s t, t since the first pointing; a kelvin is 0.955 ppm. Later stations see the mesh smaller.

    Size: 0.5 to 2 K a morning, 0.1 to 1 ppm/h.
    Like: mesh-expansion, the uniform mode (0.996, exact where it grows between visits), station-weather in single
    stations.
    Separate by: a thermometer on the structure; the first station again at the end.
    Valid: linear over the recording.
    Source: Ciddor 1996, Appl. Opt. 35, 1566, doi:10.1364/AO.35.001566 (sensitivities by `effects.ciddor`).
    Status: validated against the range scale at one hour.
    """

    name = "refractivity-drift"
    stage = Stage.AIR
    observables = ("distance",)
    covariates = ("time", "distance")
    parameters = (
        Parameter("refractivity-drift", "ppm/h", "growth of the share missing from every range", 3 * FACTOR["ppm/h"]),
    )

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of the rate."""
        since = sightings.time - start_time(sightings)
        return on_readings(sightings, distance=self.mask(sightings) * sightings.range_ * since)[:, :, None]


@dataclass(frozen=True)
class RangeDrift(Drift):
    """Drift of the range zero: the electronics and the head warm up.

    Delta_d = r t (linear over the recording, or anew in every visit) or A exp(-t / tau) (warm-up).

    Size: 1 to 2 um/h after the warm-up; tenths of a millimetre over two hours from cold.
    Like: mesh-expansion (0.955), dead-path.
    Separate by: a new homing in between; thermometers; a target measured every quarter of an hour.
    Valid: the same law at every station, time constants of 10 min to 4 h.
    Source: Pollack Periodica 15(3), 2020, on the warm-up of a Leica AT960 (size); the exponential is that of a body
    that reaches its temperature.
    Status: validated against the range zero at a given time.
    """

    name = "range-drift"
    stage = Stage.RANGE
    observables = ("distance",)
    slot = "range"
    rate = Parameter("range-drift", "um/h", "growth of what is missing from every range", 15 * FACTOR["um/h"])
    amplitude = Parameter("range-drift-amplitude", "um", "missing at the start, dying away", 20 * MICROMETRE)
    parameters = (rate,)

    laws = ("linear", "visit")
