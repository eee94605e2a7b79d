"""Further measurements: what is promised comes true when they are made."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.remedies.candidates import (
    FloorPlanTransform,
    near_reflector_candidates,
    pointing_candidates,
    procedure_candidates,
    repeated_setup_candidates,
    station_candidates,
)
from ltsim.adjustment.remedies.explanations import RivalCauses, best_explanation, residual_space_of
from ltsim.adjustment.remedies.network import PlannedNetwork
from ltsim.adjustment.remedies.next_measurement import rank_deciding_measurements
from ltsim.cli.main import run
from ltsim.core.errors import ModelError
from ltsim.diagnosis.detectability import explanations_of_ambiguous_finding
from ltsim.diagnosis.diagnose import diagnose
from ltsim.physics.model.construction import ideal_construction, misalignment_construction
from ltsim.planning.objective import d_criterion
from ltsim.recordings import Recording, write
from ltsim.simulation.scenario import Scenario, load_scenario
from ltsim.simulation.sections import EffectEntry
from ltsim.simulation.simulator import simulate
from ltsim.simulation.truth import Truth
from tests.networks import ranked_measurements


def scenario(**values: float) -> Scenario:
    """The paper's workshop, one face, with a vertical index that drifts in every visit."""
    entry = EffectEntry(name="index-drift", values=values, shape={"law": "visit"})
    return load_scenario("paper-workshop").model_copy(update={"effects": (entry,)})


@pytest.fixture(scope="module")
def drifting() -> tuple[Recording, Truth]:
    return simulate(scenario(**{"index-drift": 60.0}), 5)


def test_proposals_are_ranked_by_what_they_tell_about_the_instrument(drifting: tuple[Recording, Truth]) -> None:
    made = ranked_measurements(drifting[0])
    sharper = [p.remaining_sigma_fraction for p in made.proposals]
    assert sharper == sorted(sharper)
    assert max(sharper) <= 1.0 + 1e-9
    assert "other face" in made.proposals[0].candidate.instruction
    assert {p.candidate.kind for p in made.proposals} == {"pointings", "return", "station"}


def test_a_tracker_without_parameters_gets_no_advice_and_explanations_are_still_distinguished(
    drifting: tuple[Recording, Truth],
) -> None:
    adjusted = adjust(drifting[0], ideal_construction())
    asked = [best_explanation(residual_space_of(adjusted, ()), name) for name in ("index-drift", "station-settling")]
    made = rank_deciding_measurements(adjusted, asked, stops_at_first=True)
    assert made.proposals[0].expected_chi2_differences
    assert {
        (p.remaining_sigma_fraction, p.most_improved_parameter, p.most_improved_sigma_fraction) for p in made.proposals
    } == {(1.0, "", 1.0)}


def test_a_proposal_keeps_its_promise_when_it_is_measured(drifting: tuple[Recording, Truth]) -> None:
    """The best proposal, measured with noise and solved: the covariance is the promised one."""
    recording, construction = drifting[0], misalignment_construction()
    made = ranked_measurements(recording)
    best = made.proposals[0].candidate.network
    added = np.arange(len(best.recording)) >= len(recording)
    noise = np.random.default_rng(3).normal(size=best.recording.readings.shape) * best.recording.reading_sigmas()
    readings = best.recording.readings + noise * added[:, None]
    before, after = adjust(recording, construction), adjust(best.recording.with_readings(readings), construction)
    scale = before.problem.prior.sigma[0]
    ratio = [float(d_criterion(a.first_instrument_covariance / np.outer(scale, scale))) for a in (before, after)]
    assert ratio[1] / ratio[0] == pytest.approx(made.proposals[0].remaining_sigma_fraction, rel=0.01)


def test_what_is_added_is_in_sight_and_timed_after_the_rest(drifting: tuple[Recording, Truth]) -> None:
    network = PlannedNetwork.from_adjustment(adjust(drifting[0], misalignment_construction()))
    count, last = len(drifting[0]), drifting[0].time.max()
    later = [
        *pointing_candidates(network),
        *repeated_setup_candidates(network, 1200.0),
        *list(station_candidates(network, 1200.0))[:8],
    ]
    within = [*procedure_candidates(network), *near_reflector_candidates(network)]
    for k, candidate in enumerate([*later, *within]):
        grown = candidate.network.recording
        assert grown.time[count:].min() > (last if k < len(later) else grown.time[0])
        assert candidate.duration >= (len(grown) - count) * 15 - 1
        assert grown.is_measured[count:].all()
        assert np.array_equal(grown.readings[:count], network.recording.readings, equal_nan=True)


def test_a_further_station_is_given_on_the_floor_plan(drifting: tuple[Recording, Truth]) -> None:
    recording, truth = drifting
    adjustment = adjust(recording, misalignment_construction())
    plan = FloorPlanTransform.from_recording(recording, adjustment.state)
    assert plan.has_plan
    assert plan.positions_on_plan(adjustment.state.station_positions) == pytest.approx(truth.station_positions, abs=0.1)
    turned = [plan.yaw_on_plan(rotation) for rotation in adjustment.state.station_rotations]
    true = np.arctan2(truth.station_rotations[:, 1, 0], truth.station_rotations[:, 0, 0])
    assert np.abs(np.angle(np.exp(1j * (turned - true)))).max() < 0.05


