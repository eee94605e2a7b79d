"""Files `observations.csv` and `setup.toml` of a recording, in the format that docs/reference describes."""

from pathlib import Path

import numpy as np

from .hall import LENGTH_SIGMA, Hall
from .tracker import ARCSECOND, Array

HEAD = "station,target,face,repeat,time_s,azimuth_deg,elevation_deg,distance_mm"


def write_recording(hall: Hall, readings: Array, lengths: Array, folder: Path) -> None:
    """Write raw readings (n, 3) [m, rad, rad] and certified reference lengths (g,) [m] to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    p, stations, targets = hall.pointings, hall.stations, hall.targets
    lines = [",".join([HEAD, *hall.columns])]
    for row, (distance, azimuth, elevation) in enumerate(readings.tolist()):
        place = f"{stations[p.station[row]]},{targets[p.target[row]]},{p.face[row]},{p.repeat[row]},{p.time[row]:.1f}"
        angles = f"{np.degrees(azimuth):.10f},{np.degrees(elevation):.10f},{1e3 * distance:.7f}"
        lines.append(",".join([place, angles, *(f"{column[row]:g}" for column in hall.columns.values())]))
    (folder / "observations.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "setup.toml").write_text("\n".join(_setup(hall, lengths)) + "\n", encoding="utf-8")


def _setup(hall: Hall, lengths: Array) -> list[str]:
    p, several, angle = hall.pointings, len(hall.trackers) > 1, f"{hall.noise[2] / ARCSECOND:.6g}"
    noise = [f"distance_mm = {1e3 * hall.noise[0]:.6g}", f"distance_ppm = {1e6 * hall.noise[1]:g}",
             f"azimuth_arcsec = {angle}", f"elevation_arcsec = {angle}"]  # fmt: skip
    lines = ['format = "ltsim-recording/1"', 'title = ""']
    for name in (f"instruments.{t}" for t in hall.trackers) if several else ("instrument",):
        lines += ["", f"[{name}]", 'construction = "source-in-head"', *(["corrected = true"] if several else [])]
        lines += [f"[{name}.noise]", *noise]
    for (a, b), length in zip(hall.bars.tolist(), lengths.tolist(), strict=True):
        lines += ["", "[[gauge.distance]]", f'from = "{hall.targets[a]}"', f'to = "{hall.targets[b]}"']
        lines += [f"length_mm = {1e3 * length:.5f}", f"sigma_mm = {1e3 * LENGTH_SIGMA:g}"]
    for s, name in enumerate(hall.stations):
        place = np.round(1e3 * p.position[s], -1).tolist()
        lines += ["", f"[stations.{name}]", f"position_mm = {place}", f"yaw_deg = {np.degrees(hall.yaw[s]):.0f}.0"]
        lines += [f'instrument = "{hall.trackers[p.tracker[p.station == s][0]]}"'] if several else []
    for t, name in enumerate(hall.targets):
        lines += ["", f"[targets.{name}]", f"nest_normal = {hall.normals[t].tolist()}"]
    return lines
