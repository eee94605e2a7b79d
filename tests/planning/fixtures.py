"""A workshop of the size of the paper's, with two walls, three levels and a gauge near the corner; a small hall."""

from __future__ import annotations

import numpy as np

from ltsim.planning.survey import PlannedSurvey
from ltsim.recordings.setup import GaugeDistance, Instrument, LengthGauge, Noise, Setup

POSITION = np.array([[3.0, 3.0, 2.0], [4.6, 1.9, 1.9], [1.9, 4.6, 2.1], [5.3, 4.4, 1.95], [3.9, 5.5, 2.05]])
YAW = np.radians([225.0, 10.0, 100.0, 300.0, 40.0])
GAUGE = [[0.9, 1.1, 0.2], [1.2, 0.93, 0.26], [1.1, 1.45, 0.33], [0.8, 1.3, 0.55]]


def targets() -> np.ndarray:
    points = []
    for height in (5.9, 2.0, 0.15):
        for along in (0.8, 2.3, 3.9, 5.5):
            points += [[0.0, along, height], [along + 0.1, 0.0, height + 0.02]]
    return np.array(points + GAUGE)


def survey(faces: tuple[int, ...] = (1, 2), stations: int = 5, **changes: object) -> PlannedSurvey:
    points = targets()
    names = tuple(f"T{i + 1:02d}" for i in range(len(points)))
    lengths = []
    for i in range(24, 28):
        for j in range(i + 1, 28):
            length = float(np.linalg.norm(points[i] - points[j])) * 1e3
            lengths.append(GaugeDistance(**{"from": names[i], "to": names[j]}, length_mm=length, sigma_mm=0.003))
    noise = Noise(distance_mm=0.004, distance_ppm=0.0, azimuth_arcsec=0.6, elevation_arcsec=0.6)
    made = PlannedSurvey(
        setup=Setup(instrument=Instrument(noise=noise), gauge=LengthGauge(distance=tuple(lengths))),
        station_names=tuple(f"S{i + 1}" for i in range(stations)),
        target_names=names,
        station_positions=POSITION[:stations],
        station_yaws=YAW[:stations],
        target_points=points,
        is_visible=np.ones((stations, len(points)), dtype=bool),
        faces=faces,
    )
    return made.replace(**changes)


SMALL_HALL_POINTS = {
    "A": (500, 300, 500),
    "B": (5500, 300, 2000),
    "C": (5500, 3700, 800),
    "D": (500, 3700, 2500),
    "E": (3000, 3900, 1500),
}


def small_hall_plan(
    *, obstacle: tuple[str, str], height_mm: str, tolerance_mm: float, floor: str = "", points: str = ""
) -> str:
    """Plan file of a hall of 6 m by 4 m with one obstacle (name, box) and two stations; `points` names a table."""
    name, box_mm = obstacle
    return f"""format = "ltsim-plan/1"
{points}[workshop]
size_mm = [6000, 4000, 3000]
[[workshop.obstacles]]
name = "{name}"
box_mm = {box_mm}
position_mm = [4500, 2800, 0]
[instrument]
preset = "modern"
[floor]
height_mm = {height_mm}
{floor}[stations]
count = 2
min_stations_per_target = 1
[search]
starts = 1
grid_step_mm = 1500
[[goal.tolerances]]
tolerance_mm = {tolerance_mm}
"""
