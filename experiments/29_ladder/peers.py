"""Adjustment with data snooping (Baarda 1968) from the true coordinates, and GNU Gama with levelled readings."""

import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from defusedxml import ElementTree
from scipy.linalg import qr
from scipy.spatial.transform import Rotation
from scipy.stats import norm

import ltsim as lt
from ltsim.geometry.rigid import rotation_about_z
from ltsim.recordings.setup import Station

from .hall import Array, Hall, Observations, name_of, polar

GAMA = "gama-local"
FALSE_ALARM_RATE = 0.05
"""False alarm rate of data snooping in one recording, divided among all observations (Baarda 1968)."""
MIN_REDUNDANCY = 1e-6
"""Redundancy below which the residual of an observation is only rounding, and is not tested."""
MAX_REJECTED_FRACTION = 0.5
"""Largest fraction of the observations that snooping may reject."""
STEPS, MIN_STEP = 30, 1e-9
"""Largest number of Gauss-Newton iterations, and the step [m, rad] below which they end."""
LIMIT_S = 120.0


@dataclass(frozen=True)
class Network:
    """Poses and targets of an adjustment, at which it is linearised.

    The unknowns are positions, rotations and targets, in this order.
    """

    observations: Observations
    position: Array
    rotation: Array
    points: Array

    @classmethod
    def at_truth(cls, observations: Observations) -> "Network":
        """Network at the true poses and targets."""
        hall = observations.hall
        return cls(observations, hall.position, hall.rotation, hall.points)

    def misclosure(self) -> Array:
        """Observed minus computed values (m,) in standard deviations: pointings, control points, length."""
        o, s = self.observations, self.observations.hall.station
        gap = o.readings - polar(self.rotation[s], self.position[s], self.points[o.target])
        gap[:, 1] = (gap[:, 1] + np.pi) % (2 * np.pi) - np.pi
        control_points, noise = np.array(list(o.control)), o.hall.noise
        control = (np.array(list(o.control.values())) - self.points[control_points]) / (1e-3 * noise["control_mm"])
        length = o.length - np.linalg.norm(np.subtract(*self.points[o.hall.bar]))
        return np.concatenate([(gap / o.sigma).ravel(), control.ravel(), [length / (1e-3 * noise["length_mm"])]])

    def design(self) -> Array:
        """Derivatives (m, u) of the observations, in standard deviations, by the unknowns."""
        o, n, stations = self.observations, len(self.observations.readings), len(self.position)
        station, target = o.hall.station, o.target
        x = np.einsum("nij,nj->ni", self.rotation[station], self.points[target] - self.position[station])
        d, h = np.linalg.norm(x, axis=1), np.hypot(x[:, 0], x[:, 1])
        zero = np.zeros(n)
        across = np.column_stack([-x[:, 1], x[:, 0], zero]) / h[:, None] ** 2
        up = np.column_stack([-x[:, 0] * x[:, 2], -x[:, 1] * x[:, 2], h**2]) / (d**2 * h)[:, None]
        by_x = np.stack([x / d[:, None], across, up], 1)
        by_x /= o.sigma[:, :, None]
        by_point = by_x @ self.rotation[station]
        cross = np.stack([np.column_stack([zero, x[:, 2], -x[:, 1]]), np.column_stack([-x[:, 2], zero, x[:, 0]]),
                          np.column_stack([x[:, 1], -x[:, 0], zero])], 1)  # fmt: skip
        width = 6 * stations + 3 * len(self.points)
        rows, at = np.zeros((n, 3, width)), np.arange(n)[:, None]
        for first, block in ((3 * station, -by_point), (3 * (stations + station), by_x @ cross),
                             (6 * stations + 3 * target, by_point)):  # fmt: skip
            rows[at, :, first[:, None] + np.arange(3)] = np.swapaxes(block, 1, 2)
        reference_rows = np.zeros((3 * len(o.control) + 1, width))
        for row, k in enumerate(o.control):
            for axis in range(3):
                reference_rows[3 * row + axis, 6 * stations + 3 * k + axis] = 1.0 / (1e-3 * o.hall.noise["control_mm"])
        a, b = o.hall.bar
        along = (self.points[a] - self.points[b]) / np.linalg.norm(self.points[a] - self.points[b])
        for k, sign in ((a, 1.0), (b, -1.0)):
            begin = 6 * stations + 3 * k
            reference_rows[-1, begin : begin + 3] = sign * along / (1e-3 * o.hall.noise["length_mm"])
        return np.concatenate([rows.reshape(3 * n, width), reference_rows])

    def with_step(self, step: Array) -> "Network":
        """Network after a step (u,) of the unknowns."""
        count = 3 * len(self.position)
        turn = Rotation.from_rotvec(step[count : 2 * count].reshape(-1, 3)).as_matrix()
        return Network(self.observations, self.position + step[:count].reshape(-1, 3), turn @ self.rotation,
                       self.points + step[2 * count :].reshape(-1, 3))  # fmt: skip

    def adjusted(self, use: Array) -> "Network":
        """Network after least-squares adjustment of the observations in use (m,)."""
        network = self
        for _ in range(STEPS):
            step = np.linalg.lstsq(network.design()[use], network.misclosure()[use], rcond=1e-13)[0]
            network = network.with_step(step)
            if np.abs(step).max() < MIN_STEP:
                break
        return network

    def standardised_residuals(self, use: Array) -> Array:
        """Standardised residuals (m,); 0 for rejected observations and observations without redundancy."""
        design = self.design()[use]
        basis = qr(design / np.linalg.norm(design, axis=0), mode="economic")[0]
        redundancy = 1.0 - (basis**2).sum(axis=1)
        values, checked = np.zeros(len(use)), redundancy > MIN_REDUNDANCY
        values[np.flatnonzero(use)[checked]] = self.misclosure()[use][checked] / np.sqrt(redundancy[checked])
        return values


