"""Export of levelled networks as input files of GNU Gama (``gama-local``), to compare both adjustments."""

from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.core.units import CENTESIMAL_SECOND, GON, MILLIMETRE
from ltsim.geometry.polar import from_polar, swap_front_and_raw
from ltsim.recordings.files import write_text
from ltsim.recordings.formats.gama_network import FIXED_COORDINATE_SIGMA_MM
from ltsim.recordings.recording import SHARED_ERROR_COLUMN_PATTERN, Recording
from ltsim.recordings.references import ReferenceLengths
from ltsim.recordings.reflectors import excess_radii
from ltsim.recordings.setup import Target, Vector, symmetric_matrix

GAMA_XML_NAMESPACE = "http://www.gnu.org/software/gama/gama-local"
"""XML namespace of an input file of gama-local."""


def write(recording: Recording, path: Path) -> None:
    """Export as input file of gama-local: levelled set-ups, face 2 reduced to face 1, reference lengths as distances.

    If no target has known coordinates or defines the datum, the targets of the first set-up get coordinates in its
    frame and define the datum.

    Raises RecordError for a set-up that is not levelled and for SMRs of different radii, which gama-local does not
    support.
    """
    if excess_radii(recording) is not None:
        message = "the recording has SMRs of different radii, which gama-local does not support"
        raise RecordError(f"{message}; write the recording in the native format", file=path)
    if any(SHARED_ERROR_COLUMN_PATTERN.fullmatch(name) for name in recording.covariates):
        raise RecordError(
            "the recording contains errors that readings share, which only the native format supports", file=path
        )
    for name in recording.stations:
        if not recording.station_setup(name).levelled:
            message = f"station {name} is not levelled, and gama-local supports only levelled instruments"
            raise RecordError(f"{message}; set levelled = true in setup.toml if it is levelled", file=path)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<gama-local xmlns="{GAMA_XML_NAMESPACE}">',
        '<network axes-xy="en" angles="right-handed">',
        f"<description>{escape(recording.setup.title)}</description>",
        '<parameters sigma-apr="1" conf-pr="0.95" tol-abs="1000" sigma-act="apriori" />',
        "<points-observations>",
        *_point_lines(recording),
        *_observation_lines(recording),
        *_length_lines(recording),
        *_difference_lines(recording, path),
        "</points-observations>",
        "</network>",
        "</gama-local>",
    ]
    write_text(path, "\n".join(lines) + "\n")


def _point_under_station(recording: Recording, station: str) -> str:
    """Name of the point under a station: the target over which it stands, or else a point with the station's name."""
    mark = recording.station_setup(station).over
    if mark is not None:
        return mark
    return station if station not in recording.targets else f"{station}.station"


def _point_lines(recording: Recording) -> Iterator[str]:
    """XML elements of the points for a gama-local file.

    A point is fixed, adjusted, or adjusted with observed coordinates that have a covariance matrix. Points with capital
    letters (``adj="XYZ"``) define the datum.
    """
    names = dict.fromkeys([*recording.targets, *recording.setup.targets])
    has_datum = any(t.known_mm is not None or t.datum for t in recording.setup.targets.values())
    first_setup_points = {} if has_datum else _coordinates_in_first_setup(recording)
    observed_points = []
    for name in names:
        target = recording.target_setup(name)
        coordinates = target.known_mm or target.approximate_mm or first_setup_points.get(name)
        attributes = "" if coordinates is None else _coordinate_attributes(coordinates)
        datum = target.datum or name in first_setup_points
        if target.known_mm is None:
            yield f'<point id={quoteattr(name)}{attributes} adj="{"XYZ" if datum else "xyz"}" />'
        elif target.known_covariance_mm2 is None and target.known_sigma_mm <= 10 * FIXED_COORDINATE_SIGMA_MM:
            adjusted_axes = "".join(a for a in "xyz" if a not in target.known_axes)
            adjusted = f' adj="{adjusted_axes}"' if adjusted_axes else ""
            yield f'<point id={quoteattr(name)}{attributes} fix="{target.known_axes}"{adjusted} />'
        else:
            yield f'<point id={quoteattr(name)}{attributes} adj="xyz" />'
            observed_points.append((name, target))
    for name in dict.fromkeys(_point_under_station(recording, s) for s in recording.stations):
        if name not in names:
            yield f'<point id={quoteattr(name)} adj="xyz" />'
    for name, target in observed_points:
        yield from _coordinate_lines(name, target)


def _coordinate_attributes(coordinates: Vector, axes: str = "xyz") -> str:
    """XML attributes with the coordinates x, y, z in metres, from `coordinates` [mm]; only those along `axes`."""
    axes_and_values = zip("xyz", coordinates, strict=True)
    return "".join(f' {axis}="{round(value * MILLIMETRE, 12)!r}"' for axis, value in axes_and_values if axis in axes)


