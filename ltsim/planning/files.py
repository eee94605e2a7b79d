"""A plan as files: plan.json for programs, tables for people, a scenario to simulate it with."""

from pathlib import Path
from typing import Any

import numpy as np

from ltsim.adjustment.remedies.detectability import Detectability, MinimalSize
from ltsim.adjustment.remedies.next_measurement import NextMeasurement
from ltsim.core.errors import SetupError
from ltsim.core.results import Table
from ltsim.core.units import DEGREE, FACTOR, MICROMETRE, MILLIMETRE
from ltsim.planning import tables
from ltsim.planning.information import ExpectedErrors
from ltsim.planning.loading import load_plan
from ltsim.planning.planner import LayoutEvaluation, PlannedNetwork, TradeoffPoint
from ltsim.planning.reasons import fewest, reasons
from ltsim.planning.result import NextFile, PlanResult
from ltsim.planning.schema import in_millimetres
from ltsim.planning.spec import PlanFile
from ltsim.planning.survey import Survey
from ltsim.planning.tolerances import keeps
from ltsim.recordings.result_file import SourceEntry, read_result
from ltsim.simulation.scenario import Scenario, load_scenario
from ltsim.simulation.sections import PlannedStation, PlannedTarget
from ltsim.simulation.workshop import bodies_of

SCENARIO = "scenario.toml"
"""The hall with the plan's stations, in the plan's folder."""
PLAN = "plan.toml"
"""Plan file that the board saves in the folder of a plan."""


def plan_file(plan: PlannedNetwork, report: Detectability | None = None) -> PlanResult:
    """The content of `plan.json`."""
    sentences, few, check, judged = reasons(plan), fewest(plan), plan.check, plan.verdict
    content: dict[str, Any] = {
        "title": plan.file.title or plan.scenario.title,
        "summary": sentences[0],
        "reasons": sentences[1:],
        "frame": "the workshop's: its corner is the origin, z is up; yaw is the direction of azimuth zero, "
        "counter-clockwise from x",
        **_layout(plan.chosen, plan),
        "reference": None if plan.reference is None else _layout(plan.reference),
        "fewest_stations": None if few is None else _option(few),
        "tradeoff": [_option(option) for option in plan.options],
        "reflector_changes": plan.changes.reported,
        "changes_tried": plan.changes.summary,
        "starts": plan.spread,
        "bodies": [body.words for body in bodies_of(plan.scenario)],
        "reached": None if judged is None else judged.reached,
        "tolerances_met": None if check is None else check.good,
        "losses": [{**vars(loss), "met": loss.good} for loss in plan.losses],
        "settings": plan.file.model_dump(mode="json"),
        "seed": plan.file.search.seed,
    }
    if report is not None:
        content["detectable"] = [_detectable(row) for row in report.table()]
        content["confusable"] = [{"effect": a, "taken_for": b, "share": share} for a, b, share in report.confusable()]
        content["silent"] = report.silent
    return PlanResult.model_validate(content)


def _layout(layout: LayoutEvaluation, plan: PlannedNetwork | None = None) -> dict[str, Any]:
    """The keys of a `LayoutEntry`; those of a plan's own layout hold its tolerances."""
    information, survey = layout.information, layout.survey
    return {
        "broken_rules": [rule.words for rule in layout.broken],
        **_work(survey),
        "quality": layout.qualities,
        "stations": _stations(layout),
        "reflectors": _reflectors(layout, plan),
        "parameters": information.parameters(),
        "undetermined": [
            {"combination": d.coefficients(information.construction.names), "gain": d.gain, "cure": cure}
            for d, cure in zip(information.undetermined, information.cures(), strict=True)
        ],
        "expected_improvement": None if layout.expected is None else _expected(layout.expected),
        "blocked_sights": layout.table.lost(survey.station_names, survey.target_names),
    }


def _expected(e: ExpectedErrors) -> dict[str, Any]:
    criteria = {
        "distance": (e.distance_before, e.distance_after, e.distance_improvement),
        "coordinate": (e.coordinate_before, e.coordinate_after, e.coordinate_improvement),
    }
    return {
        name: {
            "before_um": before[0] / MICROMETRE,
            "after_um": after[0] / MICROMETRE,
            "improvement_percent": percent[0],
        }
        for name, (before, after, percent) in criteria.items()
    }


