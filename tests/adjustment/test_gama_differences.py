"""Height differences, vectors and covariances in gama-local's format, against what gama-local 2.24 prints."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from ltsim import calibrate, diagnose
from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.coordinate_uncertainty import displacement_per_observation
from ltsim.adjustment.verdict import verdict_on
from ltsim.core.errors import NetworkError, RecordError
from ltsim.diagnosis import instruments
from ltsim.measurands.inputs import observation_uncertainty_sources
from ltsim.physics.laws.regressor_library import candidate_regressors
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings import read, write

ANOTHER = '<direction to="B" val="153.5020"/>'
PRINTED = 5.2e-6
"""[m] Half of the last digit that gama-local prints, and what its linearisation leaves of it."""


@dataclass(frozen=True)
class Printed:
    """A network, and what gama-local prints: coordinates [m] with standard deviations [mm], pvv, degrees of freedom."""

    axes: str
    inside: str
    adjusted: str
    pvv: float
    dof: int

    def write(self, path: Path, old: str = "", new: str = "") -> Path:
        """The file, with `new` in place of `old`."""
        assert old in self.inside
        inside = self.inside.replace(old, new, 1) if old else self.inside
        head = f'<network axes-xy="{self.axes}" angles="left-handed"><parameters sigma-apr="1"/><points-observations>'
        path.write_text(f"<gama-local>{head}{inside}</points-observations></network></gama-local>")
        return path

    def compared(self, adjustment: Adjustment) -> tuple[np.ndarray, np.ndarray]:
        """Rows of our and their coordinate [m] and standard deviation by sigma0 [mm], as (k, 2) each."""
        places, sigma = (
            adjustment.state.target_points,
            adjustment.sigma0 * np.sqrt(adjustment.target_covariances[:, range(3), range(3)]),
        )
        ours, theirs = [], []
        for point in self.adjusted.split("; "):
            name, *words = point.split()
            t = adjustment.recording.targets.index(name)
            for axis, value, deviation in zip(words[::3], words[1::3], words[2::3], strict=True):
                k, sign = "xyz".index(axis), -1 if axis == "y" and self.axes == "ne" else 1
                ours.append((sign * places[t, k], 1e3 * sigma[t, k]))
                theirs.append((float(value), float(deviation)))
        return np.array(ours), np.array(theirs)


NETWORKS = {
    "levelled lines": Printed(
        "en",
        """
<point id="A" x="100" y="200" z="10" fix="xy" adj="z"/>
<point id="B" x="221.3" y="214.8" z="14.2" fix="xy" adj="z"/> <point id="BM" z="8.5" fix="z"/>
<point id="C" adj="xyz"/> <point id="E" adj="xyz"/>
<obs from="A"> <direction to="B" val="153.5020" stdev="5"/> <distance to="B" val="122.1990" stdev="2"/>
<direction to="C" val="104.6984" stdev="5"/> <distance to="C" val="143.5899" stdev="2"/>
<direction to="E" val="101.6577" stdev="5"/> <distance to="E" val="77.8829" stdev="2"/> </obs>
<obs from="B"> <direction to="A" val="278.5843" stdev="5"/> <distance to="A" val="122.1983" stdev="2"/>
<direction to="C" val="366.7246" stdev="5"/> <distance to="C" val="101.3617" stdev="2"/>
<direction to="E" val="322.4588" stdev="5"/> <distance to="E" val="89.0735" stdev="2"/> </obs>
<obs from="E"> <direction to="A" val="347.7042" stdev="5"/> <z-angle to="A" val="107.2424" stdev="8"/>
<s-distance to="A" val="78.3888" stdev="2"/> <direction to="B" val="243.4207" stdev="5"/>
<z-angle to="B" val="103.3549" stdev="8"/> <s-distance to="B" val="89.1956" stdev="2"/>
<direction to="C" val="154.3384" stdev="5"/> <z-angle to="C" val="114.0626" stdev="8"/>
<s-distance to="C" val="67.5438" stdev="2"/> </obs>
<height-differences> <dh from="BM" to="A" val="1.5001" dist="0.35"/>
<dh from="A" to="B" val="4.1999" dist="0.2"/> <dh from="A" to="B" val="4.1989" dist="0.2"/>
<dh from="B" to="C" val="-10.1002" stdev="0.4"/> <dh from="C" to="E" val="14.8000" stdev="0.4"/>
<dh from="E" to="A" val="-8.9000" stdev="0.4"/> </height-differences>
""",
        "A z 10.00010 0.6; B z 14.19971 0.7; C x 190.60040 0.9 y 311.39988 0.9 z 4.09966 0.7; "
        "E x 146.20003 0.7 y 262.69936 0.5 z 18.89961 0.7",
        16.7179,
        16,
    ),
    "vectors from a point that nobody measured": Printed(
        "ne",
        """
