"""Gauge: points of a rigid frame from the lengths between them, and errors of the coordinate measuring machine."""

from dataclasses import dataclass
from itertools import combinations
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import SetupError
from ltsim.core.randomness import stream
from ltsim.core.units import DEGREE, MICROMETRE, MILLIMETRE
from ltsim.geometry.expansion import ThermalExpansion
from ltsim.simulation.sections import Cmm, ScenarioGauge

PAPER_TABLE_2_LENGTHS = MappingProxyType(
    {
        "columns": (357.6066, 388.0144, 454.4203, 590.1060, 386.7815, 355.9437),
        "rows": (357.6066, 590.1060, 355.9437, 388.0144, 386.7815, 454.4203),
    }
)
"""Lengths [mm] between the targets 25-26, 25-27, 25-28, 26-27, 26-28 and 27-28 in the paper's Table 2, if this table is
read by columns or by rows."""
MAX_RELATIVE_LENGTH_ERROR = 1e-7
"""Relative difference between given lengths and those of the nearest frame above which the lengths contradict each
other."""


@dataclass(frozen=True)
class GaugeFrame:
    """Rigid frame of the gauge at its calibration temperature."""

    target_names: tuple[str, ...]
    """Names of the k targets of the gauge."""
    points: Floats
    """Coordinates of the targets in the axes of the frame, relative to its centre, shape (targets, 3) [m]."""
    first_targets: Ints
    """Index of the target at the first end of each reference length."""
    second_targets: Ints
    """Index of the target at the second end of each reference length."""

    @property
    def lengths(self) -> Floats:
        """True reference lengths, shape (lengths,) [m]."""
        return np.linalg.norm(self.points[self.first_targets] - self.points[self.second_targets], axis=1)


def make_gauge_frame(gauge: ScenarioGauge) -> GaugeFrame:
    """Frame with the declared lengths of a gauge.

    SetupError is raised if a length is missing or repeated, or if the lengths contradict each other.
    """
    names = gauge.targets
    pairs = list(combinations(range(len(names)), 2))
    lengths = np.array(_declared_lengths(gauge, pairs)) * MILLIMETRE
    first, second = np.array(pairs, dtype=np.int64).T
    frame = GaugeFrame(names, points_from_distances(len(names), first, second, lengths), first, second)
    worst = int(np.argmax(np.abs(frame.lengths - lengths)))
    if abs(frame.lengths[worst] - lengths[worst]) > MAX_RELATIVE_LENGTH_ERROR:
        a, b = names[first[worst]], names[second[worst]]
        has, wanted = frame.lengths[worst] / MILLIMETRE, lengths[worst] / MILLIMETRE
        message = f"the nearest frame in space has {has:.4f} mm between {a} and {b}, not {wanted:.4f} mm"
        raise SetupError(f"gauge: the lengths contradict each other; {message}")
    return frame


def _declared_lengths(gauge: ScenarioGauge, pairs: list[tuple[int, int]]) -> list[float]:
    """Declared length [mm] of each pair of targets; raises SetupError for missing or repeated lengths."""
    names = gauge.targets
    if not gauge.distance:
        if len(names) != 4:
            message = "the built-in gauge has four; give the lengths of another gauge as [[gauge.distance]]"
            raise SetupError(f"gauge.targets: has {len(names)} reflectors, but {message}")
        return list(PAPER_TABLE_2_LENGTHS[gauge.reading])
    certificates: dict[frozenset[str], float] = {}
    for i, line in enumerate(gauge.distance):
        key = frozenset((line.from_, line.to))
        if len(key) != 2 or not key <= set(names) or key in certificates:
            problem = "has two entries" if key in certificates else "is not a pair of different gauge.targets"
            raise SetupError(f"gauge.distance.{i + 1}: {line.from_}-{line.to} {problem}")
        certificates[key] = line.length_mm
    for a, b in pairs:
        if frozenset((names[a], names[b])) not in certificates:
            raise SetupError(f"gauge.distance: the length {names[a]}-{names[b]} is missing, expected all {len(pairs)}")
    return [certificates[frozenset((names[a], names[b]))] for a, b in pairs]


def points_from_distances(n_points: int, first_points: Ints, second_points: Ints, lengths: Floats) -> Floats:
    """Points about their centre whose mutual distances are nearest to the given ones, shape (n_points, 3) [m].

    Classical scaling (Torgerson, Psychometrika 17 (1952) 401-419): the coordinates are eigenvectors of the doubly
    centred squared distances. The first axis is that of the largest extent; the first point determines the signs.
    """
    squared = np.zeros((n_points, n_points))
    squared[first_points, second_points] = squared[second_points, first_points] = lengths**2
    centring = np.eye(n_points) - 1.0 / n_points
    value, vector = np.linalg.eigh(-0.5 * centring @ squared @ centring)
    largest = np.argsort(value)[::-1][:3]
    points = np.zeros((n_points, 3))
    points[:, : len(largest)] = vector[:, largest] * np.sqrt(np.maximum(value[largest], 0.0))
    points *= np.where(points[0] < 0, -1.0, 1.0)
    return points


def expansion_factor(gauge: ScenarioGauge, workshop_temperature_c: float) -> float:
    """Ratio of the lengths at the workshop's temperature to those at the calibration temperature."""
    measured = workshop_temperature_c if gauge.measured_at_c is None else gauge.measured_at_c
    return ThermalExpansion.from_temperature(gauge.expansion_per_k, measured - gauge.calibrated_at_c).length_ratio


def gauge_rotation(gauge: ScenarioGauge) -> Floats:
    """Rotation matrix (3, 3) from the axes of the frame to those of the workshop."""
    angles = np.array([gauge.roll_deg, gauge.pitch_deg, gauge.yaw_deg]) * DEGREE
    return Rotation.from_euler("xyz", angles).as_matrix()


def gauge_points_in_workshop(gauge: ScenarioGauge, gauge_frame: GaugeFrame, workshop_temperature_c: float) -> Floats:
    """Coordinates (targets, 3) [m] of the gauge at its planned pose and at the workshop's temperature."""
    points: Floats = expansion_factor(gauge, workshop_temperature_c) * gauge_frame.points @ gauge_rotation(gauge).T
    return points + np.array(gauge.position_mm) * MILLIMETRE


def length_sigmas(measuring_machine: Cmm, lengths: Floats) -> Floats:
    """Standard deviation of each length [m]: largest permitted error of the machine divided by its coverage."""
    largest = measuring_machine.constant_um + lengths / MILLIMETRE / measuring_machine.length_divisor_mm
    return largest * MICROMETRE / measuring_machine.coverage


def measure_nominal_points(
    points: Floats, names: tuple[str, ...], measuring_machine: Cmm, seed: int, *stream_key: str | int
) -> Floats:
    """Coordinates (targets, 3) [m] as measured by a coordinate measuring machine, from the true `points`.

    The largest permitted error A + L / K of the machine has a random part A of each length, with half of its variance
    at either end, and a scale error L / K of each axis.
    """
    random = measuring_machine.constant_um * MICROMETRE / measuring_machine.coverage / np.sqrt(2.0)
    scale = MICROMETRE / MILLIMETRE / measuring_machine.length_divisor_mm / measuring_machine.coverage
    axes = scale * stream(seed, *stream_key, "cmm", "axes").standard_normal(3)
    each = np.array([stream(seed, *stream_key, "cmm", "point", name).standard_normal(3) for name in names])
    centre = points.mean(axis=0)
    error: Floats = measuring_machine.noise_factor * ((points - centre) * axes + random * each.reshape(-1, 3))
    return points + error
