"""Data models and tables of all files of ltsim; the reference page of the files is generated from them.

``python -m ltsim.reports.schemas DIR`` writes one JSON Schema (draft 2020-12) per file, and tables.json for the tables.
"""

import json
import sys
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from ltsim.acceptance.files import AcceptanceFile
from ltsim.acceptance.spec import AcceptanceSettings
from ltsim.adjustment.evaluation.bench import BENCH_TABLE, BenchFile
from ltsim.adjustment.evaluation.criteria import NOMINAL_TABLE, Criteria
from ltsim.adjustment.fieldcheck.result import Check
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.history import History
from ltsim.campaigns.recovery import Recovery
from ltsim.campaigns.schema import ROWS_TABLE, ManifestFile, summary_table
from ltsim.campaigns.spec import CampaignFile
from ltsim.core.results import Table
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.measurands.comparison import Comparison
from ltsim.measurands.spec import Tasks
from ltsim.measurands.uncertainty import Uncertainty
from ltsim.planning.proposals import NextMeasurement
from ltsim.planning.result import Plan
from ltsim.planning.spec import PlanFile
from ltsim.recordings.files import write_texts
from ltsim.recordings.result_file import ResultFile
from ltsim.recordings.setup import Setup
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.truth import Truth

RESULT_MODELS: tuple[type[ResultFile], ...] = (
    Calibration,
    History,
    Criteria,
    Diagnosis,
    Plan,
    NextMeasurement,
    ManifestFile,
    Recovery,
    Uncertainty,
    Comparison,
    Check,
    AcceptanceFile,
    BenchFile,
    Truth,
)
"""Data models of the result files that commands write."""

MODEL_BY_FILE_NAME: dict[str, type[BaseModel]] = {
    **{model.FILE: model for model in RESULT_MODELS},
    "setup.toml": Setup,
    "scenario.toml": Scenario,
    "campaign.toml": CampaignFile,
    "plan.toml": PlanFile,
    "tasks.toml": Tasks,
    "acceptance.toml": AcceptanceSettings,
}
"""Data models of all files, including those that users write, by name of the file."""

COMPANION_TABLES_BY_RESULT_FILE: dict[str, tuple[Table, ...]] = {
    **{model.FILE: tuple(model.COMPANION_TABLES.values()) for model in RESULT_MODELS},
    BenchFile.FILE: (BENCH_TABLE,),
    Truth.FILE: (NOMINAL_TABLE,),
    ManifestFile.FILE: (summary_table({"FACTOR": "number"}), ROWS_TABLE),
}
"""Tables that commands write or read together with a result file, by the name of the result file."""


def json_schemas() -> dict[str, dict[str, Any]]:
    """JSON Schema of every file, by the name of the file."""
    return {name: model.model_json_schema(by_alias=True) for name, model in MODEL_BY_FILE_NAME.items()}


def companion_table_descriptions() -> dict[str, list[dict[str, Any]]]:
    """Descriptions of the tables written with each result file: name, subject, columns with their meaning."""
    return {
        file: [
            {
                "file": table.file,
                "about": table.description,
                "columns": [{"name": c.name, "kind": c.kind, "about": c.meaning} for c in table.columns],
            }
            for table in companions
        ]
        for file, companions in COMPANION_TABLES_BY_RESULT_FILE.items()
    }


def write_schemas(folder: Path) -> None:
    """Write the schema of every file, and the columns of the tables, into a folder."""
    schema_by_file = {f"{name}.schema.json": content for name, content in json_schemas().items()}
    write_texts(folder, {name: json.dumps(content, indent=1) + "\n" for name, content in schema_by_file.items()})
    write_texts(folder, {"tables.json": json.dumps(companion_table_descriptions(), indent=1) + "\n"})


if __name__ == "__main__":
    write_schemas(Path(sys.argv[1] if len(sys.argv) > 1 else "schemas"))
