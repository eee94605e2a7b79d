"""Propagation and Monte Carlo on a network, budgets, verdicts, published distributions, and what files refuse."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from ltsim.adjustment import Adjustment, adjust
from ltsim.cli.main import run
from ltsim.core.errors import InputError, ModelError
from ltsim.core.randomness import random_stream
from ltsim.measurands.evaluation import TaskEvaluation, evaluate_tasks
from ltsim.measurands.inputs import PRIOR_SOURCE_NAME, REFERENCE_LENGTHS_SOURCE_NAME, TaskInputs, UncertaintySource
from ltsim.measurands.measurands import Measurand
from ltsim.measurands.propagation import propagate, run_monte_carlo, shortest_intervals, thermal_expansion_of_part
from ltsim.measurands.spec import DecisionRule, MonteCarloSettings, Task, Tasks, ToleranceLimits, validate_tasks
from ltsim.measurands.uncertainty import Uncertainty, evaluate_conformity, normalised_error, normalised_errors_of_files
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings import write
from ltsim.recordings.recording import OBSERVABLE_NAMES_WITH_UNIT
from ltsim.recordings.result_file import read_result
from ltsim.reports.sections import result_section
from ltsim.simulation.verbs import simulate
from tests.families import family
from tests.networks import drawn, network

TASKS: dict[str, Any] = {
    "format": "ltsim-tasks/1",
    "source": "recording",
    "task": [
        {"name": "length", "kind": "distance", "targets": ["T01", "T12"]},
        {"name": "bore", "kind": "circle", "targets": ["T01", "T04", "T05", "T08"]},
        {"name": "wall", "kind": "plane", "targets": ["T01", "T02", "T09", "T12", "T17", "T20"]},
    ],
    "type_b": [
        {"effect": "station-weather", "draw_shared_by": "station", "distribution": "rectangular"},
        {"effect": "smr-centring", "draw_shared_by": "target", "sizes": {"vertex-axial": 5.0}},
    ],
    "monte_carlo": {"digits": 1, "max_trials": 20_000},
}


def tasks(**changes: Any) -> Tasks:
    return validate_tasks({**TASKS, **changes}, "tasks.toml")


@cache
def evaluated() -> TaskEvaluation:
    recording, _ = network(faces=2, seed=3, values=drawn(misalignment_construction(), 7))
    return evaluate_tasks(recording, tasks())


def test_the_results_and_trials_of_an_evaluation_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand planes took a gigabyte; without the limit of trials, so do 200 results with 5,000,000."""
    recording, _ = network(faces=2, seed=3, values=drawn(misalignment_construction(), 7))
    lengths = [{"name": f"length {i}", "kind": "distance", "targets": ["T01", "T12"]} for i in range(1_001)]
    with pytest.raises(ModelError, match="the tasks have 1001 results, expected at most 1000: divide them"):
        evaluate_tasks(recording, tasks(task=lengths))
    monkeypatch.setattr("ltsim.measurands.propagation.MAX_UNCERTAINTY_TRIALS_TIMES_RESULTS", 20_000)
    few = evaluate_tasks(recording, tasks(task=lengths[:2], monte_carlo={"digits": 2, "max_trials": 5_000_000}))
    assert few.monte_carlo_uncertainty.n_trials == 10_000
    assert any("divide the tasks among several task files" in warning for warning in few.warnings)
    with pytest.raises(InputError, match=r"type_b .*at most 200"):
        tasks(type_b=[{"effect": "range-step"}] * 201)


def test_observed_sources_add_up_to_the_covariance_of_the_adjustment() -> None:
    inputs = evaluated().inputs
    evaluation_types = {source.name: source.evaluation_type for source in inputs.sources}
    assert evaluation_types["distance readings"] == "A" and evaluation_types[PRIOR_SOURCE_NAME] == "B"
    in_adjustment = {name for name, kind in evaluation_types.items() if kind == "A"} | {
        PRIOR_SOURCE_NAME,
        REFERENCE_LENGTHS_SOURCE_NAME,
    }
    sum_of_sources = np.sum([source.covariance for source in inputs.sources if source.name in in_adjustment], axis=0)
    for i, name in enumerate(inputs.target_names):
        block = inputs.network_or_coordinates.target_covariances[
            inputs.network_or_coordinates.recording.targets.index(name)
        ]
        assert np.allclose(sum_of_sources[3 * i : 3 * i + 3, 3 * i : 3 * i + 3], block, atol=1e-4 * block.max())


