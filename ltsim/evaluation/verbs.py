"""The public function of the reflector's bench test."""

from __future__ import annotations

from pathlib import Path

from ltsim.evaluation.bench import bench_file, evaluate_bench, read_bench
from ltsim.evaluation.schema import BenchFile
from ltsim.units import DEGREE, MICROMETRE


def bench(source: str | Path, *, probe_direction: float = 90.0, length_sigma: float = 0.1) -> BenchFile:
    """Find a reflector's range error against incidence from its test on a roundness table.

    Parameters
    ----------
    source : str or Path
        A table ``angle_deg,length_um,probe_um``; cells are empty where one of them was not read.
    probe_direction : float, [deg]
        Where the probe stands, from the interferometer.
    length_sigma : float, [um]
        Standard deviation of the interferometer.

    Raises
    ------
    RecordError
        When the table is malformed, or holds too few angles.

    Examples
    --------
    >>> import ltsim as lt
    >>> from pathlib import Path
    >>> rows = [[str(a), str(0.1 * a) if abs(a) <= 30 else "", "0.0"] for a in range(-180, 180, 15)]
    >>> lines = [",".join(row) for row in [["angle_deg", "length_um", "probe_um"], *rows]]
    >>> _ = Path("reflector.csv").write_text(chr(10).join(lines))
    >>> [round(row.error_um, 1) for row in lt.bench("reflector.csv").angles]
    [-3.0, -1.5, 0.0, 1.5, 3.0]
    """
    how = {"probe_direction": probe_direction * DEGREE, "length_sigma": length_sigma * MICROMETRE}
    record = read_bench(Path(source), **how)
    return bench_file(record, evaluate_bench(record))
