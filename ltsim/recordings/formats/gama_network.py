"""Content of an input file of GNU Gama, and conversion of correlated observations to independent and shared errors."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from ltsim.core.arrays import Floats, Ints
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.pointings import SingleObservation, numbered_name, numbered_names
from ltsim.recordings.setup import GaugeDistance, ReferenceDifference, Vector
from ltsim.recordings.xml import BAND_MATRIX_SIZE_MESSAGE, XmlNode, band_matrix_entries, band_matrix_value_count

FIXED_COORDINATE_SIGMA_MM = 1e-4
"""Standard deviation [mm] that represents a fixed coordinate in the adjustment."""


@dataclass
class GamaPoint:
    """Point declared in a file of gama-local: coordinates, their precision, and how each axis is treated."""

    coordinates_by_axis: dict[str, float] = field(default_factory=dict)
    """Coordinates [m] by letter of the axis."""
    fixed_axes: str = ""
    """Axes along which the point is fixed, or its coordinates were observed."""
    datum_axes: str = ""
    """Axes along which the point takes part in the definition of the datum."""
    active_axes: str = ""
    """Axes along which the point is fixed or adjusted; along other axes it has no coordinate."""
    sigma_mm: float = FIXED_COORDINATE_SIGMA_MM
    """Standard deviation [mm] of the coordinates along the fixed axes."""
    covariance_mm2: tuple[float, ...] | None = None
    """Covariance xx, xy, xz, yy, yz, zz [mm^2] of the coordinates; None if not given."""

    @property
    def complete_coordinates(self) -> Vector | None:
        """Coordinates x, y, z [mm] of the point; None if one of them is missing."""
        return self.coordinates_or_zeros if len(self.coordinates_by_axis) == 3 else None

    @property
    def coordinates_or_zeros(self) -> Vector:
        """Coordinates x, y, z [mm] of the point, with 0 for each missing one."""
        x, y, z = (round(self.coordinates_by_axis.get(axis, 0.0) / MILLIMETRE, 9) for axis in "xyz")
        return x, y, z


@dataclass
class GamaNetwork:
    """Content of a file of gama-local, which the reader completes element by element."""

    file: Path
    title: str = ""
    y_sign: float = 1.0
    """Factor of y coordinates: -1 if the file has a left-handed frame, otherwise 1."""
    angle_sign: float = -1.0
    """Factor of horizontal angles: -1 if angles in the file are clockwise, otherwise 1."""
    default_sigmas: dict[str, str] = field(default_factory=dict)
    """Default standard deviation of the file, as text, by kind of observation."""
    points: dict[str, GamaPoint] = field(default_factory=dict)
    n_direction_sets_by_point: Counter[str] = field(default_factory=Counter)
    """Number of sets of directions at each point."""
    point_of_station: dict[str, str] = field(default_factory=dict)
    north_direction_deg: float = 0.0
    """Direction [deg] of north, counter-clockwise from x."""
    oriented_setups: set[str] = field(default_factory=set)
    """Names of the set-ups with azimuths: their horizontal circle reads 0 towards north."""
    observations: list[SingleObservation] = field(default_factory=list)
    apriori_sigma: float = 10.0
    """A-priori standard deviation [mm, cc] of an observation of unit weight."""
    differences: list[ReferenceDifference] = field(default_factory=list)
    n_skipped_by_element: Counter[str] = field(default_factory=Counter)
    n_shared_errors: int = 0
    """Number of errors shared by several observations so far."""
    notes: list[str] = field(default_factory=list)

    def setup_name(self, point: str, *, with_directions: bool = False) -> str:
        """Name of the set-up over a point for new observations; each further set of directions starts a set-up.

        `with_directions` is True if the observations include a set of directions.
        """
        self.n_direction_sets_by_point[point] += with_directions
        name = numbered_name(point, max(self.n_direction_sets_by_point[point] - 1, 0))
        self.point_of_station[name] = point
        return name


def drop_height_dependent_observations(network: GamaNetwork) -> None:
    """Removal, in place, of observations that need the height of a point of which only plan coordinates are adjusted.

    The heights of these points are then held fixed, as in Gama.
    """
    plan_points = {name for name, point in network.points.items() if point.active_axes == "xy"}
    if not plan_points:
        return
    observations = []
    for o in network.observations:
        in_plan = bool({network.point_of_station[o.station], o.target} & plan_points)
        if not in_plan or o.kind == "azimuth" or o.is_horizontal_distance:
            observations.append(replace(o, instrument_height=0.0, target_height=0.0) if in_plan else o)
    differences = [
        difference
        for difference in network.differences
        if not ({difference.from_, difference.to} & plan_points and difference.known_axes == "z")
    ]
    n_removed = len(network.observations) - len(observations) + len(network.differences) - len(differences)
    network.differences = [
        difference.model_copy(update={"known_axes": "xy"})
        if {difference.from_, difference.to} & plan_points
        else difference
        for difference in differences
    ]
    for name in plan_points:
        network.points[name].coordinates_by_axis.setdefault("z", 0.0)
        network.points[name].fixed_axes += "z"
    network.notes.append(
        f'{len(plan_points)} points are adjusted in plan only (adj="xy"): they have no heights, and '
        f"{n_removed} observations that need heights are left out, as Gama does"
    )
    network.observations = observations


def split_reference_lengths(network: GamaNetwork) -> tuple[list[GaugeDistance], list[SingleObservation]]:
    """Reference lengths, and all other observations.

    A slope distance without heights is a reference length under two conditions: its station has no angles and no
    horizontal distances, and both ends are targets of stations that have angles or horizontal distances.
    """
    stations_with_angles = {o.station for o in network.observations if o.kind != "distance" or o.is_horizontal_distance}
    targets = {o.target for o in network.observations if o.station in stations_with_angles}
    gauge, other_observations = [], []
    for o in network.observations:
        point = network.point_of_station[o.station]
        if (
            o.station in stations_with_angles
            or point == o.target
            or not {point, o.target} <= targets
            or any(o.heights)
            or o.shared_error_shifts
        ):
            other_observations.append(o)
        else:
            length = {"length_mm": o.value / MILLIMETRE, "sigma_mm": o.sigma / MILLIMETRE}
            gauge.append(GaugeDistance.model_validate({"from": point, "to": o.target, **length}))
    return gauge, other_observations


def differences_with_distinct_names(differences: list[ReferenceDifference]) -> Iterator[ReferenceDifference]:
    """Known vectors with distinct names: several between two points (a line levelled twice) get numbers."""
    names = numbered_names(difference.label for difference in differences)
    for difference, name in zip(differences, names, strict=True):
        yield difference if name == difference.label else difference.model_copy(update={"name": name})


MAX_CORRELATED_OBSERVATIONS = 500
"""Largest permitted number of correlated observations in a file; each error that they share is an unknown of the
adjustment."""
MAX_ZERO_CORRELATION_EIGENVALUE = 1e-6
"""Largest eigenvalue of a correlation matrix of observations that counts as zero; the matrix is then singular and
refused. Two eigenvalues whose relative difference is smaller also count as equal.