def _coordinate_lines(name: str, target: Target) -> Iterator[str]:
    """XML elements of the observed coordinates of a target, with their covariance matrix."""
    attributes = _coordinate_attributes(target.known_mm, target.known_axes) if target.known_mm is not None else ""
    yield f"<coordinates><point id={quoteattr(name)}{attributes} />"
    axes, band = ["xyz".index(axis) for axis in target.known_axes], 0
    matrix = np.eye(3) * target.known_sigma_mm**2
    if target.known_covariance_mm2 is not None:
        matrix, band = symmetric_matrix(target.known_covariance_mm2), len(axes) - 1
    block = matrix[np.ix_(axes, axes)].tolist()
    band_text = " ".join(repr(block[i][j]) for i in range(len(axes)) for j in range(i, min(i + band + 1, len(axes))))
    yield f'<cov-mat dim="{len(axes)}" band="{band}">{band_text}</cov-mat></coordinates>'


def _coordinates_in_first_setup(recording: Recording) -> dict[str, Vector]:
    """Coordinates [mm], by name, of the targets that the first set-up measured completely, in its frame."""
    points = (from_polar(swap_front_and_raw(recording.readings, recording.face)) / MILLIMETRE).round(3).tolist()
    complete_rows = np.flatnonzero((recording.station == 0) & np.all(recording.is_measured, axis=1))
    return {recording.targets[recording.target[i]]: points[i] for i in complete_rows}


def _observation_lines(recording: Recording) -> Iterator[str]:
    """XML elements of the observations from each set-up: directions, zenith angles and distances."""
    front, sigma = swap_front_and_raw(recording.readings, recording.face), recording.reading_sigmas()
    instrument, target_height = (h.tolist() for h in recording.heights_above_marks())
    is_horizontal_distance = recording.is_horizontal_distance
    for s, station in enumerate(recording.stations):
        yield f"<obs from={quoteattr(_point_under_station(recording, station))}>"
        for i in np.flatnonzero(recording.station == s).tolist():
            (distance, azimuth, elevation), (sd, sa, se) = front[i].tolist(), sigma[i].tolist()
            start = f' from_dh="{instrument[i]!r}"' if instrument[i] else ""
            end = f' to_dh="{target_height[i]!r}"' if target_height[i] else ""
            to = f"to={quoteattr(recording.targets[recording.target[i]])}{start}{end}"
            if np.isfinite(azimuth):
                yield f'<direction {to} val="{azimuth % (2 * np.pi) / GON!r}" stdev="{sa / CENTESIMAL_SECOND!r}" />'
            if np.isfinite(elevation):
                yield f'<z-angle {to} val="{(np.pi / 2 - elevation) / GON!r}" stdev="{se / CENTESIMAL_SECOND!r}" />'
            if np.isfinite(distance):
                kind = "distance" if is_horizontal_distance[i] else "s-distance"
                yield f'<{kind} {to} val="{distance!r}" stdev="{sd / MILLIMETRE!r}" />'
        yield "</obs>"


def _length_lines(recording: Recording) -> Iterator[str]:
    """XML elements of the reference lengths, converted to their temperature during the recording."""
    lengths = ReferenceLengths.from_recording(recording)
    ends = [[quoteattr(recording.targets[i]) for i in end] for end in (lengths.first_targets, lengths.second_targets)]
    for first, second, length, sigma in zip(
        *ends, lengths.lengths.tolist(), lengths.total_sigmas.tolist(), strict=True
    ):
        yield f"<obs from={first}>"
        yield f'<s-distance to={second} val="{length!r}" stdev="{sigma / MILLIMETRE!r}" />'
        yield "</obs>"


def _difference_lines(recording: Recording, path: Path) -> Iterator[str]:
    """XML elements of known vectors between marks: height differences, and vectors with their covariance.

    Raises RecordError, which names `path`, for a vector known along other axes than z or xyz.
    """
    for difference in recording.setup.differences:
        ends = f"from={quoteattr(difference.from_)} to={quoteattr(difference.to)}"
        matrix = np.eye(3) * difference.known_sigma_mm**2
        if difference.known_covariance_mm2 is not None:
            matrix = symmetric_matrix(difference.known_covariance_mm2)
        if difference.known_axes == "z":
            value, stdev = round(difference.known_mm[2] * MILLIMETRE, 12), float(np.sqrt(matrix[2, 2]))
            yield f'<height-differences><dh {ends} val="{value!r}" stdev="{stdev!r}" /></height-differences>'
        elif difference.known_axes == "xyz":
            attributes = "".join(f" d{word}" for word in _coordinate_attributes(difference.known_mm).split())
            numbers = " ".join(map(repr, matrix[np.triu_indices(3)].tolist()))
            yield f'<vectors><vec {ends}{attributes} /><cov-mat dim="3" band="2">{numbers}</cov-mat></vectors>'
        else:
            message = f"the difference {difference.label} is given along {difference.known_axes}, expected z or xyz"
            raise RecordError(f"{message}: gama-local has only these", file=path)
