"""Content of an input file of GNU Gama, and its observations with a covariance matrix."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from ltsim.core.arrays import Floats, Ints
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.files import quoted_text
from ltsim.recordings.pointings import SingleObservation, numbered_name
from ltsim.recordings.setup import GaugeDistance, ReferenceDifference, Vector
from ltsim.recordings.xml import XmlNode, band_matrix_entries

FIXED_SIGMA_MM = 1e-4
"""Standard deviation [mm] of a fixed coordinate."""


@dataclass
class GamaPoint:
    """Point of the file: coordinates [m] by axis; axes that are fixed, in the datum, or used."""

    values: dict[str, float] = field(default_factory=dict)
    fixed: str = ""
    datum: str = ""
    active: str = ""
    sigma: float = FIXED_SIGMA_MM
    covariance: tuple[float, ...] | None = None
    """Covariance xx, xy, xz, yy, yz, zz [mm^2]; None if not given."""

    @property
    def place(self) -> Vector | None:
        """Coordinates [mm]; None if one of the three is missing."""
        return self.coordinates if len(self.values) == 3 else None

    @property
    def coordinates(self) -> Vector:
        """Coordinates [mm], 0 for missing ones."""
        x, y, z = (round(self.values.get(axis, 0.0) / MILLIMETRE, 9) for axis in "xyz")
        return x, y, z


@dataclass
class GamaNetwork:
    """Network of the file as far as it has been read."""

    file: Path
    title: str = ""
    y_sign: float = 1.0
    angle_sign: float = -1.0
    stdev: dict[str, str] = field(default_factory=dict)
    points: dict[str, GamaPoint] = field(default_factory=dict)
    sets: Counter[str] = field(default_factory=Counter)
    point_of_station: dict[str, str] = field(default_factory=dict)
    north_direction_deg: float = 0.0  # [deg] counter-clockwise from x
    oriented: set[str] = field(default_factory=set)  # set-ups of azimuths: their circles are zero in the north
    observed: list[SingleObservation] = field(default_factory=list)
    apriori: float = 10.0  # [mm, cc] standard deviation of unit weight
    differences: list[ReferenceDifference] = field(default_factory=list)
    skipped: Counter[str] = field(default_factory=Counter)
    shared: int = 0  # number of errors that observations share
    notes: list[str] = field(default_factory=list)

    def station(self, point: str, *, with_directions: bool = False) -> str:
        """Name of the set-up over a point; each further set of directions gets another set-up."""
        self.sets[point] += with_directions
        name = numbered_name(point, max(self.sets[point] - 1, 0))
        self.point_of_station[name] = point
        return name


def drop_undetermined_heights(network: GamaNetwork) -> None:
    """Removal of height observations that are neither fixed nor adjusted.

    The heights of their ends are fixed, as in Gama.
    """
    flat = {name for name, point in network.points.items() if point.active == "xy"}
    if not flat:
        return
    observed = []
    for o in network.observed:
        in_plan = bool({network.point_of_station[o.station], o.target} & flat)
        if not in_plan or o.kind == "azimuth" or o.horizontal:
            observed.append(replace(o, instrument_height=0.0, target_height=0.0) if in_plan else o)
    joined = [
        difference
        for difference in network.differences
        if not ({difference.from_, difference.to} & flat and difference.known_axes == "z")
    ]
    count = len(network.observed) - len(observed) + len(network.differences) - len(joined)
    network.differences = [
        difference.model_copy(update={"known_axes": "xy"}) if {difference.from_, difference.to} & flat else difference
        for difference in joined
    ]
    for name in flat:
        network.points[name].values.setdefault("z", 0.0)
        network.points[name].fixed += "z"
    network.notes.append(
        f'{len(flat)} points are adjusted in plan only (adj="xy"): they have no heights, and '
        f"{count} observations that need heights are left out, as Gama does"
    )
    network.observed = observed


def split_reference_lengths(network: GamaNetwork) -> tuple[list[GaugeDistance], list[SingleObservation]]:
    """Slope distances that become reference lengths, and all other observations.

    Such a distance is between marks that others observe, from a point without other measurements.
    """
    angles = {o.station for o in network.observed if o.kind != "distance" or o.horizontal}
    targets = {o.target for o in network.observed if o.station in angles}
    gauge, rest = [], []
    for o in network.observed:
        start = network.point_of_station[o.station]
        if o.station in angles or start == o.target or not {start, o.target} <= targets or any(o.heights) or o.shared:
            rest.append(o)
        else:
            length = {"length_mm": o.value / MILLIMETRE, "sigma_mm": o.sigma / MILLIMETRE}
            gauge.append(GaugeDistance.model_validate({"from": start, "to": o.target, **length}))
    return gauge, rest


def with_distinct_names(differences: list[ReferenceDifference]) -> Iterator[ReferenceDifference]:
    """Differences with a number where several join the same points, such as a line that was levelled twice."""
    counts: Counter[str] = Counter()
    for difference in differences:
        number = counts[difference.label]
        counts[difference.label] += 1
        yield difference.model_copy(update={"name": numbered_name(difference.label, number)}) if number else difference


MAX_CORRELATED_OBSERVATIONS = 500
"""Largest number of correlated observations in a file: each shared error is an unknown of the adjustment."""
MAX_ZERO_CORRELATION_EIGENVALUE = 1e-6
"""Eigenvalue of a correlation matrix that counts as zero, and relative difference up to which two count as equal."""


def covariance_entries(node: XmlNode) -> tuple[Ints, Ints, Floats]:
    """Row, column and value (k,) of the upper triangle of a matrix in Gama's band form [mm^2] or [cc^2]."""
    matrix = next((inner for inner in node if inner.tag == "cov-mat"), None)
    if matrix is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
    values = [matrix.location.number(word, "cov-mat") for word in matrix.text.split()]
    return band_matrix_entries(matrix, matrix.number("dim"), matrix.number("band"), values)


