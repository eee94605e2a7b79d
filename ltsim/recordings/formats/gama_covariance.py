"""Observations that GNU Gama states with a matrix: height differences, vectors, and errors that observations share."""

import numpy as np
from pydantic import ValidationError

from ltsim.core.arrays import Floats, Ints
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.files import shown
from ltsim.recordings.setup import KnownDifference
from ltsim.recordings.xml import Node, banded

MOST_SHARED = 500
"""Observations of a file that are correlated: each error that they share is an unknown of the adjustment."""
ALIKE = 1e-6
"""Eigenvalue of a correlation that counts as none, and share by which two are taken for one."""


def covariances(node: Node) -> tuple[Ints, Ints, Floats]:
    """Row, column and value (k,) of the upper triangle of a matrix in Gama's band form, [mm^2] or [cc^2]."""
    matrix = next((inner for inner in node if inner.tag == "cov-mat"), None)
    if matrix is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
    values = [matrix.where.number(word, "cov-mat") for word in matrix.text.split()]
    return banded(matrix, matrix.number("dim"), matrix.number("band"), values)


def differences_of(section: Node, y_sign: float, apriori: float) -> tuple[list[KnownDifference], bool]:
    """Height differences or vectors of a section, and whether it correlates several, which is not kept.

    A height difference without a standard deviation has `apriori` mm times the root of its way in kilometres.
    """
    inner = [child for child in section if child.tag != "cov-mat"]
    tag, size = ("dh", 1) if section.tag == "height-differences" else ("vec", 3)
    row, column, numbers = covariances(section)
    wrong = next((child for child in inner if child.tag != tag), None)
    if wrong is not None:
        raise wrong.where.wrong(f"<{shown(wrong.tag)}> stands in <{section.tag}>, expected <{tag}>")
    if len(numbers) and row[-1] + 1 != size * len(inner):
        raise section.where.wrong("a <cov-mat> that does not match its observations")
    whole, found = np.zeros((size * len(inner),) * 2), []
    whole[row, column] = whole[column, row] = numbers
    for k, child in enumerate(inner):
        own = slice(size * k, size * (k + 1))
        spread = whole[own, own].copy() if len(numbers) else np.array([[_sigma(child, apriori) ** 2]])
        found.append(_difference(child, y_sign, spread))
        whole[own, own] = 0.0
    return found, bool(whole.any())


def _sigma(child: Node, apriori: float) -> float:
    """Standard deviation [mm] as stated, or by the length of a levelled line."""
    stated = [name for name in ("stdev", "dist") if name in child and child.tag == "dh"]
    if not stated:
        wanted = "stdev, dist or a <cov-mat>" if child.tag == "dh" else "a <cov-mat>"
        raise child.where.wrong(f"no standard deviation is stated for <{child.tag}>, expected one ({wanted})")
    value = max(child.number(stated[0]), 0.0)
    return value if stated[0] == "stdev" else apriori * float(np.sqrt(value))


def _difference(child: Node, y_sign: float, spread: Floats) -> KnownDifference:
    """One element with its covariance (1, 1) or (3, 3) [mm^2]."""
    ends = {"from": child.name("from", "point"), "to": child.name("to", "point")}
    x, y, z = (0.0, 0.0, child.number("val")) if child.tag == "dh" else (child.number(f"d{a}") for a in "xyz")
    if any(child.number(name, 0.0) for name in ("from_dh", "to_dh")):
        message = f"<{child.tag}> with a height of instrument or target, which gama-local leaves out of it"
        raise child.where.wrong(f"{message}; expected one between the marks, without from_dh and to_dh")
    stated: dict[str, object] = {"known_axes": "z", "known_sigma_mm": float(np.sqrt(max(spread[-1, -1], 0.0)))}
    if child.tag == "vec":
        sign = np.array([1.0, y_sign, 1.0])
        stated = {"known_covariance_mm2": tuple((spread * np.outer(sign, sign))[np.triu_indices(3)].tolist())}
    known = tuple(round(value / MILLIMETRE, 9) for value in (x, y_sign * y, z))
    if ends["from"] == ends["to"]:
        raise child.where.wrong(f"<{child.tag}> goes from a point to itself, expected two points")
    try:
        return KnownDifference.model_validate({**ends, "known_mm": known, **stated})
    except ValidationError:
        wanted = "values below 1e8 m, and variances that are positive in every direction"
        raise child.where.wrong(f"<{child.tag}> is too large, or its covariance is none, expected {wanted}") from None


def shared_errors(block: Node, matrix: tuple[Ints, Ints, Floats], before: int) -> tuple[Floats, Floats]:
    """Standard deviations (n,) of observations by themselves, and what each of q errors that they share does (n, q).

    With F the latter and D the former on the diagonal the stated covariance is D^2 + F F': F is as few errors as leave
    every observation one of its own. Observations that are correlated with no other share none; `before` is how many
    others share already.
    """
    (row, column, numbers), own = matrix, matrix[0] == matrix[1]
    if not np.all(numbers[own] > 0.0):
        raise block.where.wrong("a <cov-mat> whose variances are not all above 0")
    sigma = np.sqrt(numbers[own])
    if not np.any(numbers[~own]):
        return sigma, np.zeros((len(sigma), 0))
    if before + len(sigma) > MOST_SHARED:
        message = f"more than {MOST_SHARED} observations are correlated, expected fewer; band 0 states variances alone"
        raise block.where.wrong(message)
    correlation = np.zeros((len(sigma),) * 2)
    correlation[row, column] = correlation[column, row] = numbers / (sigma[row] * sigma[column])
    linked, reach = correlation != 0.0, []
    for _ in range(len(sigma).bit_length()):
        linked = linked @ linked
    for first in np.unique(np.argmax(linked, axis=1)).tolist():
        if len(group := np.flatnonzero(linked[first])) > 1:
            values, vectors = np.linalg.eigh(correlation[np.ix_(group, group)])
            if values[0] < ALIKE:
                raise block.where.wrong("a <cov-mat> that is no covariance, expected one that is positive definite")
            more = values > values[0] * (1.0 + ALIKE)
            found = np.zeros((len(sigma), int(more.sum())))
            found[group] = sigma[group, None] * vectors[:, more] * np.sqrt(values[more] - values[0])
            reach.append(found)
            sigma[group] *= np.sqrt(values[0])
    return sigma, np.hstack(reach)
