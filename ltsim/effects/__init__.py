"""The catalogue: one physical effect, one small file. To add one, write its file and list its class in its group."""

from ltsim.effects.air_gradient import AirGradient
from ltsim.effects.air_layer import AirLayer
from ltsim.effects.azimuth_drift import AzimuthDrift
from ltsim.effects.azimuth_eccentricity import AzimuthEccentricity
from ltsim.effects.azimuth_harmonic import AzimuthHarmonic
from ltsim.effects.azimuth_second_order import AzimuthSecondOrder
from ltsim.effects.backlash import Backlash
from ltsim.effects.beam_offset import BeamOffset
from ltsim.effects.beam_tilt import BeamTilt
from ltsim.effects.bearing_wobble import BearingWobble
from ltsim.effects.catalogue import Card as Card, Catalogue, Entry as Entry, card_of as card_of
from ltsim.effects.dead_path import DeadPath
from ltsim.effects.detector_offset import DetectorOffset
from ltsim.effects.effect import (
    Effect as Effect,
    NoiseEffect as NoiseEffect,
    Parameter as Parameter,
    ShapeParameter as ShapeParameter,
    SlotEffect as SlotEffect,
    Stage as Stage,
)
from ltsim.effects.elevation_eccentricity import ElevationEccentricity
from ltsim.effects.elevation_harmonic import ElevationHarmonic
from ltsim.effects.elevation_second_order import ElevationSecondOrder
from ltsim.effects.encoder_interpolation import EncoderInterpolation
from ltsim.effects.face_confusion import FaceConfusion
from ltsim.effects.gauge_scale import GaugeScale
from ltsim.effects.gauge_shape import GaugeShape
from ltsim.effects.head_sag import HeadSag
from ltsim.effects.heat_plume import HeatPlume
from ltsim.effects.index_drift import IndexDrift
from ltsim.effects.mesh_expansion import MeshExpansion
from ltsim.effects.nest_lift import NestLift
from ltsim.effects.noise_level import NoiseLevel
from ltsim.effects.outlier import Outlier
from ltsim.effects.range_cyclic import RangeCyclic
from ltsim.effects.range_drift import RangeDrift
from ltsim.effects.range_mode import RangeMode
from ltsim.effects.range_offset import RangeOffset
from ltsim.effects.range_scale import RangeScale
from ltsim.effects.range_step import RangeStep
from ltsim.effects.refractivity_drift import RefractivityDrift
from ltsim.effects.smr_centring import SmrCentring
from ltsim.effects.smr_dihedral import SmrDihedral
from ltsim.effects.smr_incidence import SmrIncidence
from ltsim.effects.smr_offset import SmrOffset
from ltsim.effects.station_bump import StationBump
from ltsim.effects.station_levelling import StationLevelling
from ltsim.effects.station_noise import StationNoise
from ltsim.effects.station_settling import StationSettling
from ltsim.effects.station_weather import StationWeather
from ltsim.effects.target_moved import TargetMoved
from ltsim.effects.target_swap import TargetSwap
from ltsim.effects.timing_lag import TimingLag
from ltsim.effects.transit_offset import TransitOffset
from ltsim.effects.transit_tilt import TransitTilt
from ltsim.effects.turbulence import Turbulence
from ltsim.effects.vertical_index import VerticalIndex
from ltsim.effects.window import Window
from ltsim.effects.wrong_unit import WrongUnit

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
"""The ordinary calibration: the 16 parameters of the geometric-misalignment model with range zero and scale."""

GROUPS: dict[str, tuple[type[Effect], ...]] = {
    "instrument geometry": (
        BeamOffset,
        TransitOffset,
        BeamTilt,
        TransitTilt,
        VerticalIndex,
        AzimuthEccentricity,
        ElevationEccentricity,
        AzimuthSecondOrder,
        ElevationSecondOrder,
        AzimuthHarmonic,
        ElevationHarmonic,
        EncoderInterpolation,
        BearingWobble,
        HeadSag,
        Backlash,
        DetectorOffset,
    ),
    "range": (
        RangeOffset,
        RangeMode,
        RangeStep,
        RangeScale,
        StationWeather,
        DeadPath,
        RangeCyclic,
        RefractivityDrift,
        RangeDrift,
    ),
    "air": (AirGradient, AirLayer, HeatPlume, Turbulence),
    "reflector": (SmrCentring, SmrIncidence, SmrDihedral, Window, SmrOffset, NestLift, TargetMoved),
    "time and heat": (IndexDrift, AzimuthDrift, StationSettling, MeshExpansion, GaugeScale, GaugeShape),
    "system and gross": (StationLevelling, TimingLag, StationBump, TargetSwap, Outlier, WrongUnit, FaceConfusion),
    "noise": (NoiseLevel, StationNoise),
}
"""What ships, by group, in the order of the files."""

CATALOGUE = Catalogue(GROUPS)
"""Every effect: what ships, then what installed packages add (see `effects.catalogue`)."""

find_effect = CATALOGUE.find
