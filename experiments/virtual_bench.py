"""The reflector's bench test: a roundness table, a probe and an interferometer give the error against incidence.

The reflector stands on the table and is turned through +-30 deg; an interferometer looks along -x and records the
length, a probe the displacement of the sphere's surface (Sensors 2021, 21, 7479, sections 2.2 and 3.1, fig. 2, 8, 9).
Turned by alpha, a sphere off the table's axis by c changes the length by -(c_x cos alpha - c_y sin alpha). That is no
error of the reflector, but it looks like one: 26 um to the side are 13 um at 30 deg. The probe tells it: the first
harmonic of its record is the eccentricity, higher ones are the roundness of the sphere.

An interferometer records changes only: the table is found less its value at 0 deg, a constant that a tracker's range
offset takes up.
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
"""Where the probe stands, from the interferometer."""
MIDDLE = int(np.argmin(np.abs(INCIDENCE_TABLE_ANGLES)))
LOBES = (2, 3, 5)
"""Lobes of the sphere's out-of-roundness."""


@dataclass(frozen=True)
class BenchTest:
    """What is true on the bench; SI."""

    table: Floats = field(default_factory=lambda: np.array(PAPER_INCIDENCE_RANGE_ERRORS))
    """(9,) [m]: range error of the reflector (reading - truth, of the sphere's centre) at `INCIDENCE_TABLE_ANGLES`."""
    eccentricity: Floats = field(default_factory=lambda: np.zeros(2))
    """(2,) [m]: sphere's centre off the table's axis at 0 deg: towards the interferometer, and to the side."""
    roundness: float = 0.3 * MICROMETRE
    """[m]: amplitude of each of the `LOBES` of the sphere."""
    probe_angles: Floats = field(default_factory=lambda: FULL_TURN.copy())
    """(k,) [rad]: turns of the table at which the probe is read."""
    probe_sigma: float = 0.1 * MICROMETRE
    length_sigma: float = 0.1 * MICROMETRE
    """[m]: one standard deviation of the probe with the table's run-out, and of the interferometer."""

    def __post_init__(self) -> None:
        if len(self.table) != len(INCIDENCE_TABLE_ANGLES):
            raise InputError(
                f"the table holds {len(self.table)} errors for {len(INCIDENCE_TABLE_ANGLES)} angles; give one each"
            )
        if len(self.probe_angles) < 3:
            raise InputError(f"the probe is read at {len(self.probe_angles)} angles; the eccentricity needs 3 or more")


def vertex_table(axial: float, side: float, angles: Floats = INCIDENCE_TABLE_ANGLES) -> Floats:
    """Range error (a,) [m] at `angles` of a vertex off the sphere's centre by `axial` and `side` [m]."""
    return eccentricity_design_matrix(angles) @ np.array([axial, side])


def measure_bench(bench: BenchTest, seed: int, *key: str | int) -> ReflectorBenchReadings:
    """Do the test once: lengths at the table's angles, displacements of the surface at the probe's."""

    def noise(what: str, count: int) -> Floats:
        return random_stream(seed, *key, "bench", what).standard_normal(count)

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
