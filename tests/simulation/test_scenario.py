from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.core.errors import InputError
from ltsim.simulation.builtin import builtin_names, builtin_text
from ltsim.simulation.measurement_geometry import make_measurement_geometry
from ltsim.simulation.scenario import load_scenario, scenario_to_toml
from ltsim.simulation.sections import PAPER_PRIOR, TRACKER_PRESETS

MINIMAL = """\
format = "ltsim-scenario/1"

[stations.S1]
position_mm = [3000, 3000, 1700]
yaw_deg = 10

[targets.A]
position_mm = [100, 100, 2000]

[targets.B]
position_mm = [100, 3000, 2000]

[targets.C]
position_mm = [3000, 100, 2500]
"""

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write(text: str) -> Path:
        path = tmp_path / "mine.toml"
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize("name", builtin_names())
def test_built_ins_load_and_survive_being_printed(name: str, write: Write) -> None:
    scenario = load_scenario(name)
    assert load_scenario(write(builtin_text(name))) == scenario
    assert load_scenario(write(scenario_to_toml(scenario))) == scenario


def test_the_named_ones_are_there() -> None:
    assert {"paper-workshop", "paper-workshop-two-face", "paper-laboratory"} <= set(builtin_names())


def test_a_file_may_contain_only_differences_from_a_built_in_scenario(write: Write) -> None:
    text = 'format = "ltsim-scenario/1"\nbase = "paper-workshop"\ngauge = "none"\n'
    changed = load_scenario(write(text + "[work]\nrepeats = 3\n[targets]\nT03 = { position_mm = [50, 3901, 5900] }\n"))
    base = load_scenario("paper-workshop")
    assert changed.gauge is None and changed.work == base.work.model_copy(update={"repeats": 3})
    assert [*changed.targets] == [*base.targets] and changed.targets["T03"].position_mm == (50, 3901, 5900)
    with pytest.raises(InputError, match="did you mean paper-workshop"):
        load_scenario(write(text.replace("workshop", "workshp")))


def test_a_short_file_has_defaults(write: Write) -> None:
    scenario = load_scenario(write(MINIMAL))
    assert scenario.instrument.prior == PAPER_PRIOR
    assert scenario.smr.nest_orientation == "re-aimed"
    assert scenario.gauge is None


def test_a_preset_stands_below_what_the_file_says(write: Write) -> None:
    text = MINIMAL + '[instrument]\npreset = "modern"\n[instrument.noise]\ndistance_mm = 0.007\n'
    instrument = load_scenario(write(text)).instrument
    assert instrument.noise.distance_mm == 0.007
    assert instrument.noise.azimuth_arcsec == TRACKER_PRESETS["modern"]["noise"]["azimuth_arcsec"]
    assert instrument.prior.angle_arcsec == TRACKER_PRESETS["modern"]["prior"]["angle_arcsec"]


WRONG = [
    ("yaw_deg = 10", 'yaw_deg = "north"', r'stations\.S1\.yaw_deg is "north", but it should be a valid number'),
    ("yaw_deg = 10", "yaw_degrees = 10", r"unknown key stations\.S1\.yaw_degrees; did you mean yaw_deg"),
    ("yaw_deg = 10", "", r"the key stations\.S1\.yaw_deg is missing"),
    ("yaw_deg = 10", "yaw_deg = nan", "yaw_deg"),
    ('format = "ltsim-scenario/1"', "", "the key format is missing"),
    ('format = "ltsim-scenario/1"', 'format = "ltsim-recording/1"', "format"),
    ("position_mm = [100, 100, 2000]", "position_mm = [100, 2000]", r"targets\.A\.position_mm"),
    ("position_mm = [100, 100, 2000]", "position_mm = [100, 100, 20000]", "outside the hall of 6000 x 6000 x 6000"),
    ("[targets.C]\nposition_mm = [3000, 100, 2500]", "", "has 2 reflectors"),
    ("[targets.C]", '[targets."C/D"]', "may not contain"),
    ("[targets.C]", "[targets.C", "is not TOML"),
    ("[targets.C]", "[instrument.errors]\nbeam-tilt = true\n[targets.C]", "instrument"),
    (
        "[targets.C]",
        '[[effects]]\nname = "beam-tilt"\nstations = ["S9"]\n[targets.C]',
        r"effects\.1\.stations names 'S9', which is not one of S1",
    ),
    ("[targets.C]", '[instrument]\npreset = "best"\n[targets.C]', r"instrument\.preset"),
    ("[targets.C]", "[[workshop.obstacles]]\nname = 'x'\n[targets.C]", "one of file, box_mm and cylinder_mm"),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG)
def test_wrong_files_are_refused_in_a_sentence_with_file_and_key(
    old: str, new: str, message: str, write: Write
) -> None:
    assert old in MINIMAL
    with pytest.raises(InputError, match=message) as caught:
        load_scenario(write(MINIMAL.replace(old, new)))
    assert "mine.toml" in str(caught.value) and "\n" not in str(caught.value)


