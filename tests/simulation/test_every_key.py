"""Every key of a scenario and of a set-up that is accepted changes something, is refused, or is said to change nothing.

Keys are found in the models: one that is added later is tested too, or asks for another value here.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, get_args, get_origin

import pytest
from pydantic import BaseModel

from ltsim.core.errors import LtsimError
from ltsim.recordings.native import write_recording
from ltsim.simulation.scenario import change_scenario, load_scenario
from ltsim.simulation.simulator import simulate

HERE = Path("scenario.toml")
RICH: dict[str, Any] = {
    "work.faces": 2,
    "instrument.errors": {"draw": True},
    "smr.nest_orientation": "fixed",
    "smr.incidence_error": True,
    "smr.acceptance_deg": 70.0,
    "stations.S2.levelled": True,
    "workshop.temperature_rise_c_per_h": 0.3,
    "effects": [{"name": "bearing-wobble", "draw": True, "stations": ["S2"]}],
}
"""A scenario in which each key has something to act on."""
OTHER: dict[str, Any] = {
    "air": {"temperature_k": 1.0},
    "reference_radius_mm": 19.05,
    "workshop.pressure_hpa": 900.0,
    "instrument.preset": "modern",
    "instrument.limits.elevation_min_deg": -20.0,
    "instrument.limits.elevation_max_deg": 20.0,
    "instrument.limits.range_min_mm": 3000.0,
    "instrument.limits.range_max_mm": 6000.0,
    "smr.reflector": "ball",
    "smr.acceptance_deg": 15.0,
    "stations.S2.reflector": "ball",
    "gauge.nest_normal": [1, 1, 1],
    "gauge.sigma_um": 3.0,
    "gauge.measured_at_c": 22.0,
    "gauge.sigma_expansion_per_k": 1e-6,
    "gauge.sigma_temperature_k": 0.5,
    "stations.S2.yaw_deg": 80.0,
    "work.stations": 4,
    "work.targets": 12,
    "targets.T05.position_mm": [150.0, 2000.0, 5000.0],
    "targets.T05.nest_normal": [1, 0.2, 0.1],
    "targets.T05.reaimed": True,
    "targets.T05.reflector": "ball",
}
"""Values for keys whose own value does not suggest another."""
ELSEWHERE = {
    "format": "says what the file is",
    "base": "tables of another scenario stand in its place when the file is read",
    "workshop.size_mm": "bounds places, and is drawn",
    "workshop.shadow_cone_deg": "for plans and pictures",
    "cmm.measures_targets": "asks for another file",
    "instrument.harmonics": "of the construction dh alone",
    "instrument.degree": "of the construction dh alone",
    "stations.S2.instrument": "needs a tracker of that name",
}
"""What a recording does not show, and why."""
SCENARIO = change_scenario(load_scenario("paper-workshop"), RICH, HERE)


def leaves(model: BaseModel, before: str) -> Iterator[tuple[str, Any, Any]]:
    """Keys of a model and of those within, with value and type; tables of names and lists of tables are left out."""
    for name, field in type(model).model_fields.items():
        value, key = getattr(model, name), f"{before}{field.alias or name}"
        if isinstance(value, BaseModel):
            yield from leaves(value, f"{key}.")
        elif not isinstance(value, dict) and not (isinstance(value, tuple) and not any(_number(x) for x in value)):
            yield key, value, field.annotation


def _number(value: object) -> bool:
    return isinstance(value, int | float)


def other(value: Any, kind: Any) -> Any:
    """Another value of the same type."""
    while get_origin(kind) in (Annotated, UnionType):
        kind = get_args(kind)[0]
    if isinstance(value, bool):
        return not value
    if get_origin(kind) is Literal:
        return next(choice for choice in get_args(kind) if choice != value)
    if isinstance(value, str):
        return f"{value}x"
    if _number(value):
        return value + 1 if isinstance(value, int) else round(1.3 * value + 0.3, 4)
    assert isinstance(value, tuple), f"say another value than {value}"
    return [round(1.1 * x + 1.0, 3) for x in value]


KEYS = [
    *leaves(SCENARIO, ""),
    *leaves(SCENARIO.stations["S2"], "stations.S2."),
    *leaves(SCENARIO.targets["T05"], "targets.T05."),
]


def shown(folder: Path, **changes: Any) -> str:
    """All that a recording of the changed scenario says, and the truth behind it."""
    recording, truth = simulate(change_scenario(SCENARIO, changes, HERE), 5)
    write_recording(recording, folder)
    files = "".join(file.read_text() for file in sorted(folder.iterdir()) if file.is_file())
    return files + repr(truth) + "".join(recording.notes)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> str:
    return shown(tmp_path_factory.mktemp("plain"))


@pytest.mark.parametrize(
    ("key", "value", "kind"), [k for k in KEYS if k[0] not in ELSEWHERE], ids=lambda x: str(x)[:40]
)
def test_a_key_of_a_scenario_changes_something(key: str, value: Any, kind: Any, plain: str, tmp_path: Path) -> None:
    assert shown(tmp_path, **{key: OTHER.get(key, other(value, kind) if key not in OTHER else None)}) != plain


@pytest.mark.parametrize("key", ELSEWHERE)
def test_what_a_recording_does_not_show_is_a_key(key: str) -> None:
    assert key in {entry for entry, _, _ in KEYS}


def test_a_setting_without_effect_is_reported() -> None:
    aimed = change_scenario(SCENARIO, {"smr.nest_orientation": "re-aimed", "smr.incidence_error": True}, HERE)
    assert any("smr-incidence" in note for note in simulate(aimed, 5)[0].notes)
    with pytest.raises(LtsimError, match="is used at no station"):
        change_scenario(SCENARIO, {"instruments.B": {}}, HERE)
