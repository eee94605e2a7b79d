"""Simulator of a hall with a simple cause; it shares no code with ltsim. Lengths in m, angles in rad."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
ARCSECOND = np.pi / 648000
UNITS = {"mm": 1e-3, "arcsec": ARCSECOND, "ppm": 1e-6, "": 1.0}
CONTROL, BAR = (0, 3, 7, 9, -1), (2, -4)
"""Indices of targets that are control points (`CONTROL`), and of the ends of the gauge length (`BAR`)."""
CORNERS = np.array([[0.17, 0.23], [0.82, 0.19], [0.80, 0.79], [0.18, 0.77], [0.49, 0.45]])
"""Positions of the set-ups, as fractions of the floor's length and width."""
TILT = 5e-5
"""[rad] Standard deviation of the tilt of a set-up."""
POINTING_S, SET_UP_S = 25.0, 1200.0
AGAIN = (0, 7)
"""Positions in the sequence of a set-up of the targets that are measured again at its end."""
FOOT, GON = 0.3048, 0.9
"""Foot [m] and gon [deg]: readings in these units are recorded as if they were metres and degrees."""
DIRECTION = np.array([0.6, -0.64, 0.48])
"""Unit vector in which points move; a tripod moves only horizontally."""


@dataclass(frozen=True)
class Place:
    """Stations and targets of a cause; both are empty for the noise."""

    stations: frozenset[str] = frozenset()
    targets: frozenset[str] = frozenset()

    def includes(self, stations: set[str], targets: set[str]) -> bool:
        """True if a reported place is equal to this one; for a cause at a target alone, any stations are accepted."""
        return targets == self.targets and (stations == self.stations or (bool(targets) and not self.stations))


@dataclass(frozen=True)
class Cause:
    """Cause with its size in SI units, or a factor; `station` and `target` are indices."""

    name: str
    size: float
    station: int
    target: int


@dataclass(frozen=True)
class Hall:
    """Stations (S, 3) with rotations (S, 3, 3), targets (T, 3), and the sequence of pointings (n,)."""

    name: str
    position: Array
    rotation: Array
    points: Array
    noise: Mapping[str, float]
    station: Index
    target: Index
    face: Index
    repeat: Index
    time: Array
    seed: int = field(compare=False)

    @classmethod
    def of(cls, settings: Mapping[str, Any], noise: Mapping[str, float], seed: int) -> "Hall":
        """Hall with stations near its corners and middle, and targets on three levels along its walls."""
        rng, size, faces = np.random.default_rng(seed), np.array(settings["size_m"]), settings["faces"]
        corners = CORNERS[: settings["stations"]]
        position = np.column_stack([corners * size[:2], rng.uniform(1.3, 1.7, len(corners))])
        count, levels = settings["targets"], 3
        turn = 2 * np.pi * (np.arange(count) * 0.381966 + 0.03)
        ellipse = 0.5 * size[:2] + 0.46 * size[:2] * np.column_stack([np.cos(turn), np.sin(turn)])
        height = np.linspace(0.3, size[2], levels)[np.arange(count) % levels]
        points = np.column_stack([ellipse, height]) + rng.normal(0, 0.1, (count, 3))
        rotation = np.array([_rotation(rng.uniform(0, 2 * np.pi), *rng.normal(0, TILT, 2)) for _ in corners])
        rows, time = [], 0.0
        for s in range(len(corners)):
            order = list(range(count))[:: 1 if s % 2 == 0 else -1]
            for n, t in enumerate([*order, *(order[k] for k in AGAIN)]):
                for f in range(1, faces + 1):
                    time += POINTING_S
                    rows.append((s, t, f, 1 + (n >= count), time))
            time += SET_UP_S
        station, target, face, repeat, seconds = (np.array(column) for column in zip(*rows, strict=True))
        return cls(settings["name"], position, rotation, points, noise, station, target, face, repeat, seconds, seed)

    @property
    def control(self) -> Index:
        """Indices of the control points."""
        return np.arange(len(self.points))[list(CONTROL)]

    @property
    def bar(self) -> Index:
        """Targets at the ends of the gauge length."""
        return np.arange(len(self.points))[list(BAR)]

    def place(self, cause: Cause) -> Place:
        """Place of a cause."""
        station, target = frozenset([f"S{cause.station + 1}"]), frozenset([name_of(cause.target)])
        match cause.name:
            case "one distance" | "one azimuth":
                return Place(station, target)
            case "SMR constant at a target" | "target moved":
                return Place(targets=target)
            case "targets exchanged":
                return Place(station, target | {name_of(self.partner(cause.target))})
            case "control point":
                return Place(targets=frozenset([name_of(self.wrong_control)]))
            case "control points exchanged":
                return Place(targets=frozenset(map(name_of, self.control[:2])))
            case "gauge length":
                return Place(targets=frozenset(map(name_of, self.bar)))
            case "noise of a factor":
                return Place()
        return Place(station)

    def lost_targets(self, cause: Cause) -> tuple[int, ...]:
        """Targets whose coordinates have no true value under a cause, or lose their reference value."""
        match cause.name:
            case "target moved":
                return (cause.target,)
            case "control point":
                return (int(self.wrong_control),)
            case "control points exchanged":
                return tuple(self.control[:2].tolist())
        return ()

    @property
    def wrong_control(self) -> int:
        """Index of the control point with wrong coordinates."""
        return int(self.control[2])

    def partner(self, target: int) -> int:
        """Target whose name is exchanged with that of `target`: the next one without a reference value."""
        return int(np.roll(self.ordinary, -1)[self.ordinary == target][0])

    @property
    def ordinary(self) -> Index:
        """Targets without a reference value."""
        return np.setdiff1d(np.arange(len(self.points)), [*self.control, *self.bar])


