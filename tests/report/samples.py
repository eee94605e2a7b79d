"""Data for the report's tests: an adjusted network, and folders as the commands write them."""

from __future__ import annotations

from functools import cache

import numpy as np

from ltsim.adjust.adjustment import Adjustment, adjust
from ltsim.model.construction import misalignment
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Station
from tests.networks import STATIONS, YAWS, drawn, network


@cache
def recording() -> Recording:
    """The test network in two faces with noise, instrument errors and a floor plan."""
    made, _ = network(faces=2, seed=4, values=drawn(misalignment(), 7))
    plan = {
        name: Station(position_mm=place, yaw_deg=float(np.degrees(yaw)))
        for name, place, yaw in zip(made.stations, (1e3 * STATIONS).tolist(), YAWS, strict=True)
    }
    return made.replace(setup=made.setup.model_copy(update={"stations": plan}))


@cache
def before() -> Adjustment:
    """The network adjusted without instrument parameters."""
    return adjust(recording())


@cache
def after() -> Adjustment:
    """The network adjusted with them."""
    return adjust(recording(), misalignment())