def test_errors_of_a_given_size_are_in_the_budget() -> None:
    """Of a reflector in fixed nests, and of readings together: all sources add up to the covariance."""
    recording, _ = simulate("paper-workshop", seed=2)
    shared = 3e-3 * np.sin(np.arange(len(recording)))
    recording = recording.replace(
        covariates={**recording.covariates, f"shared_tripod_{OBSERVABLE_NAMES_WITH_UNIT[0]}": shared}
    )
    inputs = evaluate_tasks(recording, tasks(type_b=[])).inputs
    names = {"range error of a reflector as a function of the angle of incidence", "error that readings share"}
    type_b_names = {source.name for source in inputs.sources if source.evaluation_type == "B"}
    assert type_b_names == names | {PRIOR_SOURCE_NAME, REFERENCE_LENGTHS_SOURCE_NAME}
    for i, name in enumerate(inputs.target_names):
        block = inputs.network_or_coordinates.target_covariances[
            inputs.network_or_coordinates.recording.targets.index(name)
        ]
        point_block = inputs.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        assert np.allclose(point_block, block, atol=5e-4 * block.max())  # the rows of the datum are no source
    largest = max(np.trace(source.covariance) for source in inputs.sources if source.name in names)
    assert largest > 0.05 * np.trace(inputs.covariance)


def test_a_datum_of_targets_reaches_the_points() -> None:
    recording, _ = network(seed=3)
    names = ("T01", "T05", "T12", "T20")
    inputs = TaskInputs.from_recording(recording, tasks(datum=names, type_b=[]))
    expected = adjust(recording, misalignment_construction(), datum_names=names).target_covariances
    for i, name in enumerate(inputs.target_names):
        block = inputs.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        assert np.allclose(block, expected[recording.targets.index(name)], atol=1e-4 * block.max())


def test_budgets_add_up_and_both_ways_agree() -> None:
    evaluation = evaluated()
    total = np.sum(list(evaluation.linear_uncertainty.variance_by_source.values()), axis=0)
    assert np.allclose(total, np.diag(evaluation.linear_uncertainty.covariance), rtol=1e-9)
    regular = [output.unit == "mm" and "ness" not in output.name for _, output in evaluation.outputs]
    assert np.allclose(
        (
            evaluation.monte_carlo_uncertainty.standard_uncertainties
            / evaluation.linear_uncertainty.standard_uncertainties
        )[regular],
        1.0,
        atol=0.03,
    )
    assert evaluation.nonlinearity_ratios[regular].max() < 0.05


def test_failure_of_linear_propagation_is_reported() -> None:
    """The points of the bore lie on a circle but for their noise: roundness cannot be negative."""
    evaluation = evaluated()
    roundness = [output.name for _, output in evaluation.outputs].index("roundness")
    assert not evaluation.intervals_agree[roundness]
    assert any("bore, roundness" in sentence for sentence in evaluation.warnings)


@pytest.mark.long
def test_spread_of_simulated_tasks_is_what_was_predicted_and_falls_by_the_budget() -> None:
    """Readings are drawn with noise and with the type B effects, each adjusted anew, exactly."""
    recording, _ = network(seed=None, values=drawn(misalignment_construction(), 7))
    with_weather = tasks(task=TASKS["task"][:1], type_b=TASKS["type_b"][:1])
    inputs = TaskInputs.from_recording(recording, with_weather)
    measurand = Measurand.from_task(with_weather.task[0], inputs.target_names, inputs.points)
    predicted = propagate(inputs, [measurand], thermal_expansion_of_part(None))
    noise = sum(share[0] for name, share in predicted.variance_by_source.items() if name.endswith("readings"))
    expected = {False: np.sqrt(noise), True: np.sqrt(noise + predicted.variance_by_source["station-weather"][0])}
    lengths = {True: [], False: []}  # type: dict[bool, list[float]]
    from ltsim.physics.effects import find_effect

    weather = find_effect("station-weather")()
    design = (
        weather.design(inputs.network_or_coordinates.sightings)[:, :, 0]
        * weather.parameters[0].prior_sigma
        / np.sqrt(3)
    )
    for i in range(60):
        rng = random_stream(5, "spread", i)
        error = rng.standard_normal(recording.readings.shape) * recording.reading_sigmas()
        shift = design * rng.uniform(-np.sqrt(3), np.sqrt(3), len(recording.stations))[recording.station][:, None]
        for weather_too in (True, False):
            again = recording.with_readings(recording.readings + error + (shift if weather_too else 0.0))
            points = adjust(
                again, misalignment_construction(), start_state=inputs.network_or_coordinates.state
            ).state.target_points
            at = [recording.targets.index(name) for name in ("T01", "T12")]
            lengths[weather_too].append(float(np.linalg.norm(points[at[1]] - points[at[0]])))
    # The standard deviation of 60 draws is known to 9 %; three of that.
    for weather_too, component in lengths.items():
        assert np.std(component, ddof=1) == pytest.approx(expected[weather_too], rel=0.28)