<point id="S" x="-850" y="420" z="33" fix="xyz"/> <point id="A" adj="xyz"/> <point id="B" adj="xyz"/>
<point id="C" adj="xyz"/> <point id="E" adj="xyz"/>
<obs from="A"> <direction to="B" val="217.9374" stdev="5"/> <z-angle to="B" val="97.8120" stdev="8"/>
<s-distance to="B" val="122.2701" stdev="2"/> <direction to="C" val="266.7411" stdev="5"/>
<z-angle to="C" val="102.6137" stdev="8"/> <s-distance to="C" val="143.7119" stdev="2"/>
<direction to="E" val="269.7817" stdev="5"/> <z-angle to="E" val="92.7560" stdev="8"/>
<s-distance to="E" val="78.3894" stdev="2"/> </obs>
<obs from="B"> <direction to="A" val="271.4672" stdev="5"/> <z-angle to="A" val="102.1862" stdev="8"/>
<s-distance to="A" val="122.2719" stdev="2"/> <direction to="C" val="183.3281" stdev="5"/>
<z-angle to="C" val="106.3214" stdev="8"/> <s-distance to="C" val="101.8647" stdev="2"/>
<direction to="E" val="227.5931" stdev="5"/> <z-angle to="E" val="96.6435" stdev="8"/>
<s-distance to="E" val="89.2033" stdev="2"/> </obs>
<obs from="E"> <direction to="A" val="31.0829" stdev="5"/> <z-angle to="A" val="107.2436" stdev="8"/>
<s-distance to="A" val="78.3908" stdev="2"/> <direction to="C" val="224.4487" stdev="5"/>
<z-angle to="C" val="114.0642" stdev="8"/> <s-distance to="C" val="67.5431" stdev="2"/> </obs>
<vectors> <vec from="S" to="A" dx="950.0027" dy="-219.9924" dz="-23.0034"/>
<vec from="S" to="B" dx="1071.3008" dy="-205.2021" dz="-18.7997"/>
<vec from="C" to="S" dx="-1040.6047" dy="108.5962" dz="28.8986"/>
<vec from="A" to="C" dx="90.6036" dy="111.4063" dz="-5.9083"/>
<cov-mat dim="12" band="2"> 16 3 -2 25 5 0 49 0 0 16 3 -2 25 5 0 49 0 0 16 3 -2 25 5 0 49 0 0 16 3 -2 25 5 49
</cov-mat> </vectors>
""",
        "A x 100.00198 2.0 y 200.00442 2.6 z 9.99946 3.2; B x 221.30265 1.9 y 214.80108 2.5 z 14.19894 3.2; "
        "C x 190.60357 2.2 y 311.40380 2.3 z 4.09990 3.2; E x 146.20298 1.9 y 262.70396 2.3 z 18.90006 3.2",
        12.8825,
        21,
    ),
    "angles that share directions, and vectors in plan": Printed(
        "ne",
        """
