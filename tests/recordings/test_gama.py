"""gama-local: what its observations become, hostile XML, and that an export reads back as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from ltsim.adjustment.estimate import adjust
from ltsim.core.errors import RecordError
from ltsim.core.units import ARCSECOND, GON
from ltsim.physics.model.nuisances import shared_errors
from ltsim.recordings import Recording, read, write
from ltsim.recordings.setup import LengthGauge, Setup, Station, Target
from tests.recordings.samples import outcome, shared, workshop

HEAD = '<?xml version="1.0" ?>\n<gama-local xmlns="http://www.gnu.org/software/gama/gama-local">\n'
SAMPLE = (
    HEAD
    + """<network axes-xy="ne" angles="left-handed">
<description>A yard, two
pillars</description>
<parameters sigma-apr="2" />
<points-observations distance-stdev="1.5" direction-stdev="3.0" zenith-angle-stdev="4.0">
<point id="A" x="100" y="200" z="10" fix="xyz" />
<point id="B" x="110" y="200" z="11" fix="xy" adj="z" />
<point id="C" x="105" y="195" z="12" adj="XYZ" />
<point id=" D " adj="xyz" />
<obs from="A">
 <direction to="B" val="10" />
 <direction to="C" val="60.5" stdev="9" />
 <z-angle to="B" val="101" to_dh="0.1" from_dh="1.5" />
 <z-angle to="C" val="95-30-30.0" to_dh="0.2" from_dh="1.5" />
 <s-distance to="B" val="10.05" to_dh="0.1" from_dh="1.5" />
 <distance to="C" val="7.07" to_dh="0.2" from_dh="1.5" />
</obs>
<obs from="A">
 <direction to="B" val="0" /> <direction to="D" val="50" /> <direction to="C" val="55" />
