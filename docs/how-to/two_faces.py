"""A calibrator of one's own, in plain numpy and scipy: three tilts of a tracker from the differences of its two faces.

python two_faces.py RECORDING ESTIMATES.json
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

NAMES = ["vertical-index", "beam-tilt", "transit-tilt"]


def estimates(recording):
    """Vertical index, beam tilt and transit tilt with their standard deviations."""
    table = np.genfromtxt(Path(recording) / "observations.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    table.sort(order=["station", "target", "repeat"])
    one, two = (table[table["face"] == face] for face in (1, 2))
    elevation = np.radians(one["elevation_deg"])
    turn = np.radians(one["azimuth_deg"] - two["azimuth_deg"] - 180.0)
    across = 0.5 * (np.mod(turn + np.pi, 2 * np.pi) - np.pi) * np.cos(elevation)
    upward = 0.5 * (elevation - (np.pi - np.radians(two["elevation_deg"])))

    def residuals(p):
        index, beam, transit = 1e-6 * p
        return 1e6 * np.concatenate([across + beam - transit * np.sin(elevation), upward + index])

    fit = least_squares(residuals, np.zeros(3))
    half = len(elevation)
    noise = np.sqrt([np.sum(part**2) / (half - 2) for part in np.split(fit.fun, 2)])
    design = fit.jac / np.repeat(noise, half)[:, None]
    return fit.x, np.sqrt(np.diag(np.linalg.inv(design.T @ design)))


if __name__ == "__main__":
    found = zip(NAMES, *estimates(sys.argv[1]), strict=True)
    listed = [{"name": name, "value": value, "sigma": sigma, "unit": "urad"} for name, value, sigma in found]
    Path(sys.argv[2]).write_text(json.dumps({"format": "ltsim-estimates/1", "parameters": listed}))