Two eigenvalues whose relative difference is smaller also count as equal."""


def covariance_entries(node: XmlNode) -> tuple[Ints, Ints, Floats]:
    """Row index (k,), column index (k,), value (k,) [mm^2, cc^2] of the k entries in the upper band of a covariance.

    The covariance is the <cov-mat> inside the XML element `node`; without it the arrays are empty.
    """
    matrix = next((inner for inner in node if inner.tag == "cov-mat"), None)
    if matrix is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
    n_rows, band = matrix.read_number("dim"), matrix.read_number("band")
    size = band_matrix_value_count(matrix, n_rows, band)
    words = (matrix.element.text or "").split(maxsplit=size)
    if len(words) != size:
        raise matrix.location.error(BAND_MATRIX_SIZE_MESSAGE)
    return band_matrix_entries(matrix, n_rows, band, [matrix.location.parse_number(word, "cov-mat") for word in words])


def read_differences(section: XmlNode, y_sign: float, apriori_sigma: float) -> tuple[list[ReferenceDifference], bool]:
    """Known vectors from a section of height differences or vectors, and True if correlations between them are ignored.

    `y_sign` is the factor of y coordinates. A height difference without standard deviation has `apriori_sigma` [mm]
    times the square root of the length of its line in km.
    """
    children = [child for child in section if child.tag != "cov-mat"]
    tag, size = ("dh", 1) if section.tag == "height-differences" else ("vec", 3)
    row, column, numbers = covariance_entries(section)
    wrong_child = next((child for child in children if child.tag != tag), None)
    if wrong_child is not None:
        raise wrong_child.location.error(f"<{safe_excerpt(wrong_child.tag)}> is in <{section.tag}>, expected <{tag}>")
    if len(numbers) and row[-1] + 1 != size * len(children):
        raise section.location.error("the size of <cov-mat> does not match its observations")
    covariances = np.zeros((len(children), size, size))
    is_within = row // size == column // size
    k, i, j = row[is_within] // size, row[is_within] % size, column[is_within] % size
    covariances[k, i, j] = covariances[k, j, i] = numbers[is_within]
    if not len(numbers):
        covariances = np.array([[[_sigma_of_difference(child, apriori_sigma) ** 2]] for child in children])
    differences = [_reference_difference(child, y_sign, c) for child, c in zip(children, covariances, strict=True)]
    return differences, bool(np.any(numbers[~is_within]))


def _sigma_of_difference(child: XmlNode, apriori_sigma: float) -> float:
    """Standard deviation [mm] of a height difference, as declared or from the length of its levelling line.

    For a line of D km it is `apriori_sigma` [mm] times the square root of D. Raises RecordError.
    """
    attributes = [name for name in ("stdev", "dist") if name in child and child.tag == "dh"]
    if not attributes:
        expected_text = "stdev, dist or a <cov-mat>" if child.tag == "dh" else "a <cov-mat>"
        raise child.location.error(f"no standard deviation is given for <{child.tag}>, expected one ({expected_text})")
    value = max(child.read_number(attributes[0]), 0.0)
    return value if attributes[0] == "stdev" else apriori_sigma * float(np.sqrt(value))


def _reference_difference(child: XmlNode, y_sign: float, covariance: Floats) -> ReferenceDifference:
    """Known vector from an element ``<dh>`` or ``<vec>`` with its covariance, (1, 1) or (3, 3) [mm^2].

    `y_sign` is the factor of y coordinates. Raises RecordError.
    """
    end_names = {"from": child.read_name("from", "point"), "to": child.read_name("to", "point")}
    x, y, z = (0.0, 0.0, child.read_number("val")) if child.tag == "dh" else (child.read_number(f"d{a}") for a in "xyz")
    if any(child.read_number(name, 0.0) for name in ("from_dh", "to_dh")):
        message = f"<{child.tag}> has a height of instrument or target, which gama-local does not use"
        raise child.location.error(f"{message}; expected a difference between the marks, without from_dh and to_dh")
    precision: dict[str, object] = {"known_axes": "z", "known_sigma_mm": float(np.sqrt(max(covariance[-1, -1], 0.0)))}
    if child.tag == "vec":
        sign = np.array([1.0, y_sign, 1.0])
        precision = {"known_covariance_mm2": tuple((covariance * np.outer(sign, sign))[np.triu_indices(3)].tolist())}
    vector = tuple(round(value / MILLIMETRE, 9) for value in (x, y_sign * y, z))
    if end_names["from"] == end_names["to"]:
        raise child.location.error(f"<{child.tag}> goes from a point to itself, expected two points")
    try:
        return ReferenceDifference.model_validate({**end_names, "known_mm": vector, **precision})
    except ValidationError:
        expected_text = "values below 1e8 m, and a positive definite covariance matrix"
        raise child.location.error(
            f"the value of <{child.tag}> is too large, or its covariance is wrong, expected {expected_text}"
        ) from None


def split_correlations(block: XmlNode, matrix: tuple[Ints, Ints, Floats], n_earlier: int) -> tuple[Floats, Floats]:
    """Division of the declared covariance of n observations into independent errors and errors that they share.

    The results are the standard deviations (n,) of the independent errors, and the changes F (n, q) of the observations
    by one standard deviation of each of q shared errors. With the diagonal matrix D of the independent standard
    deviations, the declared covariance is D^2 + F F'. F has as few columns as permit a D without zeros, and none for
    uncorrelated observations. `matrix` has row indices, column indices and values of the upper band of the covariance.
    `n_earlier` is the number of shared errors of earlier observations, which count for the limit. Raises RecordError.
    """
    (row, column, numbers), diagonal = matrix, matrix[0] == matrix[1]
    if not np.all(numbers[diagonal] > 0.0):
        raise block.location.error("<cov-mat> has a variance that is not above 0")
    sigma = np.sqrt(numbers[diagonal])
    if not np.any(numbers[~diagonal]):
        return sigma, np.zeros((len(sigma), 0))
    if n_earlier + len(sigma) > MAX_CORRELATED_OBSERVATIONS:
        message = (
            f"the covariances correlate more than {MAX_CORRELATED_OBSERVATIONS} observations, the limit; give "
            'variances only (band="0")'
        )
        raise block.location.error(message)
    correlation = np.zeros((len(sigma),) * 2)
    correlation[row, column] = correlation[column, row] = numbers / (sigma[row] * sigma[column])
    is_linked, shared_effects = correlation != 0.0, []
    for _ in range(len(sigma).bit_length()):
        is_linked = is_linked @ is_linked
    for first in np.unique(np.argmax(is_linked, axis=1)).tolist():
        if len(group := np.flatnonzero(is_linked[first])) > 1:
            values, vectors = np.linalg.eigh(correlation[np.ix_(group, group)])
            if values[0] < MAX_ZERO_CORRELATION_EIGENVALUE:
                raise block.location.error("<cov-mat> is not positive definite")
            is_larger = values > values[0] * (1.0 + MAX_ZERO_CORRELATION_EIGENVALUE)
            factors = np.zeros((len(sigma), int(is_larger.sum())))
            factors[group] = sigma[group, None] * vectors[:, is_larger] * np.sqrt(values[is_larger] - values[0])
            shared_effects.append(factors)
            sigma[group] *= np.sqrt(values[0])
    return sigma, np.hstack(shared_effects)