def test_the_tip_of_a_rod_is_worth_what_its_lever_says() -> None:
    """A tip b past the second of two balls d apart: (1 + b/d) of the second's error less b/d of the first's across."""
    task = Task(name="tip", kind="rod", targets=("A", "B"), tip_distance_mm=300.0)
    points = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]])
    tip = Measurand.from_task(task, ("A", "B"), points)
    assert np.allclose(tip.values(points), [0.9, 0.0, 0.0])
    assert np.allclose(tip.point_derivatives(points)[1], [0, -0.5, 0, 0, 1.5, 0], atol=1e-6)
    assert np.allclose(tip.point_derivatives(points)[0], [0, 0, 0, 1, 0, 0], atol=1e-6)


def test_long_ranges_have_the_air_in_their_budget() -> None:
    """Ten times the network: 60 m. What the file states itself is not counted twice; short ranges have none of it."""
    near, _ = network(seed=3)
    readings = near.readings * [10.0, 1.0, 1.0]
    setup = near.setup.model_copy(update={"gauge": None})
    far = near.replace(readings=readings, setup=setup)
    names = {"temperature of the air", "gradient of the air", "turbulence"}
    length = tasks(task=TASKS["task"][:1], type_b=[])
    assert not names & {source.name for source in TaskInputs.from_recording(near, length).sources}
    evaluation = evaluate_tasks(far, length)
    assert names <= set(evaluation.linear_uncertainty.variance_by_source)
    assert "0.5 K along the beams" in evaluation.warnings[0]
    along = 0.5 * 0.95e-6 * evaluation.linear_uncertainty.result_values[0]
    assert (
        0.3 * along
        < np.sqrt(evaluation.linear_uncertainty.variance_by_source["temperature of the air"][0])
        < 3.0 * along
    )
    inputs = TaskInputs.from_recording(far, tasks(task=TASKS["task"][:1], type_b=TASKS["type_b"][:1]))
    assert {"gradient of the air", "turbulence"} == names & {source.name for source in inputs.sources}
    calm = {"temperature_k": 0.0, "gradient_k_per_m": 0.0, "turbulence_um2_per_m3": 0.0}
    assert not names & {source.name for source in TaskInputs.from_recording(far, tasks(type_b=[], air=calm)).sources}


def test_published_distributions() -> None:
    """JCGM 101:2008, 9.2.3 and 9.2.4: sums of four rectangular variates of unit, and of unequal, deviation."""
    task = Task(name="sum", kind="point", targets=("P",))
    measurand = Measurand(task, np.array([0]))
    for sizes, sigma, half in (((1.0, 1.0, 1.0, 1.0), 2.00, 3.88), ((1.0, 1.0, 1.0, 10.0), 10.15, 17.0)):
        response = np.zeros((3, 4))
        response[0] = sizes
        source = UncertaintySource("inputs", "B", response, "rectangular")
        inputs = TaskInputs(cast(Adjustment, None), ("P",), np.zeros((1, 3)), np.zeros((0, 3)), (source,))
        linear = propagate(inputs, [measurand], thermal_expansion_of_part(None))
        monte_carlo = run_monte_carlo(
            inputs, [measurand], thermal_expansion_of_part(None), MonteCarloSettings(), linear
        )
        assert monte_carlo.standard_uncertainties[0] == pytest.approx(sigma, rel=1e-3)
        assert monte_carlo.symmetric_intervals[0] == pytest.approx([-half, half], abs=0.02)
        assert monte_carlo.n_trials == 20_000, "the sum is linear: its distribution is known without drawing"
        expanded = {2.00: 3.92, 10.15: 19.9}[sigma]
        assert linear.expanded_uncertainty(0.95)[0] == pytest.approx(expanded, abs=0.05)
    assert not monte_carlo.intervals_agree(linear, 0.95)[0]


