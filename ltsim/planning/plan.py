"""The result of `ltsim.plan`: the planned network as arrays, and its content with the declared tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

from ltsim.adjustment.remedies.detectability import detectability
from ltsim.core.results import Columns, Result, Table
from ltsim.physics.effects import CATALOGUE
from ltsim.planning.files import SCENARIO, plan_file, planned_scenario, visibility_table, with_cad_copied, work_table
from ltsim.planning.planner import PlannedNetwork
from ltsim.planning.result import PlanResult
from ltsim.recordings.result_file import write_result
from ltsim.simulation.scenario import scenario_to_toml


@dataclass(frozen=True, repr=False)
class Plan(PlannedNetwork, Result):
    """A plan: `content` is what `plan.json` holds, and every table of the plan is one of its."""

    @classmethod
    def of(cls, network: PlannedNetwork) -> Plan:
        """The plan of a network."""
        return cls(**{field.name: getattr(network, field.name) for field in fields(network)})

    @cached_property
    def content(self) -> PlanResult:
        """The content of `plan.json`."""
        return plan_file(self, detectability(self.chosen.information.adjustment, CATALOGUE))

    def _lines(self) -> list[str]:
        return self.content._lines()

    def _tables(self) -> Mapping[str, Callable[[], Table | Columns]]:
        return self.content._tables()


def write_plan(plan: Plan, folder: Path | None, pictures: Mapping[str, bytes] | None = None) -> PlanResult:
    """Write plan.json, the tables, scenario.toml and pictures, where a folder is given; the content of plan.json."""
    content = plan.content
    if folder is None:
        return content
    tables = [content.table(name) for name in content._tables()]
    tables += [visibility_table(plan.chosen), work_table(plan)]
    scenario, cad = with_cad_copied(planned_scenario(plan))
    texts = {table.file: table.csv() for table in tables} | {SCENARIO: scenario_to_toml(scenario)}
    return write_result(folder, content, {**texts, **cad, **(pictures or {})})