</obs>
<obs from="D"><angle bs="A" fs="B" val="90" stdev="14.142135623730951" /></obs>
<obs from="B"><s-distance to="C" val="7.0" /></obs>
<height-differences><dh from="A" to="B" val="1.0" stdev="1" /></height-differences>
</points-observations>
</network>
</gama-local>
"""
)


def sample(path: Path, old: str = "", new: str = "") -> Path:
    assert old in SAMPLE
    path.write_text(SAMPLE.replace(old, new, 1) if old else SAMPLE)
    return path


def test_a_network_is_understood(tmp_path: Path) -> None:
    recording = read(sample(tmp_path / "n.gkf"))
    assert recording.stations == ("A", "A#2", "D")
    over = [recording.station_setup(s).over for s in recording.stations]
    assert over == ["A", "A", "D"]
    assert all(recording.station_setup(s).levelled for s in recording.stations)
    assert len(recording) == 7
    readings = recording.readings
    np.testing.assert_allclose(readings[0], [10.05, -10 * GON, np.pi / 2 - 101 * GON])
    np.testing.assert_allclose(readings[1], [7.07, -60.5 * GON, np.pi / 2 - np.radians(95 + 30 / 60 + 30 / 3600)])
    assert list(recording.is_horizontal_distance) == [False, True, *[False] * 5]
    sigma = recording.reading_sigmas()
    np.testing.assert_allclose(sigma[0], [0.0015, 3e-4 * GON, 4e-4 * GON])
    np.testing.assert_allclose(sigma[1, 1:], [9e-4 * GON, 4.0 * ARCSECOND])
    np.testing.assert_allclose(sigma[5:, 1], [10e-4 * GON, 10e-4 * GON])
    np.testing.assert_allclose(recording.readings[6, 1] - recording.readings[5, 1], -90 * GON)


def test_a_whole_description_is_no_title(tmp_path: Path) -> None:
    recording = read(sample(tmp_path / "n.gkf", "A yard, two", "A yard, two " + 40 * "of many words "))
    assert len(recording.setup.title) <= 120
    assert recording.setup.title.startswith("A yard, two of many words")
    assert recording.setup.title.endswith(" ...")


def test_names_with_a_slash_stay_separate(tmp_path: Path) -> None:
    """The offset marks of a point, 12/1 and 12/2, beside a point whose name one of them would take."""
    (tmp_path / "n.gkf").write_text(SAMPLE.replace('"A"', '"12/1"').replace('"B"', '"12_1"'))
    recording = read(tmp_path / "n.gkf")
    assert recording.stations == ("12_1_", "12_1_#2", "D")
    assert {"12_1_", "12_1"} < set(recording.targets)
    np.testing.assert_array_equal(recording.readings, read(sample(tmp_path / "m.gkf")).readings)
    assert "'/' in names of points is written '_': 12_1_" in recording.notes


def test_points_heights_and_lengths(tmp_path: Path) -> None:
    recording = read(sample(tmp_path / "n.gkf"))
    targets = recording.setup.targets
    assert targets["A"].known_mm == (100_000, -200_000, 10_000)
    assert targets["A"].known_axes == "xyz"
    assert targets["B"].known_axes == "xy"
    assert targets["C"].datum
    assert targets["C"].approximate_mm == (105_000, -195_000, 12_000)
    assert targets["D"].approximate_mm is None
    assert targets["B"].height_mm == 100
    assert recording.station_setup("A").instrument_height_mm == 1500
    (length,) = recording.gauge.distance
    assert (length.from_, length.to, length.length_mm, length.sigma_mm) == ("B", "C", 7000, 1.5)
    notes = " ".join(recording.notes)
    (difference,) = recording.setup.differences
    assert (difference.label, difference.known_mm, difference.known_sigma_mm, difference.known_axes) == (
        "A-B",
        (0, 0, 1000),
        1,
        "z",
    )
    for note in ("left-handed system", "sigma-apr is 2"):
        assert note in notes


def test_observed_coordinates_and_covariances(tmp_path: Path) -> None:
    coordinates = (
        '<coordinates><point id="D" x="1" y="2" z="3" /><cov-mat dim="3" band="0">4 4 4</cov-mat></coordinates>'
    )
    recording = read(sample(tmp_path / "n.gkf", "<height-differences>", coordinates + "<height-differences>"))
    assert recording.setup.targets["D"].known_mm == (1000, -2000, 3000)
    assert recording.setup.targets["D"].known_sigma_mm == 2
    matrix = '<cov-mat dim="3" band="1">25 1 36 0 49</cov-mat>'
    correlated = read(
        sample(tmp_path / "m.gkf", '<direction to="C" val="55" />', f'<direction to="C" val="55" />{matrix}')
    )
    (shared,) = shared_errors(correlated)
    reach = shared.reading_changes_per_sigma[2:5, 1]
    spread = np.diag(correlated.reading_sigmas()[2:5, 1] ** 2) + reach @ reach.T
    np.testing.assert_allclose(spread, np.array([[25, 1, 0], [1, 36, 0], [0, 0, 49]]) * (1e-4 * GON) ** 2, atol=1e-20)
    assert np.count_nonzero(shared.reading_changes_per_sigma) == np.count_nonzero(reach) == 2
    assert not {*correlated.regressor_covariates}


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('val="10.05"', 'val="-10.05"', "expected a distance above 0"),
        ('val="10.05"', 'val="ten"', "expected a number"),
        ('val="10.05"', "", "lacks the attribute val"),
        ('val="10.05"', 'val="1e99"', "at most"),
        ('val="101"', 'val="301"', "beyond half a circle"),
        ('to="B" val="101"', 'to="../B" val="101"', "holds '/'"),
        ('id="A"', 'id="&lt;b&gt;"', "holds '<'"),
        ('fix="xyz"', 'fix="abc"', "is not one of xyz, xy, z"),
        ('y="200" z="10"', 'y="200"', "fixed, but lacks coordinates"),
        ('x="100" y="200"', 'x="1e9" y="200"', "position_mm.1 is 1000000000000.0, but it should be less"),
        ('axes-xy="ne"', 'axes-xy="up"', "not a coordinate system of gama-local"),
        ('direction-stdev="3.0"', "", "no standard deviation is given"),
        ('distance-stdev="1.5"', 'distance-stdev="0"', "a standard deviation of 0"),
        ("</network>", "", "not well-formed"),
        ('<obs from="D">', '<obs from="D"><cov-mat dim="9" band="0">1</cov-mat>', "do not match"),
    ],
)
def test_wrong_networks(tmp_path: Path, old: str, new: str, says: str) -> None:
    result = outcome(lambda: read(sample(tmp_path / "n.gkf", old, new)))
    assert isinstance(result, str)
    assert says in result


@pytest.mark.parametrize(
    "attack",
    [
        '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
        + "".join(f'<!ENTITY {c} "{f"&{b};" * 10}">' for b, c in zip("abcdefghi", "bcdefghij", strict=True))
        + "]>",
        '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE x SYSTEM "http://localhost/x.dtd" [<!ENTITY % p SYSTEM "http://localhost/y"> %p;]>',
    ],
)
def test_entities_are_refused_at_once(tmp_path: Path, attack: str) -> None:
    file = tmp_path / "n.gkf"
    body = SAMPLE.replace("A yard", "&j;").partition("?>")[2]
    file.write_text(f'<?xml version="1.0"?>{attack}{body}')
    result = outcome(lambda: read(file, format="gama-local"))
    assert isinstance(result, str)
    assert "entit" in result or "not well-formed" in result


def test_deep_nesting(tmp_path: Path) -> None:
    file = tmp_path / "n.gkf"
    file.write_text(HEAD + "<a>" * 100_000)
    assert isinstance(outcome(lambda: read(file)), str)


def test_other_xml(tmp_path: Path) -> None:
    file = tmp_path / "n.xml"
    file.write_text('<?xml version="1.0"?><html/>')
    with pytest.raises(RecordError, match="is in none of the formats"):
        read(file)
    with pytest.raises(RecordError, match="expected <gama-local>"):
        read(file, format="gama-local")


def test_a_cut_network(tmp_path: Path) -> None:
    file = sample(tmp_path / "n.gkf")
    content = file.read_bytes()
    for cut in range(0, len(content) - 1, 5):
        file.write_bytes(content[:cut])
        assert isinstance(outcome(lambda: read(file, format="gama-local")), str)


def levelled(recording: Recording, **changes: object) -> Recording:
    stations = {s: Station(levelled=True, over=f"{s}.mark") for s in recording.stations}
    return recording.replace(setup=Setup(title="yard & <hall>", stations=stations, **changes))


def agree(first: Recording, other: Recording) -> None:
    """The same pointings in the same order within each station, to rounding."""

    def rows(r: Recording) -> list[tuple]:
        over = [r.station_setup(s).over for s in r.stations]
        return [(over[r.station[i]], r.targets[r.target[i]]) for i in range(len(r))]

    assert rows(first) == rows(other)
    np.testing.assert_allclose(first.readings[:, [0, 2]], other.readings[:, [0, 2]], atol=1e-12, rtol=1e-12)
    turn = np.mod(first.readings[:, 1] - other.readings[:, 1] + 1, 2 * np.pi) - 1
    np.testing.assert_allclose(turn[np.isfinite(turn)], 0, atol=1e-12)
    assert np.array_equal(first.is_measured, other.is_measured)
    ratio = first.reading_sigmas() / other.reading_sigmas()
    np.testing.assert_allclose(ratio[first.is_measured], 1, rtol=1e-12)
    for mine, theirs in zip(first.heights_above_marks(), other.heights_above_marks(), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-12)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_an_export_reads_back(tmp_path: Path, data: st.DataObject) -> None:
    recording = workshop(faces=1)
    readings = recording.readings.copy()
    for i in range(len(recording)):
        for k in data.draw(st.sets(st.integers(0, 2), max_size=2)):
            readings[i, k] = np.nan
    place = st.tuples(*[st.floats(-1e6, 1e6)] * 3).map(lambda p: tuple(round(v, 6) for v in p))
    kinds = [
        lambda p: Target(known_mm=p, known_sigma_mm=1e-4),
        lambda p: Target(known_mm=p, known_sigma_mm=0.5),
        lambda p: Target(known_mm=p, known_covariance_mm2=(4.0, 0.5, -1.0, 2.0, 0.25, 3.0)),
        lambda p: Target(known_mm=p, known_sigma_mm=1e-4, known_axes="xy", approximate_mm=p),
        lambda p: Target(approximate_mm=p, datum=True),
        lambda p: Target(approximate_mm=p, height_mm=250.0),
    ]
    names = data.draw(st.sets(st.sampled_from(recording.targets), min_size=1))
    targets = {n: data.draw(st.sampled_from(kinds))(data.draw(place)) for n in sorted(names)}
    truth = levelled(recording.with_readings(readings), targets=targets)
    write(truth, tmp_path / "out.gkf", "gama-local")
    back = read(tmp_path / "out.gkf")
    agree(truth, back)
    assert back.setup.title == "yard & (hall)"
    # Without any anchor the export lets the first set-up's targets define the datum, which has a test of its own.
    anchored = any(t.known_mm is not None or t.datum for t in targets.values())
    for name, target in targets.items():
        got = back.setup.targets[name]
        assert got.known_axes == target.known_axes
        assert got.datum == target.datum or not anchored
        if target.known_covariance_mm2 is not None:
            np.testing.assert_allclose(got.known_covariance_mm2, target.known_covariance_mm2)
        for field in ("known_mm", "approximate_mm"):
            want = getattr(target, field)
            if want is None:
                continue
            np.testing.assert_allclose(getattr(got, field), want, atol=1e-5)
    write(back, tmp_path / "again.gkf", "gama-local")
    agree(back, read(tmp_path / "again.gkf"))


def test_faces_are_reduced_and_gauges_become_distances(tmp_path: Path) -> None:
    recording = workshop(faces=2)
    gauge = LengthGauge(distance=recording.gauge.distance, calibrated_at_c=20, measured_at_c=30, expansion_per_k=1e-5)
    write(levelled(recording, gauge=gauge), tmp_path / "out.gkf", "gama-local")
    back = read(tmp_path / "out.gkf")
    front = workshop(faces=1)
    np.testing.assert_allclose(
        np.mod(back.readings[::2] + 9, 2 * np.pi), np.mod(front.readings + 9, 2 * np.pi), atol=1e-9
    )
    np.testing.assert_allclose(
        np.mod(back.readings[1::2] + 9, 2 * np.pi), np.mod(front.readings + 9, 2 * np.pi), atol=1e-9
    )
    (line,) = back.gauge.distance
    assert line.length_mm == pytest.approx(gauge.distance[0].length_mm * 1.0001)
    assert sum(t.datum for t in back.setup.targets.values()) == 6


def test_a_station_that_is_not_levelled(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="station S1 is not levelled"):
        write(workshop(), tmp_path / "out.gkf", "gama-local")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "counts"), [("2019-prager", 79), ("2020-barta-phase_0-1TK", 35)])
def test_real_networks(tmp_path: Path, name: str, counts: int) -> None:
    file = shared("recordings", "gama-3d-networks", f"{name}.gkf")
    if not file.exists():
        pytest.skip("Gama's networks are not beside this checkout")
    recording = read(file)
    assert list(recording.is_measured.sum(axis=0)) == [counts] * 3
    write(recording, tmp_path / "out.gkf", "gama-local")
    agree(recording, read(tmp_path / "out.gkf"))


def test_a_network_in_plan_keeps_to_its_plan(tmp_path: Path) -> None:
    """Points with adj="xy" were adjusted in three dimensions, or refused, without a word."""
    body = (
        '<point id="A" x="0" y="0" fix="xy" /><point id="B" x="0" y="50" adj="XY" />'
        '<point id="C" adj="xy" /><point id="D" adj="xy" />'
        '<obs from="A"><direction to="C" val="29.517" /><direction to="D" val="370.483" />'
        '<z-angle to="C" from_dh="1.6" to_dh="1.2" val="101" />'
        '<distance to="C" from_dh="1.6" to_dh="1.2" val="67.082" /><distance to="D" val="44.7214" /></obs>'
        '<obs from="B"><direction to="C" val="379.517" /><direction to="D" val="333.050" />'
        '<distance to="C" val="63.2456" /><distance to="D" val="80.6226" /></obs>'
    )
    attributes = 'direction-stdev="6" distance-stdev="1" zenith-angle-stdev="50"'
    text = f"{HEAD}<network><points-observations {attributes}>{body}</points-observations></network></gama-local>\n"
    (tmp_path / "a.gkf").write_text(text)
    recording = read(tmp_path / "a.gkf")
    assert len(recording) == 4 and not recording.is_measured[:, 2].any() and recording.is_horizontal_distance[1]
    targets = recording.setup.targets
    assert [targets[name].known_axes for name in "ABC"] == ["xyz", "z", "z"]
    assert (targets["B"].datum, targets["B"].datum_axes, targets["B"].height_mm) == (True, "xy", 0.0)
    assert any("4 points are adjusted in plan only" in note for note in recording.notes)
    assert any("1 observations that need heights are left out, as Gama does" in note for note in recording.notes)
    solved = adjust(recording)
    place = dict(zip(recording.targets, solved.state.target_points, strict=True))
    assert np.linalg.norm(place["D"] - place["C"]) == pytest.approx(np.hypot(20.0, 50.0), abs=2e-3)
    assert [place[name][2] for name in "CD"] == pytest.approx([0.0, 0.0], abs=1e-6)