@pytest.mark.parametrize("digits", family([1, 2]))
def test_a_linear_task_is_never_reported_as_nonlinear_because_of_trial_noise(digits: int) -> None:
    """JCGM 101:2008, 8.2: compared with delta only when the trials' own error is a fifth of it; 100 seeds, no alarm."""
    measurand = Measurand(Task(name="place", kind="point", targets=("P",)), np.array([0]))
    response = random_stream(3, "response").normal(size=(3, 5))
    inputs = TaskInputs(
        cast(Adjustment, None), ("P",), np.ones((1, 3)), np.zeros((0, 3)), (UncertaintySource("in", "A", response),)
    )
    linear = propagate(inputs, [measurand], thermal_expansion_of_part(None))
    for seed in range(100):
        monte_carlo = run_monte_carlo(
            inputs, [measurand], thermal_expansion_of_part(None), MonteCarloSettings(digits=digits, seed=seed), linear
        )
        assert monte_carlo.is_stable.all(), seed
        assert np.all(5 * monte_carlo.numerical_errors <= monte_carlo.numerical_tolerances), seed
        assert monte_carlo.intervals_agree(linear, 0.95).all(), seed


def test_a_nonlinear_task_is_reported_and_its_interval_is_the_true_interval() -> None:
    """The length of a vector whose place is known to a third of it: noncentral chi, found without bias."""
    points = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    measurand = Measurand.from_task(Task(name="length", kind="distance", targets=("A", "B")), ("A", "B"), points)
    response = np.vstack([np.zeros((3, 3)), np.eye(3)])
    inputs = TaskInputs(
        cast(Adjustment, None), ("A", "B"), points, np.zeros((0, 6)), (UncertaintySource("in", "A", response),)
    )
    linear = propagate(inputs, [measurand], thermal_expansion_of_part(None))
    monte_carlo = run_monte_carlo(inputs, [measurand], thermal_expansion_of_part(None), MonteCarloSettings(), linear)
    assert not monte_carlo.intervals_agree(linear, 0.95)[0]
    expected = np.sqrt(stats.ncx2.ppf([0.025, 0.975], 3, 9.0))
    assert monte_carlo.symmetric_intervals[0] == pytest.approx(expected, abs=2 * monte_carlo.numerical_errors[0])


def test_the_shortest_interval_of_a_skew_distribution_is_shorter() -> None:
    values = random_stream(1, "skew").exponential(size=(200_000, 1))
    shortest = shortest_intervals(values, 0.95)
    assert shortest[0] == pytest.approx([0.0, -np.log(0.05)], abs=0.05)


def test_conformity() -> None:
    limits = ToleranceLimits(lower=0.0, upper=10.0)
    at_limit = evaluate_conformity(10.0, 1.0, limits, DecisionRule(rule="simple"))
    assert at_limit.conformity_probability == pytest.approx(0.5, abs=1e-6)
    assert at_limit.judgement == "accepted"
    guarded = evaluate_conformity(9.0, 1.0, limits, DecisionRule(consumer_risk=0.05))
    assert guarded.guard_band == pytest.approx(1.645, abs=1e-3)
    assert guarded.judgement == "undecided"
    inside = evaluate_conformity(10.0 - 1.645, 1.0, limits, DecisionRule(consumer_risk=0.05))
    assert inside.judgement == "accepted"
    assert inside.wrong_decision_probability == pytest.approx(0.05, abs=1e-3)
    assert evaluate_conformity(12.0, 1.0, limits, DecisionRule()).judgement == "rejected"


def test_normalised_error() -> None:
    assert normalised_error(10.0, 3.0, 5.0, 4.0) == pytest.approx(1.0)
    assert normalised_error(1.0, 0.0, 1.0, 0.0) == 0.0


