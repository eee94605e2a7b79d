"""Simulated test of proposed measurements that should separate the explanations of a diagnosis."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.common import Options, Row, RunRecord, show_table
from ltsim.adjustment import adjust
from ltsim.adjustment.remedies.candidates import CandidateMeasurement
from ltsim.adjustment.remedies.next_measurement import rank_measurements_between
from ltsim.core.parallel import run_parallel
from ltsim.core.randomness import random_stream
from ltsim.core.units import MICROMETRE
from ltsim.diagnosis.detectability import explanations_of_ambiguous_finding
from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.model.construction import declared_construction, misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, sightings_at_state
from ltsim.recordings import Recording
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.sections import EffectEntry
from ltsim.simulation.simulator import simulate
from ltsim.simulation.truth import Truth


def with_measurement(candidate: CandidateMeasurement, original: Recording, truth: Truth, seed: int) -> Recording:
    """Recording with the pointings of a proposal.

    The pointings are simulated with the true network, instrument and effect, and new noise.
    """
    recording, construction = candidate.network.recording, misalignment_construction()
    position, rotation = truth.station_positions, truth.station_rotations
    if candidate.added_setup_on_floor_plan is not None:
        place, yaw = candidate.added_setup_on_floor_plan
        position = np.vstack([position, place])
        rotation = np.concatenate([rotation, rotation_about_z(yaw)[None]])
    order = [truth.target_names.index(name) for name in recording.targets]
    values = np.array([[truth.instrument_values[name] for name in construction.parameter_names]])
    state = NetworkState(position, rotation, truth.target_points[order], values)
    readings = MeasurementModel(recording, construction).predict(state)
    for applied in truth.applied_effects:
        readings = readings + applied.effect.reading_change(
            sightings_at_state(recording, state), applied.parameter_values
        )
    noise = random_stream(seed, "added").normal(size=readings.shape) * recording.reading_sigmas()
    added = np.arange(len(recording)) >= len(original)
    return recording.with_readings(np.where(added[:, None], readings + noise, recording.readings))


def report_row(diagnosis: Diagnosis, effect: str, stations: Sequence[str]) -> Row:
    """Report of a diagnosis, and True if effect and stations are correct."""
    if not diagnosis.findings:
        return {"named": diagnosis.verdict, "probability": 0.0, "not_excluded": "", "right": False}
    first = diagnosis.findings[0]
    return {
        "named": f"{first.effect} {' '.join(first.where.stations)}".strip(),
        "probability": round(first.evidence.probability, 3),
        "not_excluded": " ".join(other.effect for other in first.equivalents),
        "right": first.effect == effect and tuple(first.where.stations) == tuple(stations),
    }


def recording_of_case(scenario_name: str, case: dict[str, Any], seed: int) -> tuple[Recording, Truth]:
    """Recording of a case, with its truth.

    The case is an effect of the simulation, or an error that is added to the readings of one target.
    """
    scenario = load_scenario(scenario_name)
    if "values" in case:
        places = {key: tuple(case.get(key, ())) for key in ("stations", "targets")}
        entry = EffectEntry(name=case["name"], **places, values=case["values"], shape=case.get("shape", {}))
        return simulate(scenario.model_copy(update={"effects": (entry,)}), seed)
    recording, truth = simulate(scenario, seed)
    station, target = recording.stations.index(case["stations"][0]), recording.targets.index(case["targets"][0])
    readings = recording.readings.copy()
    readings[(recording.station == station) & (recording.target == target), 0] += case["range_um"] * MICROMETRE
    return recording.with_readings(readings), truth


def examined_recording(scenario_name: str, case: dict[str, Any], seed: int, number: int) -> Row:
    """Row of one recording: first diagnosis, proposed measurement, diagnosis with this measurement."""
    recording, truth = recording_of_case(scenario_name, case, seed + 1000 * number)
    first = diagnose(recording, seed=seed)
    row: Row = {"true": case["name"], "recording": number}
    row |= {f"before_{key}": value for key, value in report_row(first, case["name"], case["stations"]).items()}
    between, context = explanations_of_ambiguous_finding(first)
    if not between:
        return row | {"between": "", "proposal": ""}
    adjustment = adjust(recording, declared_construction(recording))
    adjustment.solution.require_success()
    proposals = rank_measurements_between(adjustment, between, context)
    best = proposals.proposals[0]
    second = diagnose(with_measurement(best.candidate, recording, truth, seed + number), seed=seed)
    row |= {
        "between": " ".join(between),
        "proposal": best.candidate.instruction,
        "minutes": round(best.candidate.duration / 60, 1),
        "evidence_before": " ".join(f"{value:.1f}" for value in proposals.present_chi2_differences.values()),
        "evidence_after": " ".join(f"{value:.1f}" for value in best.expected_chi2_differences.values()),
        "separated_explanations": " ".join(best.distinguished_explanations),
    }
    return row | {f"after_{key}": value for key, value in report_row(second, case["name"], case["stations"]).items()}


def run(options: Options) -> RunRecord:
    """Diagnose all recordings of all cases before and after the proposed measurement."""
    config = options.config
    count = options.trials or config["recordings"]
    tasks = [(config["scenario"], case, config["seed"], number) for case in config["cases"] for number in range(count)]
    rows = list(run_parallel(examined_recording, tasks, options.jobs))
    show_table(options.out / "cases.csv", rows)
    return RunRecord(config["seed"], count)