def read_differences(section: XmlNode, y_sign: float, apriori: float) -> tuple[list[ReferenceDifference], bool]:
    """Height differences or vectors of a section, and a flag that correlations between them were ignored.

    A height difference without a standard deviation has `apriori` mm times the square root of its length in kilometres.
    """
    inner = [child for child in section if child.tag != "cov-mat"]
    tag, size = ("dh", 1) if section.tag == "height-differences" else ("vec", 3)
    row, column, numbers = covariance_entries(section)
    wrong = next((child for child in inner if child.tag != tag), None)
    if wrong is not None:
        raise wrong.location.error(f"<{quoted_text(wrong.tag)}> is in <{section.tag}>, expected <{tag}>")
    if len(numbers) and row[-1] + 1 != size * len(inner):
        raise section.location.error("a <cov-mat> that does not match its observations")
    whole, differences = np.zeros((size * len(inner),) * 2), []
    whole[row, column] = whole[column, row] = numbers
    for k, child in enumerate(inner):
        block = slice(size * k, size * (k + 1))
        spread = whole[block, block].copy() if len(numbers) else np.array([[_sigma(child, apriori) ** 2]])
        differences.append(_difference(child, y_sign, spread))
        whole[block, block] = 0.0
    return differences, bool(whole.any())


def _sigma(child: XmlNode, apriori: float) -> float:
    """Standard deviation [mm] as declared, or from the length of a levelling line."""
    attributes = [name for name in ("stdev", "dist") if name in child and child.tag == "dh"]
    if not attributes:
        wanted = "stdev, dist or a <cov-mat>" if child.tag == "dh" else "a <cov-mat>"
        raise child.location.error(f"no standard deviation is given for <{child.tag}>, expected one ({wanted})")
    value = max(child.number(attributes[0]), 0.0)
    return value if attributes[0] == "stdev" else apriori * float(np.sqrt(value))