def test_the_part_is_brought_to_its_reference_temperature() -> None:
    recording, _ = network(seed=3)
    plain = evaluate_tasks(recording, tasks(type_b=[]))
    growth = {"expansion_per_k": 20e-6, "measured_c": 25.0, "sigma_expansion_per_k": 1e-6, "sigma_temperature_k": 0.5}
    grown = evaluate_tasks(recording, tasks(type_b=[], part_expansion=growth))
    length = plain.linear_uncertainty.result_values[0]
    assert grown.linear_uncertainty.result_values[0] == pytest.approx(length / (1 + 5 * 20e-6), rel=1e-12)
    assert grown.linear_uncertainty.variance_by_source["expansion of the part"][0] == pytest.approx(
        (length * 5e-6) ** 2, rel=1e-3
    )
    assert grown.linear_uncertainty.variance_by_source["temperature of the part"][0] == pytest.approx(
        (length * 1e-5) ** 2, rel=1e-3
    )


def test_results_against_themselves_differ_by_nothing() -> None:
    content = evaluated().to_result
    assert {value for _, value in normalised_errors_of_files(content, content)} == {0.0}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": [{"name": "a", "kind": "distance", "targets": ["T01"]}]}, "targets should be 2 names"),
        ({"task": [{"name": "a", "kind": "cone", "targets": ["T01"]}]}, "cone"),
        ({"type_b": [{"effect": "nonsense"}]}, "nonsense"),
        ({"type_b": [{"effect": "noise-level"}]}, "declare it as the instrument's noise"),
        ({"type_b": [{"effect": "station-weather", "stations": ["S9"]}]}, "S9"),
        ({"type_b": [{"effect": "station-weather", "sizes": {"x": 1.0}}]}, "x"),
        ({"task": [{"name": "a", "kind": "point", "targets": ["T99"]}]}, "T99"),
        ({"task": [{"name": "a", "kind": "point", "targets": ["T01"], "tolerances": {"q": {"upper": 1.0}}}]}, "q"),
        ({"task": [{"name": "a", "kind": "pose", "targets": ["T01"]}]}, "should contain the coordinates of T01"),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_sentence(change: dict[str, Any], message: str) -> None:
    recording, _ = network(seed=3)
    with pytest.raises((InputError, ModelError), match=message):
        evaluate_tasks(recording, tasks(**change))


def test_the_verb_writes_and_judges(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, _ = network(seed=3)
    write(recording, tmp_path / "recording")
    text = """format = "ltsim-tasks/1"
source = "recording"
[[task]]
name = "length"
kind = "distance"
targets = ["T01", "T12"]
tolerances.distance = { upper = 1.0 }
[monte_carlo]
digits = 1
"""
    (tmp_path / "tasks.toml").write_text(text)
    assert run(["uncertainty", str(tmp_path / "tasks.toml"), "--out", str(tmp_path / "out")]) == 1
    assert "rejected" in capsys.readouterr().out
    content = read_result(tmp_path / "out", Uncertainty)
    assert content.results[0].conformity is not None
    assert run(["report", str(tmp_path / "out"), "--quiet"]) == 0
    length = content.results[0].value
    undecided = text.replace("upper = 1.0", f"upper = {length:.6f}")
    (tmp_path / "tasks.toml").write_text(undecided)
    assert run(["uncertainty", str(tmp_path / "tasks.toml"), "--out", str(tmp_path / "out"), "--force"]) == 1
    assert "undecided" in capsys.readouterr().out
    assert result_section(read_result(tmp_path / "out", Uncertainty)).assessment == "caution"
    (tmp_path / "tasks.toml").write_text(text.replace('"recording"', '"nowhere"'))
    assert run(["uncertainty", str(tmp_path / "tasks.toml")]) == 2
    assert "neither a recording nor a scenario" in capsys.readouterr().err


@pytest.mark.parametrize(("kind", "near"), [("angl", "; did you mean angle?"), ("zzzz", "")])
def test_a_wrong_kind_lists_all_kinds_and_the_most_similar_kind(kind: str, near: str) -> None:
    with pytest.raises(InputError, match=r"it should be point, .*, pose, deviation") as refused:
        tasks(task=[{"name": "a", "kind": kind, "targets": ["T01", "T02", "T03"]}])
    assert str(refused.value).endswith(f"deviation{near}")
