"""The catalogue: one file, one physical effect. To add one, write its file and add it to `CATALOGUE` here."""

from __future__ import annotations

from ltsim.effects.azimuth_eccentricity import AzimuthEccentricity
from ltsim.effects.azimuth_second_order import AzimuthSecondOrder
from ltsim.effects.beam_offset import BeamOffset
from ltsim.effects.beam_tilt import BeamTilt
from ltsim.effects.effect import Effect, Parameter, ShapeParameter, SlotEffect, Stage
from ltsim.effects.elevation_eccentricity import ElevationEccentricity
from ltsim.effects.elevation_second_order import ElevationSecondOrder
from ltsim.effects.range_offset import RangeOffset
from ltsim.effects.range_scale import RangeScale
from ltsim.effects.transit_offset import TransitOffset
from ltsim.effects.transit_tilt import TransitTilt
from ltsim.effects.vertical_index import VerticalIndex

BASELINE: tuple[SlotEffect, ...] = (
    RangeOffset(),
    RangeScale(),
    TransitOffset(),
    BeamOffset(),
    BeamTilt(),
    TransitTilt(),
    VerticalIndex(),
    AzimuthEccentricity(),
    AzimuthSecondOrder(),
    ElevationEccentricity(),
    ElevationSecondOrder(),
)
"""The ordinary calibration: 16 parameters (physics.md 2.2)."""

__all__ = ["BASELINE", "Effect", "Parameter", "ShapeParameter", "SlotEffect", "Stage"]
