"""What flips with the face and what does not."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.physics.effects import ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.effects.air_gradient import AirGradient
from ltsim.physics.effects.air_layer import AirLayer
from ltsim.physics.effects.azimuth_drift import AzimuthDrift
from ltsim.physics.effects.azimuth_harmonic import AzimuthHarmonic
from ltsim.physics.effects.bearing_wobble import BearingWobble
from ltsim.physics.effects.detector_offset import DetectorOffset
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.elevation_harmonic import ElevationHarmonic
from ltsim.physics.effects.head_sag import HeadSag
from ltsim.physics.effects.heat_plume import HeatPlume
from ltsim.physics.effects.index_drift import IndexDrift
from ltsim.physics.effects.mesh_expansion import MeshExpansion
from ltsim.physics.effects.nest_lift import NestLift
from ltsim.physics.effects.range_cyclic import RangeCyclic
from ltsim.physics.effects.range_drift import RangeDrift
from ltsim.physics.effects.range_step import RangeStep
from ltsim.physics.effects.reflector_constant import ReflectorConstant
from ltsim.physics.effects.refractivity_drift import RefractivityDrift
from ltsim.physics.effects.smr_centring import SmrCentring
from ltsim.physics.effects.smr_dihedral import SmrDihedral
from ltsim.physics.effects.smr_offset import SmrOffset
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.effects.station_levelling import StationLevelling
from ltsim.physics.effects.station_settling import StationSettling
from ltsim.physics.effects.station_weather import StationWeather
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.physics.effects.window import Window
from tests.physics.effects.scenes import corrections, on_face, scene

SCENE = scene()
FLIPS, SAME = -1.0, 1.0

PARITY: list[tuple[Effect, list[float]]] = [
    (DetectorOffset(), [FLIPS, FLIPS]),
    *((AzimuthHarmonic(order=m), [SAME if m % 2 == 0 else FLIPS] * 2) for m in range(3, 9)),
    *((ElevationHarmonic(order=m), [FLIPS, SAME] if m % 2 == 0 else [SAME, FLIPS]) for m in range(3, 9)),
    *((BearingWobble(kind="tilt", order=n), [SAME if n % 2 == 0 else FLIPS] * 2) for n in (-1, 2, 3)),
    *((BearingWobble(kind="radial", order=n), [SAME if n % 2 == 0 else FLIPS] * 2) for n in (2, 3)),
    (BearingWobble(kind="transit", order=2), [FLIPS, SAME]),
    (HeadSag(), [SAME]),
    (RangeStep(("S2",), time=0.0), [SAME]),
    (ReflectorConstant(("S2",)), [SAME]),
    (StationWeather(("S2",)), [SAME]),
    (RangeCyclic(), [SAME, SAME]),
    (RefractivityDrift(), [SAME]),
    (RangeDrift(), [SAME]),
    (IndexDrift(law="linear"), [FLIPS]),
    (IndexDrift(law="exponential"), [FLIPS]),
    (AzimuthDrift(), [SAME]),
    (AirGradient(), [SAME]),
    (AirLayer(), [SAME]),
    (HeatPlume(("S1",), offset=(0.3, 0.2, 0.1)), [SAME]),
    (SmrCentring(), [SAME] * 3),
    (SmrDihedral((), ("T05",)), [SAME, SAME]),
    (Window(("S1",), pane_normal=(0.6, 0.8, 0.0)), [SAME]),
    (SmrOffset(("S1",)), [SAME]),
    (NestLift(("S1",), ("T03",), kind="free"), [SAME] * 3),
    (TargetMoved((), ("T03",)), [SAME] * 3),
    (StationSettling(("S3",)), [SAME] * 3),
    (StationBump(("S3",)), [SAME] * 6),
    (StationLevelling(("S3",)), [SAME] * 2),
    (MeshExpansion(), [SAME]),
]


def label(value: object) -> str:
    return repr(value) if isinstance(value, Effect) else ""


@pytest.mark.parametrize(("effect", "parity"), PARITY, ids=label)
def test_correction_on_both_faces(effect: Effect, parity: list[float]) -> None:
    front, back = (corrections(effect, on_face(SCENE, face)) for face in (1, 2))
    scale = np.abs(front).max(axis=(0, 1))
    assert (scale > 0).all()
    np.testing.assert_allclose(back / scale, front * np.array(parity) / scale, atol=1e-9)


def test_baseline_has_the_forms_and_face_signs_of_the_table() -> None:
    """The first-order table of the misalignments, row by row."""
    for face, f in ((1, 1.0), (2, -1.0)):
        s = on_face(SCENE, face)
        d, az, el = s.range_, s.azimuth, s.elevation
        no = np.zeros(len(s))
        table: dict[str, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {
            "range-offset": [(no + 1, no, no)],
            "range-scale": [(d, no, no)],
            "transit-offset": [(f * np.cos(el), no, -f * np.sin(el) / d)],
            "beam-offset": [(no, f / (d * np.cos(el)), no), (no, no, f / d)],
            "beam-tilt": [(no, f / np.cos(el), no)],
            "transit-tilt": [(no, -f * np.tan(el), no)],
            "vertical-index": [(no, no, no + f)],
            "azimuth-eccentricity": [(no, f * np.cos(az), no), (no, f * np.sin(az), no)],
            "azimuth-second-order": [(no, np.cos(2 * az), no), (no, np.sin(2 * az), no)],
            "elevation-eccentricity": [(no, no, np.cos(el)), (no, no, f * np.sin(el))],
            "elevation-second-order": [(no, no, f * np.cos(2 * el)), (no, no, np.sin(2 * el))],
        }
        assert set(table) == {effect.name for effect in ORDINARY_CALIBRATION_EFFECTS}
        for effect in ORDINARY_CALIBRATION_EFFECTS:
            expected = np.stack([np.stack(column, axis=1) for column in table[effect.name]], axis=2)
            np.testing.assert_allclose(corrections(effect, s), expected, atol=1e-12, err_msg=effect.name)


@pytest.mark.parametrize("order", [-1, 0, 1, 2, 3])
def test_tilt_wobble_has_the_coupling_of_both_angles(order: int) -> None:
    """Delta_el = w_x sin az - w_y cos az, Delta_az = -tan el (w_x cos az + w_y sin az)."""
    for face in (1, 2):
        s = on_face(SCENE, face)
        changes = corrections(BearingWobble(kind="tilt", order=order), s)
        for k, amplitude in enumerate((1.0, 1.0j)):
            w = amplitude * np.exp(1j * order * s.ideal_raw_readings[:, 1])
            rise = w.real * np.sin(s.azimuth) - w.imag * np.cos(s.azimuth)
            turn = -np.tan(s.elevation) * (w.real * np.cos(s.azimuth) + w.imag * np.sin(s.azimuth))
            np.testing.assert_allclose(changes[:, :, k], np.stack([0 * rise, turn, rise], axis=1), atol=1e-12)


def test_transit_wobble_is_a_lateral_shift_in_proportion_to_the_range() -> None:
    """D_t = f d eX(raw elevation)."""
    for face, f in ((1, 1.0), (2, -1.0)):
        s = on_face(SCENE, face)
        change = corrections(BearingWobble(kind="transit", order=2), s)[:, 1]
        expected = f * np.stack(
            [np.cos(2 * s.ideal_raw_readings[:, 2]), np.sin(2 * s.ideal_raw_readings[:, 2])], axis=1
        )
        np.testing.assert_allclose(change * np.cos(s.elevation)[:, None], expected, atol=1e-12)


def test_detector_offset_is_a_beam_offset_of_half_its_size() -> None:
    beam = next(effect for effect in ORDINARY_CALIBRATION_EFFECTS if effect.name == "beam-offset")
    np.testing.assert_allclose(DetectorOffset().design(SCENE), 0.5 * beam.design(SCENE))


def test_sag_of_an_upright_tracker_is_the_cosine_of_the_elevation_circle() -> None:
    """Exact for upright stations, and not for leaning ones."""
    circle = next(effect for effect in ORDINARY_CALIBRATION_EFFECTS if effect.name == "elevation-eccentricity")
    upright = scene(lean=0.0)
    np.testing.assert_allclose(HeadSag().design(upright)[:, :, 0], -circle.design(upright)[:, :, 0], atol=1e-12)
    leaning = scene(lean=0.3)
    assert np.abs(HeadSag().design(leaning)[:, :, 0] + circle.design(leaning)[:, :, 0]).max() > 0.05
