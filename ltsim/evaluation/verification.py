"""The paper's laboratory verification: a calibrated tracker against nominal points from a CMM.

Equations 13 and 14 as they are meant: eq. 13 compares distances between targets i
and j as the tracker measured them from one station with the same distance of the CMM; eq. 14 compares
coordinates in the CMM's frame after a rigid fit of each station. Before: an ideal tracker; after: with the
parameters of a calibration.
"""

from pathlib import Path

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import NetworkError, RecordError
from ltsim.evaluation.clouds import measured_points, on_points, station_means
from ltsim.evaluation.criteria import Criteria, Differences, Improvement, pair_distances
from ltsim.model.construction import Construction
from ltsim.recording.coordinates import read_points
from ltsim.recording.recording import Recording
from ltsim.results import Table, numbers, texts

NOMINAL = Table(
    "nominal.csv",
    "points of a measuring machine, which `verify` compares with",
    (*texts(target="name"), *numbers(".4f", x_mm="coordinate", y_mm="coordinate", z_mm="coordinate")),
)


def read_nominal(path: Path) -> dict[str, Floats]:
    """Nominal points (3,) [m] by target, from a list such as ``target,x_mm,y_mm,z_mm``; raises RecordError."""
    found = read_points(path)
    for line, place in zip(found.lines, found.points, strict=True):
        if not np.isfinite(place).all():
            raise RecordError("a coordinate is missing, expected a number in mm", file=path, row=line)
    return found.by_name


def distance_errors(clouds: Floats, nominal: Floats) -> Differences:
    """Per pair of targets, the mean over stations of |distance - nominal distance| (eq. 13, as meant)."""
    return _over_stations(np.abs(pair_distances(clouds) - pair_distances(nominal)))


def coordinate_errors(clouds: Floats, nominal: Floats) -> Differences:
    """Per target, the mean over stations of the distance to its nominal point after a rigid fit (eq. 14)."""
    placed = np.stack([on_points(cloud, nominal) for cloud in clouds])
    return _over_stations(np.linalg.norm(placed - nominal, axis=2))


def _over_stations(gap: Floats) -> Differences:
    have = np.isfinite(gap)
    count = have.sum(axis=0)
    return Differences(np.where(have, gap, 0.0).sum(axis=0)[count > 0] / count[count > 0])


def verify(
    recording: Recording,
    nominal: dict[str, Floats],
    construction: Construction | None = None,
    values: Floats | None = None,
) -> Criteria:
    """Errors of a laboratory's recording against nominal points (3,) [m], before and after calibration.

    "After" applies parameters (p,) or (n, p) [SI]. Raises NetworkError when a station saw fewer than three nominal
    targets.
    """
    missing = np.full(3, np.nan)
    goal = np.stack([nominal.get(name, missing) for name in recording.targets])
    known = np.isfinite(goal[:, 0])
    if int(known.sum()) < 3:
        raise NetworkError(
            f"only {int(known.sum())} targets of the recording have nominal points; at least three are needed"
        )

    def of(points: Floats) -> tuple[Differences, Differences]:
        clouds = station_means(recording, points)[:, known]
        try:
            return distance_errors(clouds, goal[known]), coordinate_errors(clouds, goal[known])
        except NetworkError as problem:
            raise NetworkError(f"a station cannot be fitted to the nominal points: {problem}") from None

    distance, coordinate = of(measured_points(recording))
    if construction is None or values is None:
        return Criteria(Improvement(distance), Improvement(coordinate))
    after = of(measured_points(recording, construction, values))
    return Criteria(Improvement(distance, after[0]), Improvement(coordinate, after[1]))