def _difference(child: XmlNode, y_sign: float, spread: Floats) -> ReferenceDifference:
    """Reference difference of an element with its covariance (1, 1) or (3, 3) [mm^2]."""
    end_names = {"from": child.name("from", "point"), "to": child.name("to", "point")}
    x, y, z = (0.0, 0.0, child.number("val")) if child.tag == "dh" else (child.number(f"d{a}") for a in "xyz")
    if any(child.number(name, 0.0) for name in ("from_dh", "to_dh")):
        message = f"<{child.tag}> with a height of instrument or target, which gama-local leaves out of it"
        raise child.location.error(f"{message}; expected one between the marks, without from_dh and to_dh")
    precision: dict[str, object] = {"known_axes": "z", "known_sigma_mm": float(np.sqrt(max(spread[-1, -1], 0.0)))}
    if child.tag == "vec":
        sign = np.array([1.0, y_sign, 1.0])
        precision = {"known_covariance_mm2": tuple((spread * np.outer(sign, sign))[np.triu_indices(3)].tolist())}
    vector = tuple(round(value / MILLIMETRE, 9) for value in (x, y_sign * y, z))
    if end_names["from"] == end_names["to"]:
        raise child.location.error(f"<{child.tag}> goes from a point to itself, expected two points")
    try:
        return ReferenceDifference.model_validate({**end_names, "known_mm": vector, **precision})
    except ValidationError:
        wanted = "values below 1e8 m, and variances that are positive in every direction"
        raise child.location.error(
            f"<{child.tag}> is too large, or its covariance is wrong, expected {wanted}"
        ) from None


def split_correlations(block: XmlNode, matrix: tuple[Ints, Ints, Floats], n_earlier: int) -> tuple[Floats, Floats]:
    """Standard deviations (n,) of the independent parts of observations, and effects (n, q) of q shared errors.

    With effects F and independent standard deviations on the diagonal of D, the declared covariance is D^2 + F F'. F
    has the smallest number of errors that leaves every observation an independent part. Uncorrelated observations share
    none; `n_earlier` is the number of shared errors of earlier observations.
    """
    (row, column, numbers), diagonal = matrix, matrix[0] == matrix[1]
    if not np.all(numbers[diagonal] > 0.0):
        raise block.location.error("a <cov-mat> whose variances are not all above 0")
    sigma = np.sqrt(numbers[diagonal])
    if not np.any(numbers[~diagonal]):
        return sigma, np.zeros((len(sigma), 0))
    if n_earlier + len(sigma) > MAX_CORRELATED_OBSERVATIONS:
        message = (
            f"more than {MAX_CORRELATED_OBSERVATIONS} observations are correlated, expected fewer; give "
            "variances alone with band 0"
        )
        raise block.location.error(message)
    correlation = np.zeros((len(sigma),) * 2)
    correlation[row, column] = correlation[column, row] = numbers / (sigma[row] * sigma[column])
    linked, reach = correlation != 0.0, []
    for _ in range(len(sigma).bit_length()):
        linked = linked @ linked
    for first in np.unique(np.argmax(linked, axis=1)).tolist():
        if len(group := np.flatnonzero(linked[first])) > 1:
            values, vectors = np.linalg.eigh(correlation[np.ix_(group, group)])
            if values[0] < MAX_ZERO_CORRELATION_EIGENVALUE:
                raise block.location.error("a <cov-mat> that is not positive definite")
            more = values > values[0] * (1.0 + MAX_ZERO_CORRELATION_EIGENVALUE)
            factors = np.zeros((len(sigma), int(more.sum())))
            factors[group] = sigma[group, None] * vectors[:, more] * np.sqrt(values[more] - values[0])
            reach.append(factors)
            sigma[group] *= np.sqrt(values[0])
    return sigma, np.hstack(reach)