def _rotation(yaw: float, a: float, b: float) -> Array:
    """Rotation (3, 3) from the hall into a set-up that is tilted by two small angles [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[1, 0, -b], [0, 1, a], [b, -a, 1]]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def name_of(target: int | np.int64) -> str:
    """Name of a target."""
    return f"K{target + 1:02d}"


def polar(rotation: Array, position: Array, points: Array) -> Array:
    """Distance, azimuth and elevation (n, 3) of points (n, 3) from positions (n, 3) with rotations (n, 3, 3)."""
    x = np.einsum("nij,nj->ni", rotation, points - position)
    d = np.linalg.norm(x, axis=1)
    return np.column_stack([d, np.arctan2(x[:, 1], x[:, 0]), np.arcsin(x[:, 2] / d)])


def _readings_of_geometry(hall: Hall, cause: Cause | None) -> Array:
    """Readings (n, 3) without noise, after the motion of a tripod or target by the cause."""
    position, points = hall.position[hall.station], hall.points[hall.target]
    if cause and cause.name == "tripod bumped":
        position = position + _second_half(hall, cause)[:, None] * cause.size * DIRECTION * [1, 1, 0]
    if cause and cause.name == "target moved":
        late = 2 * hall.station >= len(hall.position)
        points = points + (late & (hall.target == cause.target))[:, None] * cause.size * DIRECTION
    return polar(hall.rotation[hall.station], position, points)


def _with_errors(hall: Hall, cause: Cause) -> Array:
    """Readings (n, 3) without noise, with an error in one reading, at a target or at a set-up."""
    readings = _readings_of_geometry(hall, cause)
    at_station, at_target = hall.station == cause.station, hall.target == cause.target
    single = int(np.flatnonzero(at_station & at_target)[0])
    match cause.name:
        case "one distance":
            readings[single, 0] += cause.size
        case "one azimuth":
            readings[single, 1] += cause.size
        case "SMR constant at a target":
            readings[at_target, 0] += cause.size
        case "SMR constant at a set-up":
            readings[at_station, 0] += cause.size
        case "range scale at a set-up":
            readings[at_station, 0] *= 1 + cause.size
        case "circle turned":
            readings[_second_half(hall, cause), 1] += cause.size
    return readings


def _second_half(hall: Hall, cause: Cause) -> NDArray[np.bool_]:
    """(n,) True for pointings in the second half of a set-up."""
    at_station = hall.station == cause.station
    return np.asarray(at_station & (np.cumsum(at_station) > at_station.sum() / 2))


@dataclass(frozen=True)
class Observations:
    """Readings and reference values of a recording.

    The readings (n, 3) are reduced to face one, `target` (n,) are the booked targets, and the noise is declared
    `noise_factor` times too small.
    """

    hall: Hall
    readings: Array
    sigma: Array
    target: Index
    control: dict[int, Array]
    length: float
    noise_factor: float = 1.0

    @classmethod
    def of(cls, hall: Hall, cause: Cause | None = None, number: int = 0, *, noisy: bool = True) -> "Observations":
        """Observations of a hall with or without a cause.

        `number` seeds the noise, which does not depend on the cause.
        """
        rng, noise = np.random.default_rng([hall.seed, number]), hall.noise
        readings = _with_errors(hall, cause) if cause else _readings_of_geometry(hall, cause)
        sigma = np.column_stack([1e-3 * noise["distance_mm"] + 1e-6 * noise["distance_ppm"] * readings[:, 0],
                                 noise["angle_arcsec"] * ARCSECOND / np.cos(readings[:, 2]),
                                 np.full(len(readings), noise["angle_arcsec"] * ARCSECOND)])  # fmt: skip
        readings = readings + sigma * rng.standard_normal(readings.shape) * noisy
        reference_sigmas = noisy * 1e-3 * np.array([noise["control_mm"], noise["length_mm"]])
        control = {int(k): hall.points[k] + reference_sigmas[0] * rng.standard_normal(3) for k in hall.control}
        length = float(
            np.linalg.norm(np.subtract(*hall.points[hall.bar])) + reference_sigmas[1] * rng.standard_normal()
        )
        right = cls(hall, readings, sigma, hall.target, control, length)
        return right._with_mistake(cause) if cause else right

    def _with_mistake(self, cause: Cause) -> "Observations":
        """Observations with a wrong reference value, name, unit or declared noise."""
        hall, control, readings, target = self.hall, dict(self.control), self.readings.copy(), self.target.copy()
        at_station, booked = hall.station == cause.station, hall.target
        match cause.name:
            case "noise of a factor":
                return replace(self, sigma=self.sigma / cause.size, noise_factor=cause.size)
            case "gauge length":
                return replace(self, length=self.length + cause.size)
            case "control point":
                control[hall.wrong_control] = control[hall.wrong_control] + cause.size * DIRECTION
            case "control points exchanged":
                first, other = hall.control[:2].tolist()
                control[first], control[other] = control[other], control[first]
            case "targets exchanged":
                other = hall.partner(cause.target)
                at_target, at_partner = (at_station & (booked == t) for t in (cause.target, other))
                target[at_target], target[at_partner] = other, cause.target
            case "distances in feet":
                readings[at_station, 0] /= FOOT
            case "angles in gon":
                back = (hall.face == 2)[at_station]
                azimuth, elevation = readings[at_station, 1] + np.pi * back, readings[at_station, 2]
                raw = (azimuth % (2 * np.pi)) / GON, np.where(back, np.pi - elevation, elevation) / GON
                readings[at_station, 1] = raw[0] - np.pi * back
                readings[at_station, 2] = np.where(back, np.pi - raw[1], raw[1])
            case "azimuths counted the other way":
                readings[at_station, 1] *= -1
        return replace(self, readings=readings, target=target, control=control)

    def without(self, control: tuple[int, ...]) -> "Observations":
        """Observations without the given control points."""
        remaining = {k: x for k, x in self.control.items() if k not in control}
        return replace(self, control=remaining)

    def write(self, folder: Path) -> Path:
        """Write `observations.csv` and `setup.toml`, in the format that docs/reference describes; return the folder."""
        folder.mkdir(parents=True, exist_ok=True)
        hall, noise, factor = self.hall, self.hall.noise, self.noise_factor
        lines = ["station,target,face,repeat,time_s,azimuth_deg,elevation_deg,distance_mm"]
        for n, (d, az, el) in enumerate(self.readings.tolist()):
            if hall.face[n] == 2:
                az, el = az + np.pi, np.pi - el
            turned = np.degrees(az) if az > 2 * np.pi else np.degrees(az % (2 * np.pi))
            lines.append(f"S{hall.station[n] + 1},{name_of(self.target[n])},{hall.face[n]},{hall.repeat[n]},"
                         f"{hall.time[n]:.1f},{turned:.9f},{np.degrees(el):.9f},{d * 1e3:.6f}")  # fmt: skip
        (folder / "observations.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        bar = [name_of(k) for k in hall.bar]
        text = ['format = "ltsim-recording/1"', 'title = "Ladder"', "[instrument]", 'construction = "source-in-head"',
                "[instrument.noise]", *(f"{key} = {noise[key] / factor}" for key in ("distance_mm", "distance_ppm")),
                *(f"{axis}_arcsec = {noise['angle_arcsec'] / factor}" for axis in ("azimuth", "elevation")),
                "[gauge]", "[[gauge.distance]]", f'from = "{bar[0]}"', f'to = "{bar[1]}"',
                f"length_mm = {1e3 * self.length:.6f}", f"sigma_mm = {noise['length_mm']}"]  # fmt: skip
        for k, x in self.control.items():
            at = ", ".join(f"{1e3 * v:.6f}" for v in x)
            text += [f"[targets.{name_of(k)}]", f"known_mm = [{at}]", f"known_sigma_mm = {noise['control_mm']}"]
        (folder / "setup.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
        return folder
