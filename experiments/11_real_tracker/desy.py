"""Epochs of the DESY girder measurements: recordings, noise estimated from them, face pairs without outliers."""

from itertools import combinations

import numpy as np
import pandas as pd

from experiments.common import RECORDINGS
from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.fieldcheck.setup_model import TwoFacePairs
from ltsim.core.arrays import Bools, Floats
from ltsim.core.units import GON, MILLIMETRE
from ltsim.geometry.polar import from_polar
from ltsim.physics.model.construction import GeometricErrorModel, misalignment_construction
from ltsim.recordings import Hints, Recording, read
from ltsim.recordings.setup import Noise

DATA = RECORDINGS / "desy-girder-at960"
EPOCHS = ("20Sep21", "22Sep21", "21Feb22", "22Feb22", "24Feb22", "1Mar22", "7Mar22", "25Mar22", "21Apr22")
AUTHORS = Noise(distance_mm=0.010, distance_ppm=0.0, azimuth_arcsec=0.486, elevation_arcsec=0.486)
"""Noise that the authors of the data specify: 0.010 mm in distance, 0.15 mgon in both angles."""
START = Noise(distance_mm=0.0015, distance_ppm=0.3, azimuth_arcsec=0.4, elevation_arcsec=0.55)
LONG_LENGTH_M = 1.0
"""[m] Limit between short and long interferometer lengths."""
Dropped = tuple[str, str, int, float]
"""Rejected pointings: station, target, column of the observable with the largest w-test, and w."""


def epoch(name: str, noise: Noise | None = None) -> Recording:
    """Recording of an epoch; its noise is `noise`, or that of the default instrument."""
    recording = read(DATA / f"Polar_measurements_{name}.txt", hints=Hints(azimuth="clockwise"))
    if noise is None:
        return recording
    setup = recording.setup
    instruments = {name: i.model_copy(update={"noise": noise}) for name, i in setup.instruments.items()}
    instrument = setup.instrument.model_copy(update={"noise": noise})
    return recording.replace(setup=setup.model_copy(update={"instrument": instrument, "instruments": instruments}))


def set_up(recording: Recording, number: int) -> Recording:
    """Recording with only one set-up of a recording."""
    return recording.select(recording.station == number)


def reject_outliers(
    recording: Recording, construction: GeometricErrorModel | None = None
) -> tuple[Recording, list[Dropped]]:
    """Recording after iterative data snooping, and the rejected pointings.

    In each step, the pointings of a station to the target with the largest w-test are rejected.
    """
    built, dropped = construction or misalignment_construction(), []
    while flagged := adjust(recording, built).flagged_readings():
        i = flagged[0].pointing_index
        pointings = (recording.station == recording.station[i]) & (recording.target == recording.target[i])
        station, target = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        dropped.append((station, target, flagged[0].observable_column, flagged[0].normalised_residual))
        recording = recording.select(~(pointings & (recording.repeat == recording.repeat[i])))
    return recording, dropped


def variance_factors(adjustments: list[Adjustment]) -> Floats:
    """Ratios (3,) of estimated to declared standard deviation of range, azimuth and elevation (Helmert).

    The ratios are those of one iteration of Helmert's estimator.
    """
    squares, redundancy = np.zeros(3), np.zeros(3)
    for a in adjustments:
        squares += np.nansum((a.residuals / a.problem.reading_sigmas) ** 2, axis=0)
        redundancy += np.nansum(a.redundancy, axis=0)
    factors: Floats = np.sqrt(squares / redundancy)
    return factors


def estimated_noise(rounds: int = 4) -> Noise:
    """Noise for which the variance factor of each observable over all epochs is 1, without outliers."""
    noise = START
    for _ in range(rounds):
        recordings = [reject_outliers(epoch(name, noise))[0] for name in EPOCHS]
        factor = variance_factors([adjust(r, misalignment_construction()) for r in recordings])
        noise = Noise(
            distance_mm=noise.distance_mm * factor[0],
            distance_ppm=noise.distance_ppm * factor[0],
            azimuth_arcsec=noise.azimuth_arcsec * factor[1],
            elevation_arcsec=noise.elevation_arcsec * factor[2],
        )
    return noise


def is_clean_pair(pairs: TwoFacePairs, recording: Recording) -> Bools:
    """(m,) True for pairs of faces that data snooping does not reject.

    Snooping uses only the recording, and not the parameters under test.
    """
    gone = {d[:2] for d in reject_outliers(recording)[1]}
    rows = pairs.pointing_indices[:, 0]
    return np.array([(recording.stations[recording.station[i]], recording.targets[recording.target[i]]) not in gone
                     for i in rows], dtype=bool)  # fmt: skip


def interferometer(name: str) -> pd.DataFrame:
    """Table of the interferometer lengths [m] between two targets of an epoch.

    The column `way` identifies a length, which is measured in both directions.
    """
    names = ["line", "target", "horizontal", "vertical", "distance"]
    rows = pd.read_csv(DATA / f"LoS_measurements_{name}.txt", sep=r"\s+", header=None, names=names)
    polar = np.stack([MILLIMETRE * rows.distance, -GON * rows.horizontal, GON * (100.0 - rows.vertical)], axis=1)
    rows["place"] = list(from_polar(polar))
    lengths = []
    for line, points in rows.groupby("line", sort=False):
        for (a, from_), (b, to) in combinations(zip(points.target, points.place, strict=True), 2):
            length = float(np.linalg.norm(from_ - to))
            level = f"horizontal and diagonal, {'over' if length > LONG_LENGTH_M else 'under'} 1 m"
            kind, way = "vertical" if line.startswith("Ver") else level, (line[:-2], *sorted((a, b)))
            lengths.append((kind, way, a, b, length))
    return pd.DataFrame(lengths, columns=["lines", "way", "first", "second", "length"])
