"""Reference of the files that commands write: keys and columns from the models and tables, and JSON Schemas."""

from pathlib import Path

from sphinx.application import Sphinx

from from_code.keys import about, json_place, markdown, sections, unit
from ltsim.core.results import Table
from ltsim.reports import schemas


def files() -> str:
    """Markdown with a section per file and the CSV tables in the same folder."""
    models = {model.FILE: model for model in schemas.RESULT_MODELS}
    lines: list[str] = []
    for file, model in models.items():
        lines += ["", f"## {file}", sections(model, json_place, "###")]
        for table in schemas.COMPANION_TABLES_BY_RESULT_FILE.get(file, ()):
            lines += _columns(table)
    return "\n".join(lines)


def _columns(table: Table) -> list[str]:
    said = about(table.description)
    lines = ["", f"### {table.file}", "", f"{said[0].upper()}{said[1:]}.", ""]
    rows = [[f"`{c.name}`", c.kind, unit(c.name), about(c.meaning)] for c in table.columns]
    return [*lines, *markdown(["column", "value", "unit", "meaning"], rows)]


def write_schemas(app: Sphinx, problem: Exception | None) -> None:
    """Write the JSON Schema of every file to the folder `schemas` of the built pages."""
    if problem is None:
        schemas.write_schemas(Path(app.outdir) / "schemas")