def noncentrality(hall: Hall, change: Observations) -> float:
    """Noncentrality of a small change of the noise-free observations, linearised at the truth."""
    exact = Network.at_truth(Observations.of(hall, noisy=False))
    basis = qr(exact.design(), mode="economic")[0]
    signal = Network.at_truth(change).misclosure()
    return float(signal @ signal - ((basis.T @ signal) ** 2).sum())


@dataclass(frozen=True)
class Answer:
    """Coordinates (T, 3) [m] of targets, and stations and targets of the first rejected observation."""

    points: Array
    stations: set[str]
    targets: set[str]


def snooping(observations: Observations) -> Answer:
    """Adjustment with iterated data snooping: the largest standardised residual is rejected until none is too large."""
    network, rejected = Network.at_truth(observations), list[int]()
    use = np.ones(len(network.misclosure()), dtype=bool)
    critical = critical_value(len(use))
    while True:
        network = network.adjusted(use)
        size = np.abs(network.standardised_residuals(use))
        worst = int(np.argmax(size))
        if size[worst] < critical or len(rejected) >= MAX_REJECTED_FRACTION * len(use):
            break
        rejected.append(worst)
        use[worst] = False
    return Answer(network.points, *place_of(observations, rejected[:1]))


def critical_value(count: int) -> float:
    """Critical value of the largest of `count` standardised residuals."""
    return float(norm.isf(0.5 * FALSE_ALARM_RATE / count))


def place_of(observations: Observations, rows: Sequence[int]) -> tuple[set[str], set[str]]:
    """Stations and targets of observations."""
    hall, readings, control = observations.hall, observations.readings.size, list(observations.control)
    stations, targets = set[str](), set[str]()
    for row in rows:
        if row < readings:
            stations.add(f"S{hall.station[row // 3] + 1}")
            targets.add(name_of(observations.target[row // 3]))
        elif row - readings < 3 * len(control):
            targets.add(name_of(control[(row - readings) // 3]))
        else:
            targets |= {name_of(k) for k in hall.bar}
    return stations, targets


def levelled_observations(observations: Observations) -> Observations:
    """Observations of the same hall on one face, from set-ups without tilt."""
    hall = observations.hall
    upright = np.array([rotation_about_z(np.arctan2(r[0, 1], r[0, 0])) for r in hall.rotation])
    d, az, el = observations.readings.T
    local = np.column_stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)]) * d[:, None]
    turn = (upright @ np.swapaxes(hall.rotation, 1, 2))[hall.station]
    readings = polar(turn, np.zeros(3), local)
    return replace(observations, hall=replace(hall, rotation=upright, face=np.ones_like(hall.face)), readings=readings)


def gama_file(observations: Observations, folder: Path) -> Path:
    """File with the levelled observations in the format of GNU Gama."""
    recording = lt.read(levelled_observations(observations).write(folder))
    setup = recording.setup
    stations = {name: Station(levelled=True) for name in recording.stations}
    file = folder / "network.gkf"
    lt.write(recording.replace(setup=setup.model_copy(update={"stations": stations})), file, format="gama-local")
    return file


def gama(observations: Observations, folder: Path) -> Answer:
    """Adjustment of GNU Gama by the Cholesky algorithm.

    GNU Gama rejects no observation; the one with the largest residual above the critical value is reported.
    """
    file, result = gama_file(observations, folder), folder / "adjusted.xml"
    command = [GAMA, str(file), "--algorithm", "cholesky", "--xml", str(result), "--cov-band", "0"]
    subprocess.run(command, check=True, timeout=LIMIT_S, capture_output=True)
    return gama_answer(ElementTree.parse(result).getroot(), len(observations.hall.points))


def gama_answer(root: Element, count: int) -> Answer:
    """Coordinates of targets K01 to K`count`, and the observation with the largest standardised residual."""
    adjusted = {p[0].text: [float(c.text or "nan") for c in p[1:]] for p in root.iterfind(".//{*}adjusted/{*}point")}
    points = np.array([adjusted.get(name_of(k), [np.nan] * 3) for k in range(count)])
    residuals = [(abs(float(o.findtext("{*}std-residual") or "0")), {o.findtext("{*}from"), o.findtext("{*}to")})
                 for o in root.iterfind(".//{*}observations/*")]  # fmt: skip
    size, ends = max(residuals, key=lambda entry: entry[0])
    names = {str(name) for name in ends - {None}} if size > critical_value(len(residuals)) else set()
    stations = {name for name in names if name.startswith("S")}
    return Answer(points, stations, names - stations)


def is_installed() -> bool:
    """True if GNU Gama's program `gama-local` is on the PATH."""
    return shutil.which(GAMA) is not None
