"""Prior odds of each simple cause against none: what a surveyor would bet before seeing residuals."""

import numpy as np

SHARE = {
    "outlier": 0.2,
    "constant-offset": 0.15,
    "scale-error": 0.05,
    "target-moved": 0.1,
    "station-bump": 0.1,
    "station-drift": 0.05,
    "orientation": 0.04,
    "reflector-radius": 0.01,
    "reference-value": 0.07,
    "reference-scale": 0.03,
    "names": 0.05,
    "unit": 0.05,
    "height": 0.05,
    "noise-level": 0.05,
}


def log_prior_of(kind: str, places: int) -> float:
    """Log prior of a cause of a kind at one of so many places."""
    return float(np.log(SHARE[kind] / max(places, 1)))