<point id="A" x="100" y="200" fix="xy"/> <point id="B" x="221.3" y="214.8" fix="xy"/>
<point id="C" x="190.5" y="311.5" adj="xy"/> <point id="E" x="146.3" y="262.6" adj="xy"/>
<point id="F" x="302" y="271.4" adj="xy"/>
<obs from="A"> <angle bs="B" fs="F" val="13.9389"/> <angle bs="F" fs="C" val="34.8636"/>
<angle bs="C" fs="E" val="3.0413"/>
<cov-mat dim="3" band="1">32 -16 32 -16 32</cov-mat> </obs>
<obs from="B"> <angle bs="A" fs="E" val="356.1264"/> <angle bs="E" fs="C" val="355.7341"/>
<angle bs="C" fs="F" val="319.4383"/>
<cov-mat dim="3" band="1">32 -16 32 -16 32</cov-mat> </obs>
<obs from="C"> <angle bs="E" fs="A" val="3.5941"/> <angle bs="A" fs="B" val="63.0579"/>
<angle bs="B" fs="F" val="58.4961"/>
<cov-mat dim="3" band="1">32 -16 32 -16 32</cov-mat> </obs>
<obs from="F"> <distance to="B" val="98.5464" stdev="2"/> <distance to="C" val="118.2355" stdev="2"/> </obs>
<obs from="A"> <distance to="C" val="143.5886" stdev="2"/> <distance to="E" val="77.8828" stdev="2"/> </obs>
<vectors> <vec from="A" to="F" dx="201.8982" dy="71.5054" dz="2.4060"/>
<vec from="B" to="E" dx="-75.1001" dy="47.9033" dz="4.6984"/>
<cov-mat dim="6" band="2"> 16 3 -2 25 5 0 49 0 0 16 3 -2 25 5 49 </cov-mat> </vectors>
<height-differences> <dh from="A" to="C" val="-5.8996" stdev="0.4"/> </height-differences>
""",
        "C x 190.59962 0.6 y 311.39909 0.6; E x 146.19952 0.5 y 262.69934 0.5; F x 301.89908 0.9 y 271.49952 0.7",
        7.45469,
        11,
    ),
    "observations that are correlated": Printed(
        "en",
        """
<point id="A" x="100" y="200" z="10" fix="xyz"/> <point id="B" x="221.3" y="214.8" z="14.2" fix="xyz"/>
<point id="C" x="190.5" y="311.5" z="44.1" adj="xyz"/>
<point id="E" x="146.3" y="262.6" z="28.9" adj="xyz"/>
<obs from="A"> <direction to="B" val="22.27171"/> <direction to="C" val="373.40622"/> <direction to="E"
val="370.54087"/> <distance to="C" val="143.6043"/> <distance to="E" val="77.8641"/> <z-angle to="C" val="85.15713"/>
<z-angle to="E" val="84.83961"/>
<cov-mat dim="7" band="6"> 25 11.73 -0.26 -0.82 -0.17 -9.89 -15.01 30.5 5.96 -4.82 0.32 -5.04 -6.11 26.48 -0.12 -5.26
10.84 17.03 4.85 -0.94 -2.05 -6.62 5.27 -2.33 2.03 59.73 20.03 88.01</cov-mat> </obs>
<obs from="B"> <direction to="A" val="322.27054"/> <s-distance to="C" val="105.8016"/> <direction to="C"
val="10.36966"/> <z-angle to="C" val="81.76058"/> <direction to="E" val="366.12236"/> <s-distance to="E"
val="90.1447"/>
<cov-mat dim="6" band="2"> 25 0.45 -11.58 4.01 -2.99 3.65 32.3 -13.49 5.56 61.98 -5.18 2 26.27 0.49 4.97</cov-mat>
</obs>
<obs from="C"> <direction to="A" val="373.40437"/> <direction to="B" val="310.36838"/> <distance to="E"
val="65.9166"/> <direction to="E" val="376.78775"/> <z-angle to="E" val="114.42851"/>
<cov-mat dim="5" band="4"> 25 19.64 -0.62 -0.69 11.91 40.43 -1.21 -0.24 11.72 4.04 -3.68 0.08 28.43 -7.94
57.04</cov-mat> </obs>
""",
        "C x 190.49954 0.7 y 311.50030 0.6 z 44.10013 0.7; E x 146.29882 0.6 y 262.59981 0.5 z 28.89979 0.7",
        5.68904,
        9,
    ),
    "directions alone, and rough places of the datum": Printed(
        "en",
        """