def _places(survey: Survey) -> list[dict[str, Any]]:
    """The stations of a survey as a `StationEntry` begins."""
    return [
        {"name": name, "position_mm": in_millimetres(place), "yaw_deg": _degrees(yaw)}
        for name, place, yaw in zip(survey.station_names, survey.position, survey.yaw, strict=True)
    ]


def _stations(layout: LayoutEvaluation) -> list[dict[str, Any]]:
    sigma = np.sqrt(np.einsum("sii->si", layout.information.pose_covariance[:, :3, :3])) / MICROMETRE
    counts = layout.survey.visible.sum(axis=1).tolist()
    return [
        {**place, "sigma_position_um": np.round(station_sigma, 2).tolist(), "visible_reflectors": count}
        for place, station_sigma, count in zip(_places(layout.survey), sigma, counts, strict=True)
    ]


def _reflectors(layout: LayoutEvaluation, plan: PlannedNetwork | None) -> list[dict[str, Any]]:
    survey, information = layout.survey, layout.information
    expanded = 2.0 * np.sqrt(np.einsum("tii->ti", information.target_covariance)) / MICROMETRE
    rows: list[dict[str, Any]] = []
    for t, name in enumerate(survey.target_names):
        rows.append(
            {
                "name": name,
                "position_mm": in_millimetres(survey.points[t], 3),
                "sigma_um": round(float(information.target_sigma[t]) / MICROMETRE, 2),
                "U_um": np.round(expanded[t], 2).tolist(),
                "stations_seeing": int(survey.visible[:, t].sum()),
                "visible_from": [survey.station_names[s] for s in np.flatnonzero(survey.visible[:, t])],
            }
        )
        if plan is not None and plan.check is not None and name in plan.check.radius:
            rows[-1]["within_mm"] = plan.check.radius[name] / MILLIMETRE
            rows[-1]["tolerance_mm"] = plan.demands.tolerance[name] / MILLIMETRE
            rows[-1]["used"] = plan.check.used(name)
            rows[-1]["met"] = keeps(plan.check.used(name))
    return rows


def _work(survey: Survey) -> dict[str, Any]:
    return {
        "faces": len(survey.faces),
        "repeats": survey.repeats,
        "pointings": survey.pointings,
        "hours": round(survey.seconds / 3600, 3),
    }


def _option(option: TradeoffPoint) -> dict[str, Any]:
    return {
        **_work(option.survey),
        "stations": len(option.survey.position),
        "value": option.value,
        "quality": option.qualities,
        "efficient": option.efficient,
        "layout": _places(option.survey),
    }


def _detectable(row: MinimalSize) -> dict[str, Any]:
    """A minimal detectable size in the unit that a person reads."""
    sizes = {"best": row.best, "typical": row.typical, "worst": row.worst, "plausible": row.prior_sigma}
    return {**vars(row), "worst_at": row.worst_place, **{key: size / FACTOR[row.unit] for key, size in sizes.items()}}


def planned_scenario(plan: PlannedNetwork) -> Scenario:
    """The scenario with the plan's stations, reflectors and way of working: what `ltsim simulate` takes."""
    return with_layout(plan.scenario, plan.chosen.survey, plan.file.title or plan.scenario.title)


def with_layout(scenario: Scenario, survey: Survey, title: str = "") -> Scenario:
    """A scenario with the stations, reflectors and way of working of a survey."""
    levelled = {name for name, station in scenario.stations.items() if station.levelled}
    stations = {
        place["name"]: PlannedStation(
            position_mm=place["position_mm"], yaw_deg=place["yaw_deg"], levelled=place["name"] in levelled
        )
        for place in _places(survey)
    }
    fixed = set(scenario.gauge.targets) if scenario.gauge else set()
    targets = {
        name: scenario.targets.get(name) or PlannedTarget(position_mm=in_millimetres(place, 3))
        for name, place in zip(survey.target_names, survey.points, strict=True)
        if name not in fixed
    }
    way = {
        "faces": len(survey.faces),
        "repeats": survey.repeats,
        "seconds_per_pointing": survey.seconds_per_pointing,
        "minutes_per_move": survey.seconds_per_move / 60.0,
    }
    work = scenario.work.model_copy(update=way | {"stations": None})
    return scenario.model_copy(
        update={"title": title or scenario.title, "stations": stations, "targets": targets, "work": work}
    )


