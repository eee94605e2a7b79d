"""Instruments of CERN's LGC: their targets with the standard deviations of readings, and options behind values."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from ltsim.errors import RecordError
from ltsim.recording.files import number, shown
from ltsim.recording.merge import Kind
from ltsim.recording.setup import Instrument, Noise
from ltsim.units import ARCSECOND, FACTOR, MILLIMETRE, PPM

CC = FACTOR["cc"]
WITH_VALUE = ("OBSE", "PPM", "TH", "THSE", "TCSE", "TRGT", "ID", "ASE", "ZSE", "DSE", "ACST", "IH", "IHSE", "ICSE")


@dataclass(frozen=True)
class Sigmas:
    """Standard deviations by the target used: azimuth and zenith angle [rad], distance [m] and its part per metre."""

    azimuth: float
    elevation: float
    distance: float
    per_metre: float
    height: float


@dataclass
class Polar:
    """A polar instrument: its default target, its height [m], and its targets."""

    default: str
    height: float
    targets: dict[str, Sigmas] = field(default_factory=dict)


def options_of(tokens: list[str], file: Path, row: int) -> dict[str, str]:
    """Words after the values: flags, and names with one value each."""
    found: dict[str, str] = {}
    rest = iter(tokens)
    for token in rest:
        word = token.upper()
        if word in WITH_VALUE:
            value = next(rest, None)
            if value is None:
                raise RecordError(f"{word} without a value", file=file, row=row)
            found[word] = value
        else:
            found[word] = ""
    return found


def option(options: dict[str, str], name: str, default: float, file: Path, row: int) -> float:
    """A number among the options, or its default; raises RecordError."""
    return number(options[name], file=file, row=row, column=name) if name in options else default


def add_target(polar: Polar, tokens: list[str], file: Path, row: int) -> list[str]:
    """Sigmas of one kind of target: angle and zenith [cc], distance [mm], mm per km; gives what is to be noted."""
    if len(tokens) < 5:
        raise RecordError("a target needs its name and four sigmas", file=file, row=row)
    azimuth, elevation, distance, ppm = (number(t, file=file, row=row, column="sigma") for t in tokens[1:5])
    height = number(tokens[9], file=file, row=row, column="height") if len(tokens) > 9 else 0.0
    correction = number(tokens[6], file=file, row=row, column="correction") if len(tokens) > 6 else 0.0
    polar.targets[tokens[0]] = Sigmas(azimuth * CC, elevation * CC, distance * MILLIMETRE, ppm * PPM, height)
    said = f"target {shown(tokens[0])}: its correction of distances of {correction:g} m is not applied"
    return [said] if correction else []


def sigma_of(kind: Kind, target: Sigmas, options: dict[str, str], value: float, file: Path, row: int) -> float:
    """Standard deviation [m, rad] of one value: as declared with the target, or as the line says."""
    if kind == "distance":
        constant = option(options, "DSE", option(options, "OBSE", target.distance / MILLIMETRE, file, row), file, row)
        per_metre = option(options, "PPM", target.per_metre / PPM, file, row) * PPM
        sigma = constant * MILLIMETRE + per_metre * value
    else:
        declared = (target.azimuth if kind == "azimuth" else target.elevation) / CC
        name = "ASE" if kind == "azimuth" else "ZSE"
        sigma = option(options, name, option(options, "OBSE", declared, file, row), file, row) * CC
    if not sigma > 0:
        raise RecordError("a standard deviation of 0", file=file, row=row, column=kind)
    return sigma


def instrument_of(name: str, polar: Polar) -> Instrument:
    """An instrument; a name such as AT402.392506 holds its model and serial number."""
    parts = re.fullmatch(r"([A-Z]+\d+)[._](\d{4,})", name)
    model, serial = parts.groups() if parts else (None, None)
    return Instrument(noise=_noise(polar), corrected=True, model=model, serial=serial)


def _noise(polar: Polar) -> Noise:
    """The sigmas of the default target; those of single observations stand in columns."""
    sigmas = polar.targets.get(polar.default) or next(iter(polar.targets.values()), None)
    if sigmas is None:
        return Noise()
    return Noise(
        distance_mm=max(sigmas.distance / MILLIMETRE, 1e-6),
        distance_ppm=sigmas.per_metre / PPM,
        azimuth_arcsec=max(sigmas.azimuth / ARCSECOND, 1e-6),
        elevation_arcsec=max(sigmas.elevation / ARCSECOND, 1e-6),
    )