<point id="A" x="100" y="200" adj="XY"/> <point id="B" x="221.3" y="214.8" adj="XY"/>
<point id="C" x="190.6" y="311.4" adj="XY"/> <point id="E" x="146.2" y="262.7" adj="xy"/>
<obs from="A"> <direction to="B" val="153.5020" stdev="5"/> <direction to="C" val="104.6984" stdev="5"/>
<direction to="E" val="101.6577" stdev="5"/> </obs>
<obs from="B"> <direction to="A" val="278.5843" stdev="5"/> <direction to="C" val="366.7246" stdev="5"/>
<direction to="E" val="322.4588" stdev="5"/> </obs>
<obs from="E"> <direction to="A" val="347.7042" stdev="5"/> <direction to="B" val="243.4207" stdev="5"/>
<direction to="C" val="154.3384" stdev="5"/> </obs>
""",
        "A x 100.00003 0.5 y 199.99998 0.4; B x 221.29995 0.7 y 214.79998 0.6; C x 190.60002 0.4 y 311.40005 0.6; "
        "E x 146.19962 0.8 y 262.69933 1.0",
        3.75993,
        2,
    ),
    "a point that looks back": Printed(
        "ne",
        """
<point id="A" x="100" y="200" fix="xy"/> <point id="B" x="221.3" y="214.8" adj="xy"/> <point id="C" adj="xy"/>
<point id="Q" adj="xy"/>
<obs from="A"> <azimuth to="B" val="7.7293" stdev="6"/> <azimuth to="Q" val="380.2270" stdev="6"/> </obs>
<obs from="A"> <direction to="B" val="265.5652" stdev="5"/> <distance to="B" val="122.1962" stdev="2"/>
<direction to="C" val="314.3670" stdev="5"/> <distance to="C" val="143.5902" stdev="2"/> </obs>
<obs from="B"> <direction to="A" val="44.1613" stdev="5"/> <distance to="A" val="122.2040" stdev="2"/>
<direction to="C" val="356.0210" stdev="5"/> <distance to="C" val="101.3597" stdev="2"/> </obs>
<obs from="Q"> <direction to="A" val="319.0787" stdev="5"/> <direction to="B" val="273.6886" stdev="5"/> </obs>
<obs from="C"> <direction to="A" val="364.2297" stdev="5"/> <direction to="B" val="27.2868" stdev="5"/> </obs>
""",
        "B x 221.30019 1.6 y 214.80004 1.7; C x 190.60168 2.4 y 311.39888 2.1; Q x 261.99965 3.0 y 148.00101 2.7",
        8.29489,
        4,
    ),
}
LEVELLED, VECTORS, SHARED, CORRELATED, DIRECTIONS, BACK = NETWORKS.values()


@pytest.mark.parametrize("kind", NETWORKS)
def test_a_network_agrees_with_the_printed_digit(tmp_path: Path, kind: str) -> None:
    network = NETWORKS[kind]
    adjustment = adjust(read(network.write(tmp_path / "network.gkf")))
    ours, theirs = network.compared(adjustment)
    assert not adjustment.rejected_references
    assert adjustment.dof == network.dof
    assert adjustment.chi2 == pytest.approx(network.pvv, rel=1e-5)
    assert np.abs(ours - theirs)[:, 0].max() < PRINTED
    assert np.abs(ours - theirs)[:, 1].max() < 0.051


@pytest.mark.parametrize("kind", NETWORKS)
def test_it_is_written_and_read_again(tmp_path: Path, kind: str) -> None:
    recording = read(NETWORKS[kind].write(tmp_path / "network.gkf"))
    write(recording, tmp_path / "native", "native")
    native = read(tmp_path / "native")
    assert native.setup.differences == recording.setup.differences
    assert not native.notes
    assert adjust(native).chi2 == pytest.approx(NETWORKS[kind].pvv, rel=1e-5)
    if kind in ("levelled lines", "vectors from a point that nobody measured"):
        write(recording, tmp_path / "again.gkf", "gama-local")
        again = adjust(read(tmp_path / "again.gkf"))
        assert again.dof == NETWORKS[kind].dof
        assert again.chi2 == pytest.approx(NETWORKS[kind].pvv, rel=1e-5)
    elif recording.setup.differences or kind == "observations that are correlated":
        with pytest.raises(RecordError, match=r"known along xy, which gama-local|errors that readings share"):
            write(recording, tmp_path / "again.gkf", "gama-local")


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize(
    ("network", "old", "new", "name"),
    [
        (LEVELLED, 'val="4.1989"', 'val="4.2189"', "A-B#2 is off by 18.8"),
        (LEVELLED, 'val="1.5001"', 'val="15.001"', ""),
        (LEVELLED, 'val="14.8000"', 'val="18.4000"', "C-E is off by 3600"),
        (VECTORS, 'dy="108.5962"', 'dy="108.6962"', "C-S is off by "),
    ],
)
def test_a_wrong_difference_is_named_and_the_readings_stay(
    tmp_path: Path, network: Printed, old: str, new: str, name: str, robust: bool
) -> None:
    """But for a line that nothing checks."""
    adjustment = adjust(read(network.write(tmp_path / "network.gkf", old, new)), robust=robust)
    sentences = [test.sentence for test in adjustment.rejected_references]
    assert len(sentences) == bool(name)
    assert all(name in sentence and "as the readings show: excluded" in sentence for sentence in sentences)
    assert not adjustment.is_rejected_reading.any()
    assert adjustment.sigma0 == pytest.approx(1.0, abs=0.3)


def test_levels_alone_give_heights_and_what_none_reaches_has_none(tmp_path: Path) -> None:
    """Directions and horizontal distances tell plans; heights come along the lines, to targets and to stations."""
    inside = LEVELLED.inside
    for part in [p for p in inside.split("<") if p.startswith(("z-angle", "s-distance", 'dh from="E"'))]:
        inside = inside.replace("<" + part, "")
    for at, aim in (("A", 60), ("B", 350)):
        aimed = f'<obs from="{at}"><direction to="D" val="{aim}" stdev="5"/>'
        inside = inside.replace(f'<obs from="{at}">', aimed)
    inside = inside.replace('<point id="E"', '<point id="D" adj="xyz"/><point id="E"')
    adjustment = adjust(read(Printed("en", inside, "", 0.0, 0).write(tmp_path / "network.gkf")))
    names = adjustment.recording.targets
    lines = {"A": 10.0001, "B": 14.1995, "C": 4.0993, "E": 18.8993}
    for name, height in lines.items():
        assert adjustment.state.target_points[names.index(name), 2] == pytest.approx(height, abs=1e-6)
    assert [names[t] for t in np.flatnonzero(adjustment.is_height_undetermined_target)] == ["D"]
    tested = {t.name: t.redundancy[0] for t in adjustment.reference_tests if t.kind == "difference"}
    assert [name for name, redundancy in tested.items() if redundancy > 1e-3] == ["A-B", "A-B#2"]
    assert set(tested) == {"BM-A", "A-B", "A-B#2", "B-C", "C-E"}


def test_a_difference_wrong_by_far_goes_where_others_contradict_each_other(tmp_path: Path) -> None:
    """Three of six are wrong: of two nobody can tell which, of the one that is off by kilometres all the others do."""
    inside = LEVELLED.inside
    for old, new in (('"4.1989"', '"1504.1989"'), ('"14.8000"', '"14.8300"'), ('"-8.9000"', '"-8.8600"')):
        assert old in inside
        inside = inside.replace(old, new)
    adjustment = adjust(read(Printed("en", inside, "", 0.0, 0).write(tmp_path / "network.gkf")))
    assert [(test.name, test.is_excluded) for test in adjustment.rejected_references] == [("A-B#2", True)]
    assert adjustment.rejected_references[0].error[0] == pytest.approx(1500.0, abs=0.1)
    assert np.abs(adjustment.state.target_points[:, 2] - [14.2, 4.1, 18.9, 10.0]).max() < 0.05


def test_undetermined_heights_are_reported_as_in_gama(tmp_path: Path) -> None:
    inside = LEVELLED.inside.partition("<height-differences>")[0]
    for part in [p for p in inside.split("<") if p.startswith(("z-angle", "s-distance"))]:
        inside = inside.replace("<" + part, "")
    printed = "C x 190.60010 0.7 y 311.39988 0.9; E x 146.19983 0.6 y 262.69942 0.4"
    network = Printed("en", inside, printed, 5.5055639, 8)
    adjustment = adjust(read(network.write(tmp_path / "network.gkf")))
    ours, theirs = network.compared(adjustment)
    assert adjustment.dof == network.dof
    assert adjustment.chi2 == pytest.approx(network.pvv, rel=1e-5)
    assert np.abs(ours - theirs)[:, 0].max() < PRINTED
    assert np.abs(ours - theirs)[:, 1].max() < 0.051
    assert adjustment.is_height_undetermined_target.all()
    assert np.isnan(adjustment.pose_covariance[:, 2, 2]).all()
    assert all(abs(test.error[2]) == 0.0 for test in adjustment.reference_tests if test.kind == "mark")


def test_the_frame_names_what_holds_it(tmp_path: Path) -> None:
    calibration = calibrate(NETWORKS["vectors from a point that nobody measured"].write(tmp_path / "network.gkf"))
    assert calibration.frame == "the frame of the known differences S-A, S-B, C-S, A-C"
    assert "4 known differences" in calibration.adjustment.recording.headline
    free = calibrate(DIRECTIONS.write(tmp_path / "free.gkf"))
    assert free.frame.startswith("the axes and the scale of the declared coordinates of the datum's targets")


def test_differences_are_a_source_of_uncertainty(tmp_path: Path) -> None:
    adjustment = adjust(read(LEVELLED.write(tmp_path / "network.gkf")))
    sources = observation_uncertainty_sources(
        adjustment, displacement_per_observation(adjustment, adjustment.problem.unknowns.target_columns.ravel())
    )
    assert "known differences" in {source.name for source in sources}
    spread = sum(source.covariance for source in sources)
    np.testing.assert_allclose(np.diag(spread), adjustment.target_covariances[:, range(3), range(3)].ravel(), rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('<point id="BM" z="8.5" fix="z"/>', "", "difference BM-A: 'BM' was never measured, expected a measured mark"),
        ('id="BM" z="8.5" fix="z"', 'id="BM" z="8.5" adj="z"', "difference BM-A: 'BM' was never measured"),
        ("</obs>", '<cov-mat dim="6" band="1">9 9 9 0 9 0 9 0 9 0 9</cov-mat></obs>', "not positive definite"),
        ("</obs>", '<cov-mat dim="6" band="0">9 0 9 9 9 9</cov-mat></obs>', "has a variance that is not above 0"),
        (
            '<obs from="A">',
            f'<obs from="A">{502 * ANOTHER}<cov-mat dim="502" band="1">{501 * "9 1 "}9</cov-mat></obs><obs from="A">',
            "correlate more than 500 observations",
        ),
        (
            'val="1.5001" dist="0.35"',
            'val="1.5001"',
            "no standard deviation is given for <dh>, expected one (stdev, dist",
        ),
        ('val="1.5001" dist="0.35"', 'val="1.5001" stdev="0"', "expected values below 1e8 m"),
        (
            'val="1.5001"',
            'from_dh="1.5" val="1.5001"',
            "expected a difference between the marks, without from_dh and to_dh",
        ),
        ('from="BM" to="A"', 'from="A" to="A"', "<dh> goes from a point to itself"),
        (
            "<height-differences>",
            '<height-differences><vec from="A"/>',
            "<vec> is in <height-differences>, expected <dh>",
        ),
        ("</height-differences>", '<cov-mat dim="2" band="0">1 1</cov-mat></height-differences>', "does not match its"),
        (
            "<height-differences>",
            '<vectors><vec from="A" to="B" dx="1" dy="1" dz="1"/></vectors><height-differences>',
            "a <cov-mat>",
        ),
    ],
)
def test_what_cannot_be_read_is_refused_in_a_sentence(tmp_path: Path, old: str, new: str, says: str) -> None:
    with pytest.raises(RecordError) as refused:
        read(LEVELLED.write(tmp_path / "network.gkf", old, new))
    assert says in str(refused.value)
    assert "network.gkf" in str(refused.value)


def test_a_set_up_states_differences_once_and_between_two_marks(tmp_path: Path) -> None:
    write(read(LEVELLED.write(tmp_path / "network.gkf")), tmp_path / "native", "native")
    file = tmp_path / "native" / "setup.toml"
    text = file.read_text()
    for old, new, says in (
        ('name = "A-B#2"\n', "", "another difference is named 'A-B', too; set a different name"),
        ('from = "C"\n', 'from = "E"\n', "the difference is from 'E' to itself"),
        ('from = "BM"\n', 'from = "BN"\n', "'BN' was never measured"),
    ):
        assert old in text
        file.write_text(text.replace(old, new))
        with pytest.raises(RecordError, match=says):
            read(tmp_path / "native")


def test_triangles_between_reference_points_are_assembled_by_their_shapes(tmp_path: Path) -> None:
    """No set-up sees two known points, and there is no distance."""
    places = {"A": (0, 0), "C": (100, 20), "E": (-10, 95), "Z": (150, 130)}
    points = '<point id="A" x="0" y="0" fix="xy"/><point id="Z" x="150" y="130" fix="xy"/>'
    unknown = '<point id="C" adj="xy"/><point id="E" adj="xy"/>'
    rough = '<point id="C" x="98" y="21" adj="xy"/><point id="E" x="-9" y="97" adj="xy"/>'

    def adjusted(points: str, angles: str) -> Adjustment:
        inside = points
        for at, back, on in (angle.split() for angle in angles.split(", ")):
            ways = [np.subtract(places[end], places[at]) for end in (back, on)]
            turned = np.subtract(*(np.arctan2(way[1], way[0]) for way in reversed(ways))) * 200 / np.pi % 400
            inside += f'<obs from="{at}"><angle bs="{back}" fs="{on}" val="{turned:.4f}" stdev="5"/></obs>'
        return adjust(read(Printed("ne", inside, "", 0.0, 0).write(tmp_path / "network.gkf")))

    whole, fewest = "A C E, Z E C, C E A, C Z E, E A C, E C Z", "A C E, Z E C, C E A, C Z E"
    for angles, dof in ((whole, 2), (fewest, 0)):
        near, estimate = adjusted(points + rough, angles), adjusted(points + unknown, angles)
        assert near.solution.has_converged and estimate.solution.has_converged
        assert near.dof == estimate.dof == dof
        for name, (x, y) in places.items():
            for candidate in (near, estimate):
                assert candidate.state.target_points[candidate.recording.targets.index(name), :2] == pytest.approx(
                    (x, -y), abs=2e-3
                )
    with pytest.raises(NetworkError, match="or approximate coordinates of all"):
        adjusted(points + unknown, "A C E, Z E C, C E A")


def test_set_ups_over_a_common_mark_have_no_floor_plan_to_test(tmp_path: Path) -> None:
    places = {"A": (0, 0), "B": (120, 10), "C": (40, 130), "P": (50, 40)}
    inside = "".join(f'<point id="{n}" x="{x}" y="{y}" fix="xy"/>' for n, (x, y) in places.items() if n != "P")
    inside += '<point id="P" x="50" y="40" adj="xy"/>'
    for back, on in ("AB", "BC", "CA"):
        ways = [complex(*places[end]) - complex(*places["P"]) for end in (back, on)]
        turned = -np.angle(ways[1] / ways[0]) * 200 / np.pi % 400
        inside += f'<obs from="P"><angle bs="{back}" fs="{on}" val="{turned:.4f}" stdev="5"/></obs>'
    judged = verdict_on(adjust(read(Printed("en", inside, "", 0.0, 0).write(tmp_path / "network.gkf"))))
    assert "differ from the network" not in judged.sentence
    assert judged.sentence.startswith(("Trust the declared noise", "Noise and model agree"))


def test_of_noise_and_a_shift_below_the_threshold_the_likelier_is_reported(tmp_path: Path) -> None:
    """Readings far less noisy than stated, but few: nothing shifts them."""
    wider = re.sub(r'stdev="([0-9.]+)"', lambda match: f'stdev="{8 * float(match[1]):g}"', SHARED.inside)
    diagnosis = diagnose(read(Printed(SHARED.axes, wider, "", 0.0, 0).write(tmp_path / "network.gkf")))
    (level,) = diagnosis.findings
    assert level.effect == "noise-level"
    assert [parameter.name for parameter in level.parameters] == [
        "noise-distance",
        "noise-azimuth",
    ]  # nobody read an elevation


def test_what_is_constant_in_a_plan_drives_no_law(tmp_path: Path) -> None:
    """Elevations of a plan differ by 1e-31: a smooth function of them was a random one."""
    adjustment = adjust(read(DIRECTIONS.write(tmp_path / "network.gkf")))
    names = {
        name
        for drivers in candidate_regressors(adjustment.sightings).values()
        for driver in drivers
        for name in driver.covariates
    }
    assert {"azimuth", "distance"} <= names
    assert not {name for name in names if "elevation" in name or "height" in name}


def test_of_constants_that_a_plan_does_not_distinguish_a_single_constant_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There an offset of the transit axis is the range zero over again: the two together had no deviation at all."""
    adjustment = adjust(read(BACK.write(tmp_path / "network.gkf")), misalignment_construction())
    names = adjustment.construction.parameter_names
    both = {names.index("transit-offset"): 4.0, names.index("range-offset"): 3.0}
    logs = {k: np.where(np.arange(len(names)) == k, size, -9.0) for k, size in both.items()}
    monkeypatch.setattr(instruments, "forward_select", lambda evidence, least: logs)
    (contradiction,) = instruments.find_contradicting_instrument_constants(adjustment).contradictions
    assert contradiction.parameter.name == "transit-offset"
    assert np.isfinite(contradiction.sigma)