PHYSICS = [
    ('[[effects]]\nname = "beam-tilt"\n[effects.values]\nbeam-tild = 3.0\n', "effects.1.values: beam-tilt has no"),
    ('[[effects]]\nname = "beamtilt"\n', "effects.1: there is no effect called 'beamtilt'; did you mean beam-tilt"),
    ('[[effects]]\nname = "range-cyclic"\n[effects.shape]\nlength = 1\n', "has no shape parameter called 'length'"),
    ('[[effects]]\nname = "range-cyclic"\n[effects.shape]\nwavelength = "long"\n', "expected a value such as"),
    ('[[effects]]\nname = "azimuth-harmonic"\n[effects.shape]\norder = 3.5\n', "expected a whole number"),
    (
        '[[effects]]\nname = "encoder-interpolation"\n[effects.shape]\ncircle = "x"\n',
        "encoder-interpolation.circle is 'x', expected one of azimuth, elevation",
    ),
    ("[instrument.errors]\nbeam-lift = 3\n", "instrument.errors.beam-lift: there is no instrument parameter"),
]


@pytest.mark.parametrize(("text", "message"), PHYSICS)
def test_physics_that_does_not_exist_is_refused(text: str, message: str, write: Write) -> None:
    from ltsim.simulation.simulator import simulate

    with pytest.raises(InputError, match=message):
        simulate(load_scenario(write(MINIMAL + text)), 1)


def test_unknown_names_are_refused_with_the_closest() -> None:
    with pytest.raises(InputError, match="did you mean paper-workshop"):
        load_scenario("paper-workshp")
    with pytest.raises(InputError, match="no built-in scenario"):
        builtin_text("nothing-like-it")


def test_a_station_that_sees_nothing_is_refused(write: Write) -> None:
    text = MINIMAL + "[[workshop.obstacles]]\nbox_mm = [1000, 1000, 3000]\nposition_mm = [3000, 3000, 0]\n"
    with pytest.raises(InputError, match=r"station S1 sees no reflector \(A is station inside an obstacle\)"):
        make_measurement_geometry(load_scenario(write(text)), 1)


def test_cad_files_are_read_from_the_folder_of_the_scenario(write: Write, tmp_path: Path) -> None:
    text = MINIMAL + '[[workshop.obstacles]]\nfile = "press.stl"\n'
    path = write(text)
    scenario = load_scenario(path)
    assert scenario.workshop.obstacles[0].file == str(tmp_path / "press.stl")
    with pytest.raises(InputError, match=r"press\.stl: the file cannot be read"):
        make_measurement_geometry(scenario, 1)


@pytest.mark.parametrize(
    ("tables", "says"),
    [
        (
            '[[effects]]\nname = "range-cyclic"\nshape = { wavelength = 0.0 }',
            "wavelength is 0, expected 0.2 to 2e+05 mm",
        ),
        (
            '[[effects]]\nname = "encoder-interpolation"\nshape = { circle = "x" }',
            "circle is 'x', expected one of azimuth",
        ),
        ('[[effects]]\nname = "mesh-expansion"\nshape = { mode = "x" }', "mode is 'x', expected one of uniform"),
        ('[[effects]]\nname = "smr-incidence"\nshape = { table = [1.0] }', "table has 1 values, expected 9"),
        ('[[effects]]\nname = "wrong-unit"\nshape = { mistake = "metres" }', "did you mean metre"),
        ("[instrument.limits]\nrange_min_mm = 9000\nrange_max_mm = 500", "range_min_mm should be below range_max_mm"),
    ],
)
def test_constants_that_mean_nothing_are_refused(write: Write, tables: str, says: str) -> None:
    with pytest.raises(InputError, match=re.escape(says)):
        make_measurement_geometry(load_scenario(write(f"{MINIMAL}\n{tables}\n")), 1)


def test_effects_as_objects_are_those_of_a_file() -> None:
    drift = lt.Effect("index-drift", stations="S3", law="visit")
    entry = {"name": "index-drift", "stations": ["S3"], "shape": {"law": "visit"}, "draw": True}
    by_table = lt.simulate("paper-workshop", seed=7, changes={"effects": [entry]})
    for given in ([drift], drift):
        recording, truth = lt.simulate("paper-workshop", seed=7, changes={"effects": given})
        assert np.array_equal(recording.readings, by_table.recording.readings)
        assert truth.applied_effects[0].effect == drift
    by_name, by_list = (
        lt.simulate("paper-workshop", seed=7, changes={"effects": e}) for e in ("heat-plume", ["heat-plume"])
    )
    assert np.array_equal(by_name.recording.readings, by_list.recording.readings)
    assert by_name.truth.applied_effects[0].effect.name == "heat-plume"

    sized = lt.Effect("index-drift", stations="S3", index_drift=60.0)
    entry = {"name": "index-drift", "stations": ["S3"], "values": {"index-drift": 60.0}}
    by_table, given = (lt.simulate("paper-workshop", seed=7, changes={"effects": [e]}) for e in (entry, sized))
    assert np.array_equal(given.recording.readings, by_table.recording.readings)


def test_a_printed_scenario_is_a_single_line() -> None:
    assert str(lt.scenario("paper-workshop")).count("\n") == 0
    assert str(lt.scenario("paper-workshop")) == repr(lt.scenario("paper-workshop"))
