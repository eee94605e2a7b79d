"""Published results for recordings of other authors: adjustments by GNU Gama, true parameters of a scanner."""

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from defusedxml.ElementTree import parse

from experiments.common import RECORDINGS
from ltsim.adjustment import Adjustment
from ltsim.core.arrays import Floats
from ltsim.core.units import ARCSECOND
from ltsim.geometry.polar import to_polar
from ltsim.recordings import Recording
from ltsim.recordings.formats.gama import MIRRORED_AXES
from ltsim.recordings.recording import SIGMA_COLUMNS
from ltsim.recordings.setup import Instrument, Prior, Setup, Target

GAMA = ("local_3d", "2020-barta-phase_0-1TK", "2019-prager")


@dataclass(frozen=True)
class GamaResult:
    """Result of an adjustment by gama-local; y of left-handed systems has its sign changed, as in ltsim's reader."""

    names: tuple[str, ...]
    axis: Floats
    """Axis (0, 1, 2) of each coordinate (k,), at the point of `names`."""
    value: Floats
    sigma: Floats
    """Standard deviation of each coordinate (k,) [m]."""
    square_sum: float
    dof: int
    apriori: float
    aposteriori: float
    """Standard deviation of unit weight (sigma0), estimated from the residuals."""


def gama_result(name: str, folder: str | Path = "gama-3d-networks") -> GamaResult:
    """Published result of GNU Gama for one network."""
    root: Element = parse(RECORDINGS / folder / f"{name}.xml").getroot()
    axes = root.find(".//{*}network-general-parameters")
    turned = axes is None or axes.get("axes-xy", "ne") in MIRRORED_AXES

    def number(tag: str) -> float:
        return float(root.findtext(f".//{{*}}{tag}") or "nan")

    names, axis, value = zip(*(
        (str(point.findtext("{*}id")).replace("/", "_"), "xyz".index(child.tag[-1].lower()), float(child.text or "nan"))
        for point in root.iterfind(".//{*}coordinates/{*}adjusted/{*}point")
        for child in point if child.tag[-1] in "xyzXYZ"
    ), strict=True)  # fmt: skip
    size, width = int(number("cov-mat/{*}dim")), int(number("cov-mat/{*}band"))
    entries = [float(entry.text or "nan") for entry in root.iterfind(".//{*}cov-mat/{*}flt")]
    at = np.cumsum([0, *(min(width, size - 1 - i) + 1 for i in range(size - 1))])
    return GamaResult(
        names, np.array(axis), np.where((np.array(axis) == 1) & turned, -1, 1) * value,
        1e-3 * np.sqrt(np.array(entries)[at])[: len(value)], number("sum-of-squares"),
        int(number("degrees-of-freedom")), number("apriori"), number("aposteriori"),
    )  # fmt: skip


def coordinates_and_sigmas(ours: Adjustment, theirs: GamaResult) -> tuple[Floats, Floats]:
    """Coordinates of ltsim and their standard deviations (k,) [m] for each coordinate of GNU Gama.

    The standard deviations follow from the declared noise. The coordinates of GNU Gama belong to targets, or to marks
    below stations.
    """
    recording, marks, entries = ours.recording, ours.problem.marks, []
    for name, axis in zip(theirs.names, theirs.axis, strict=True):
        if name in recording.targets:
            at = recording.targets.index(name)
            entries.append((ours.state.target_points[at, axis], ours.target_covariances[at, axis, axis]))
        else:
            at = marks.mark_names.index(name)
            place = ours.state.station_positions[at] - marks.instrument_offsets[at]
            entries.append((place[axis], ours.pose_covariance[at, axis, axis]))
    value, variance = np.array(entries).T
    return value, np.sqrt(variance)


SCANNER_TRUTH = {"range-offset": 4000.0, "beam-tilt": -1000.0, "transit-tilt": -1000.0, "vertical-index": 2000.0}
"""True parameters [um, urad] as corrections. The exercise defines them as errors that are added to a reading: a0 = -4
mm, b1 = 1, b2 = -1, c0 = -2 mrad.
"""
ROUNDING = 1e-4 / np.sqrt(12)
"""[m] Standard deviation of coordinates that are printed with a resolution of 0.1 mm."""


def scanner(has_points: bool = True) -> Recording:
    """Two scans of the scanner exercise as a recording, with or without reference coordinates of the object points."""
    folder = RECORDINGS / "eth-tls-calibration-simulated"
    scans = [_points(folder / f"PPE_TLS_T1_Scan{i}.dat") for i in (1, 2)]
    return scanner_recording(scans, _points(folder / "PPE_TLS_T1_OP.txt"), has_points)


def scanner_recording(scans: list[dict[str, Floats]], objects: dict[str, Floats], has_points: bool) -> Recording:
    """Recording of points in the frame of the scanner; its noise is the rounding of the printed coordinates."""
    rows = [(s, n, p) for s, scan in enumerate(scans) for n, p in scan.items()]
    points = np.array([p for _, _, p in rows])
    readings, names = to_polar(points), tuple(objects)
    across = np.hypot(points[:, 0], points[:, 1])
    sigma = (np.full(len(rows), 1e3 * ROUNDING), ROUNDING / across / ARCSECOND, ROUNDING / readings[:, 0] / ARCSECOND)
    wide = Prior(angle_arcsec=2000, range_offset_mm=50, offset_mm=50, range_scale_ppm=1000)
    targets = {n: Target(known_mm=tuple(1e3 * p), known_sigma_mm=1e3 * ROUNDING) for n, p in objects.items()}
    ones = np.ones(len(rows), dtype=np.int64)
    return Recording(
        Setup(instrument=Instrument(prior=wide), targets=targets if has_points else {}),
        tuple(f"S{i + 1}" for i in range(len(scans))), names,
        np.array([s for s, _, _ in rows]), np.array([names.index(n) for _, n, _ in rows]),
        ones, ones, np.arange(len(rows), dtype=np.float64), readings, dict(zip(SIGMA_COLUMNS, sigma, strict=True)),
    )  # fmt: skip


def _points(file: Path) -> dict[str, Floats]:
    """Point name and coordinates [m] of every line that begins with four numbers."""
    points = {}
    for line in file.read_text(encoding="latin-1").splitlines():
        words = line.partition("%")[0].split()
        if len(words) >= 4 and words[0].isdigit():
            points[words[0]] = np.array([float(word) for word in words[1:4]])
    return points
