"""A network with pointings nobody made, and what would determine a combination."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.remedies.candidates import (
    ADVICE_SENTENCES,
    calibrated_length_candidates,
    near_reflector_candidates,
    pointing_candidates,
    procedure_candidates,
    repeated_setup_candidates,
)
from ltsim.adjustment.remedies.network import PlannedNetwork
from ltsim.calibration.network import calibrate_network
from ltsim.core.arrays import Bools, Floats
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings import read
from tests.networks import drawn, network, ranked_measurements


@pytest.fixture(scope="module")
def measured() -> PlannedNetwork:
    recording, _ = network(values=drawn(misalignment_construction(), 1), seed=1, stations=3)
    return PlannedNetwork.from_adjustment(adjust(recording, misalignment_construction()))


def test_a_planned_network_has_the_information_of_a_measured_network(measured: PlannedNetwork) -> None:
    """Everything once more in the same order, planned and then solved with its predicted readings."""
    recording = measured.recording
    twice = measured.with_pointings(recording.station, recording.target, recording.face)
    assert len(twice.recording) == 2 * len(recording)
    again = adjust(twice.recording, misalignment_construction()).first_instrument_covariance
    assert twice.make_adjustment().first_instrument_covariance == pytest.approx(again, rel=1e-3)
    assert twice.recording.time[len(recording) :].min() > recording.time.max()


def test_a_longer_network_never_knows_less(measured: PlannedNetwork) -> None:
    before = measured.make_adjustment().first_instrument_covariance
    for candidate in [
        *procedure_candidates(measured),
        *calibrated_length_candidates(measured),
        *repeated_setup_candidates(measured, 1200.0),
        *near_reflector_candidates(measured)
    ]:  # fmt: skip
        after = candidate.network.make_adjustment().first_instrument_covariance
        scale = np.sqrt(np.outer(np.diag(before), np.diag(before)))
        assert np.linalg.eigvalsh((before - after) / scale).min() > -1e-6, candidate.instruction


def test_a_reference_length_is_not_calibrated_again(measured: PlannedNetwork) -> None:
    assert measured.with_length(24, 25, 0.002) is measured
    grown = measured.with_length(0, 25, 0.002)
    assert len(grown.recording.gauge.distance) == len(measured.recording.gauge.distance) + 1


def test_a_proposed_length_does_not_end_at_a_suspect_target(measured: PlannedNetwork) -> None:
    (proposal,) = calibrated_length_candidates(measured)
    ends = proposal.instruction.partition(" between ")[2].split(" and ")
    for suspects in (ends[:1], ends[1:], ends):
        (other,) = calibrated_length_candidates(measured, suspects)
        assert not set(suspects) & set(other.instruction.partition(" between ")[2].split(" and "))
    assert not list(calibrated_length_candidates(measured, measured.recording.targets[1:]))


def test_a_calibration_proposes_no_length_to_a_moved_target() -> None:
    """A moved target was proposed as an end of the length that determines the scale."""
    recording, _ = network(seed=1, faces=2)
    plain = recording.replace(setup=recording.setup.model_copy(update={"gauge": None}))
    (first, *_) = [
        c.measurement for c in calibrate_network(plain).undetermined if "such as the distance" in c.measurement
    ]
    name = first.partition(" between ")[2].split(" and ")[0]
    later = (plain.target == plain.targets.index(name)) & (plain.time > np.median(plain.time))
    moved = plain.with_readings(plain.readings + np.outer(later, [0.003, 0.0, 0.0]))
    calibration = calibrate_network(moved)
    assert any(test.where.targets == (name,) for test in calibration.tests)
    instructions = " ".join(c.measurement for c in calibration.undetermined)
    assert "such as the distance between" in instructions and not re.search(rf"\b{name}\b", instructions)


def test_the_smallest_recordings_get_advice_and_no_traceback() -> None:
    """One pointing, one target from one station in both faces, two targets from one station."""
    recording, _ = network(seed=1, faces=2)
    for rows in (recording.target == 0, recording.target < 2):
        set_up = recording.select(rows & (recording.station == 0))
        calibration = calibrate_network(set_up)
        assert all(c.cure for c in calibration.undetermined)
    first = recording.select(np.arange(len(recording)) == 0)
    assert any("no tested measurement" in c.cure for c in calibrate_network(first).undetermined)


def test_every_way_of_measuring_on_has_its_sentence(measured: PlannedNetwork) -> None:
    """Each further measurement that is tried here is told by a sentence of the table, its blanks filled."""
    blank = re.compile(r"\\\{[^}]*\\\}")
    patterns = {key: blank.sub("(.+)", re.escape(text)) for key, text in ADVICE_SENTENCES.items()}
    tried = [
        *procedure_candidates(measured),
        *calibrated_length_candidates(measured),
        *repeated_setup_candidates(measured, 1200.0),
        *near_reflector_candidates(measured)
    ]  # fmt: skip
    matches = {
        candidate.instruction: {key for key, text in patterns.items() if re.fullmatch(text, candidate.instruction)}
        for candidate in tried
    }
    assert all(len(keys) == 1 for keys in matches.values()), matches
    assert {"other face", "close", "reverse", "length", "near", "turned"} <= set().union(*matches.values())


def test_nobody_aims_at_the_mark_that_the_tripod_stands_on(measured: PlannedNetwork) -> None:
    """A target that the last station has not measured because it stands over it is no candidate; another one is."""
    recording = measured.recording
    last = int(recording.station[np.argmax(recording.time)])
    remaining = recording.select(~((recording.station == last) & np.isin(recording.target, [3, 4])))
    network = PlannedNetwork.from_adjustment(adjust(remaining, misalignment_construction()))
    points, position = network.state.target_points.copy(), network.state.station_positions
    points[remaining.targets.index(recording.targets[3])] = position[last]
    over = replace(network, state=replace(network.state, target_points=points))
    words = [
        candidate.instruction for candidate in pointing_candidates(over) if "has not measured" in candidate.instruction
    ]
    assert len(words) == 1
    assert f"({recording.targets[4]})" in words[0]

    def blocked(places: Floats, targets: Floats) -> Bools:
        return np.zeros((len(places), len(targets)), dtype=bool)

    assert not [
        r for r in pointing_candidates(over, visibility_function=blocked) if "has not measured" in r.instruction
    ]


def test_a_plan_is_continued_in_plan_and_a_set_up_that_sees_too_little_is_no_remedy(tmp_path: Path) -> None:
    """A traverse between two known points: whoever stands at its end sees one target, and nobody reads a height."""
    places = {"A": (0.0, 0.0), "B": (100.0, 50.0), "C": (200.0, -40.0), "D": (300.0, 0.0)}
    kinds = {"A": "fix", "D": "fix", "B": "adj", "C": "adj"}
    lines = [f'<point id="{n}" x="{x}" y="{y}" {kinds[n]}="xy"/>' for n, (x, y) in places.items()]
    for at, targets in {"A": "B", "B": "AC", "C": "BD", "D": "C"}.items():
        lines.append(f'<obs from="{at}">')
        for to in targets:
            away = complex(*places[to]) - complex(*places[at])
            lines.append(f'<direction to="{to}" val="{np.degrees(np.angle(away)) / 0.9 % 400:.4f}" stdev="5"/>')
            lines.append(f'<distance to="{to}" val="{abs(away):.4f}" stdev="1"/>')
        lines.append("</obs>")
    head = '<gama-local><network axes-xy="en" angles="right-handed"><points-observations>'
    file = tmp_path / "traverse.gkf"
    file.write_text("\n".join([head, *lines, "</points-observations></network></gama-local>"]))
    adjustment = adjust(read(file))
    network = PlannedNetwork.from_adjustment(adjustment)
    before = len(network.recording)
    remedies = [*pointing_candidates(network), *repeated_setup_candidates(network, 60.0)]
    assert all(candidate.network.recording.is_horizontal_distance[before:].all() for candidate in remedies)
    determined = {
        candidate.instruction.split(",")[0]: candidate.make_adjustment() is not None
        for candidate in remedies
        if candidate.kind == "return"
    }
    assert determined == {f"set up once more at {name}": name in "BC" for name in "ABCD"}
    assert all(candidate.make_adjustment() is not None for candidate in remedies if candidate.kind == "pointings")
    assert ranked_measurements(read(file)).proposals
