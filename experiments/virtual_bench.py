"""Simulated bench test of a reflector: range error as a function of incidence, with a roundness table and two sensors.

The reflector stands on the roundness table, which turns by up to +-30 deg. An interferometer looks along -x and records
the length; a probe records the displacement of the surface of the sphere (Sensors 2021, 21, 7479, sections 2.2 and 3.1,
fig. 2, 8, 9). If the center of the sphere has an offset c from the axis of the table, a turn by alpha changes the
length by -(c_x cos alpha - c_y sin alpha). This change is not an error of the reflector, but looks like one: an offset
of 26 um to the side changes the length by 13 um at 30 deg. The probe separates the two: the first harmonic of its
record is the eccentricity, higher harmonics are the roundness of the sphere.

An interferometer records only changes of length. The table of range errors is therefore known except for a constant,
its value at 0 deg, which the range offset of a tracker absorbs.
"""

from dataclasses import dataclass, field

import numpy as np

from ltsim.adjustment.evaluation.bench import ReflectorBenchReadings, eccentricity_design_matrix
from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError
from ltsim.core.randomness import random_stream
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.effects.smr_incidence import INCIDENCE_TABLE_ANGLES, PAPER_INCIDENCE_RANGE_ERRORS

FULL_TURN = np.arange(0.0, 360.0, 7.5) * DEGREE
PROBE = 90.0 * DEGREE
"""Direction of the probe, measured from the interferometer [rad]."""
MIDDLE = int(np.argmin(np.abs(INCIDENCE_TABLE_ANGLES)))
LOBES = (2, 3, 5)
"""Numbers of lobes of the sphere's deviation from roundness."""


@dataclass(frozen=True)
class BenchTest:
    """True values of a bench test, in SI units."""

    table: Floats = field(default_factory=lambda: np.array(PAPER_INCIDENCE_RANGE_ERRORS))
    """(9,) [m] Range error of the reflector (reading minus truth, at the centre of the sphere) at
    `INCIDENCE_TABLE_ANGLES`.
    """
    eccentricity: Floats = field(default_factory=lambda: np.zeros(2))
    """(2,) [m] Offset of the sphere's centre from the axis of the table at 0 deg: towards the interferometer, and to
    the side.
    """
    roundness: float = 0.3 * MICROMETRE
    """[m] Amplitude of the sphere's deviation from roundness for each number of `LOBES`."""
    probe_angles: Floats = field(default_factory=lambda: FULL_TURN.copy())
    """(k,) [rad] Angles of the table at which the probe is read."""
    probe_sigma: float = 0.1 * MICROMETRE
    length_sigma: float = 0.1 * MICROMETRE
    """[m] Standard deviations: of the probe including the run-out of the table (`probe_sigma`), of the interferometer
    (`length_sigma`).
    """

    def __post_init__(self) -> None:
        if len(self.table) != len(INCIDENCE_TABLE_ANGLES):
            raise InputError(
                f"the table has {len(self.table)} errors for {len(INCIDENCE_TABLE_ANGLES)} angles; give one per angle"
            )
        if len(self.probe_angles) < 3:
            raise InputError(f"the probe is read at {len(self.probe_angles)} angles; read it at 3 or more")


def vertex_table(axial: float, side: float, angles: Floats = INCIDENCE_TABLE_ANGLES) -> Floats:
    """Range error (a,) [m] at `angles` of a vertex with offsets `axial` and `side` [m] from the sphere's centre."""
    return eccentricity_design_matrix(angles) @ np.array([axial, side])


def measure_bench(bench: BenchTest, seed: int, *key: str | int) -> ReflectorBenchReadings:
    """Readings of one simulated test: lengths at angles of the table, displacements at angles of the probe."""

    def noise(quantity: str, count: int) -> Floats:
        return random_stream(seed, *key, "bench", quantity).standard_normal(count)

    lengths = bench.table + eccentricity_design_matrix(INCIDENCE_TABLE_ANGLES) @ bench.eccentricity
    turned = bench.probe_angles - PROBE
    surface = np.stack([np.cos(turned), -np.sin(turned)], axis=1) @ bench.eccentricity
    phase = 2 * np.pi * random_stream(seed, *key, "bench", "lobes").random(len(LOBES))
    for lobes, start in zip(LOBES, phase, strict=True):
        surface = surface + bench.roundness * np.cos(lobes * turned + start)
    return ReflectorBenchReadings(
        table_angles_of_lengths=INCIDENCE_TABLE_ANGLES,
        lengths=lengths + bench.length_sigma * noise("length", len(lengths)),
        table_angles_of_probe=bench.probe_angles,
        probe_direction=PROBE,
        probe_displacements=surface + bench.probe_sigma * noise("probe", len(surface)),
        length_sigma=bench.length_sigma,
    )