def test_evidence_between_two_explanations_is_what_simulation_gives(drifting: tuple[Recording, Truth]) -> None:
    """Noise drawn on the true effect: the mean advantage of the true one over its rival is the evidence (and a little
    more, as the rival is free to fit noise)."""
    space = residual_space_of(adjust(drifting[0], misalignment_construction()))
    first, second = best_explanation(space, "index-drift"), best_explanation(space, "station-settling")
    expected = RivalCauses.from_explanations(space, first, second).present_chi2_difference
    design_columns = space.project(space.whitened_design(first.effect) @ first.parameter_values)[:, None]
    noise = space.project(np.random.default_rng(1).normal(size=(space.n_equations, 400)))

    def unexplained(effect, y):  # type: ignore[no-untyped-def]
        columns = space.project(space.whitened_design(effect))
        fitted = np.linalg.lstsq(columns, y, rcond=1e-8)[0]
        return ((y - columns @ fitted) ** 2).sum(axis=0) - columns.shape[1]

    advantage = unexplained(second.effect, design_columns + noise) - unexplained(first.effect, design_columns + noise)
    spread = advantage.std() / np.sqrt(400)
    assert advantage.mean() > 0.8 * expected - 4 * spread


def test_the_other_face_decides_between_an_index_drift_and_settling(drifting: tuple[Recording, Truth]) -> None:
    made = ranked_measurements(drifting[0], explanations=("index-drift", "station-settling"))
    now = made.present_chi2_differences["station-settling"]
    gained = [p.expected_chi2_differences["station-settling"] for p in made.proposals]
    assert all(value >= now - 0.5 for value in gained)
    assert [p.sort_key for p in made.proposals] == sorted(p.sort_key for p in made.proposals)


def test_effects_that_cannot_be_compared_are_refused(drifting: tuple[Recording, Truth]) -> None:
    space = residual_space_of(adjust(drifting[0], misalignment_construction()))
    with pytest.raises(ModelError, match="changes the noise"):
        best_explanation(space, "noise-level")
    with pytest.raises(ModelError, match="did you mean"):
        best_explanation(space, "index-drft")


def test_the_command_ranks_and_writes(drifting: tuple[Recording, Truth], tmp_path: Path) -> None:
    write(drifting[0], tmp_path / "rec")
    arguments = ["plan", "--after", str(tmp_path / "rec"), "--between", "index-drift,station-settling"]
    assert run([*arguments, "--out", str(tmp_path / "next"), "--quiet"]) == 0
    content = json.loads((tmp_path / "next" / "next.json").read_text(encoding="utf-8"))
    assert content["compared_effects"] == ["index-drift", "station-settling"]
    assert {p["kind"] for p in content["proposals"]} == {"pointings", "return", "station", "survey", "length"}
    assert content["advice"].startswith(content["proposals"][0]["action"])
    assert content["present_chi2_differences"]["station-settling"] > 0
    assert run([*arguments[:3], "--between", "index-drift"]) == 2
    assert run([*arguments[:3], "--between", "index-drift,range-stp"]) == 2


def test_a_suspicious_reflector_is_looked_at_again() -> None:
    """A lifted reflector or a wrong reading: three more pointings decide, and are proposed first."""
    entry = EffectEntry(
        name="nest-lift", stations=("S5",), targets=("T14",), values={"lift-y": 60.0}, shape={"kind": "free"}
    )
    made = load_scenario("paper-workshop").model_copy(update={"effects": (entry,)})
    proposals = ranked_measurements(simulate(made, 2)[0], explanations=("nest-lift", "outlier", "target-moved"))
    best = proposals.proposals[0]
    assert max(proposals.present_chi2_differences.values()) < 5
    assert best.distinguished_explanations == ("outlier",), (
        "it moved before the last visit, or in it: no pointing of that visit tells"
    )
    assert not best.distinguishes_all
    assert best.candidate.instruction == "measure T14 from S5 3 more times, without touching the reflector"
    assert best.candidate.duration == pytest.approx(45)


@pytest.mark.long
def test_diagnosis_and_plan_give_the_same_advice() -> None:
    """A drift of the ranges that a drift of the air imitates: one question, one answer, whoever is asked."""
    entry = EffectEntry(name="range-drift", values={"range-drift": 6.0})
    made = load_scenario("paper-workshop").model_copy(update={"effects": (entry,)})
    recording, _ = simulate(made, 3)
    diagnosis = diagnose(recording)
    between, context = explanations_of_ambiguous_finding(diagnosis)
    assert between
    asked = next(f for f in diagnosis.findings if f.effect == between[0])
    planned = ranked_measurements(recording, explanations=between, with_effects=context)
    assert asked.separate_by == planned.advice_sentence
    assert (
        planned.proposals[0].candidate.instruction in planned.advice_sentence
        or "no tested measurement" in planned.advice_sentence
    )


def test_a_longer_recording_never_tells_less_and_its_evidence_is_that_of_all_rivals() -> None:
    """The shortcut over stand-ins against all of them."""
    recording, _ = simulate(scenario(**{"index-drift": 60.0}), 5)
    adjustment = adjust(recording, misalignment_construction())
    space = residual_space_of(adjustment)
    explanations = [best_explanation(space, name) for name in ("index-drift", "station-settling")]
    rivals = RivalCauses.from_explanations(
        residual_space_of(PlannedNetwork.from_adjustment(adjustment).make_adjustment()), *explanations
    )
    for candidate in list(pointing_candidates(PlannedNetwork.from_adjustment(adjustment)))[:3]:
        longer = residual_space_of(candidate.network.make_adjustment())
        evidence, whole = (
            rivals.expected_chi2_difference(longer),
            RivalCauses.from_explanations(longer, *explanations).present_chi2_difference,
        )
        assert evidence >= rivals.present_chi2_difference - 1e-6
        assert evidence == pytest.approx(whole, rel=0.02, abs=0.1)