def with_cad_copied(scenario: Scenario) -> tuple[Scenario, dict[str, bytes]]:
    """The scenario with its CAD files named from its own folder, and these files by name; raises SetupError."""
    names: dict[str, str] = {}
    contents: dict[str, bytes] = {}
    for path in dict.fromkeys(entry.file for entry in scenario.workshop.obstacles if entry.file is not None):
        file_name = Path(path).name
        names[path] = file_name if file_name not in contents else f"{len(contents) + 1}-{file_name}"
        try:
            contents[names[path]] = Path(path).read_bytes()
        except OSError as problem:
            raise SetupError(f"{path}: cannot be read ({problem.strerror})") from None
    obstacles = tuple(
        entry if entry.file is None else entry.model_copy(update={"file": names[entry.file]})
        for entry in scenario.workshop.obstacles
    )
    room = scenario.workshop.model_copy(update={"obstacles": obstacles})
    return scenario.model_copy(update={"workshop": room}), contents


def opened(source: str | Path) -> tuple[PlanFile, Scenario]:
    """A plan and its scenario: a plan file, a scenario, a plan's folder with its stations, or what the board saved."""
    folder = Path(source)
    if (folder / PLAN).is_file():
        return load_plan(folder / PLAN)
    if not folder.is_dir():
        return load_plan(source)
    file = PlanFile.model_validate(read_result(folder, PlanResult).settings)
    return file, load_scenario(folder / SCENARIO)


def _degrees(angle: float) -> float:
    return round(float(angle) / DEGREE % 360, 2)


def next_file(made: NextMeasurement, summary: str = "", source: SourceEntry | None = None) -> NextFile:
    """The content of `next.json`: proposals of further measurements after a recording."""
    content = {
        "recording": source,
        "diagnosis": summary,
        "between": list(made.between),
        "evidence_now": made.evidence_now,
        "advice": made.advice,
        "proposals": [
            {
                **vars(p),
                "do": p.remedy.words,
                "kind": p.remedy.kind,
                "minutes": round(p.remedy.seconds / 60, 2),
                "distinguishes": p.distinguished,
                "decides": p.decides,
                "position_mm": in_millimetres(there[0]) if (there := p.remedy.set_up) else None,
                "yaw_deg": _degrees(there[1]) if there else None,
            }
            for p in made.proposals
        ],
    }
    return NextFile.model_validate(content)


def next_csv(content: NextFile) -> str:
    """The content of `next.csv`."""
    return tables.NEXT.filled({**vars(p), "distinguishes": " ".join(p.distinguishes)} for p in content.proposals).csv()


def visibility_table(layout: LayoutEvaluation) -> Table:
    """`visibility.csv`: every pair of a station and a target."""
    words, table, survey = layout.table.words(), layout.table, layout.survey
    return tables.VISIBILITY.filled(
        [
            station, target, "no" if words[s][t] else "yes", words[s][t], round(float(table.range_[s, t]) * 1e3, 1),
            round(float(table.elevation[s, t]) / DEGREE, 2), round(float(table.incidence[s, t]) / DEGREE, 2),
        ]
        for s, station in enumerate(survey.station_names)
        for t, target in enumerate(survey.target_names)
    )  # fmt: skip


def work_table(plan: PlannedNetwork) -> Table:
    """`work-order.csv`: every pointing with the readings of a perfect instrument at its place."""
    recording = plan.chosen.survey.recording(plan.chosen.information.construction)
    return tables.WORK.filled(
        [
            i + 1, recording.stations[recording.station[i]], recording.targets[recording.target[i]],
            int(recording.face[i]), int(recording.repeat[i]), round(float(recording.time[i]) / 60.0, 2),
            round(float(reading[1]) / DEGREE % 360, 3), round(float(reading[2]) / DEGREE, 3),
            round(float(reading[0]) / MILLIMETRE, 1),
        ]
        for i, reading in enumerate(recording.readings)
    )  # fmt: skip