def test_of_a_bad_angle_and_a_mark_that_explain_the_same_the_angle_goes(tmp_path: Path) -> None:
    """The mark of a set-up of two readings takes up whatever is wrong with them."""
    rng, places = np.random.default_rng(3), {"A": 5600 + 4966j, "B": 6061 + 8043j, "C": 9787 + 8038j, "D": 9260 + 4843j}
    inside = "".join(
        f'<point id="{n}" x="{z.real}" y="{z.imag}" {"fix" if n in "AB" else "adj"}="xy"/>' for n, z in places.items()
    )
    for (at, to), sigma in zip(("AB", "BC", "CD", "DA", "AC", "BD"), (10, 12, 10, 12, 16, 14), strict=True):
        length = abs(places[at] - places[to]) + 1e-3 * sigma * rng.normal()
        inside += f'<obs from="{at}"><distance to="{to}" val="{length:.3f}" stdev="{sigma}"/></obs>'
    for at, back, on in ("ABC", "ACD", "BCD", "BDA", "CDA", "CAB", "DAB", "DBC"):
        turn = -np.angle((places[on] - places[at]) / (places[back] - places[at])) * 200 / np.pi
        turn += 6.5e-4 * rng.normal() + 0.019 * (at + back + on == "DAB")
        inside += f'<obs from="{at}"><angle bs="{back}" fs="{on}" val="{turn % 400:.5f}" stdev="6.5"/></obs>'
    recording = read(Printed("en", inside, "", 0.0, 0).write(tmp_path / "network.gkf"))
    adjustment = adjust(recording, robust=True)
    assert not adjust(recording).rejected_references and not adjustment.rejected_references
    rows, columns = np.nonzero(adjustment.is_rejected_reading)
    assert {recording.stations[s] for s in recording.station[rows]} == {"D"}
    assert set(columns.tolist()) == {1}
