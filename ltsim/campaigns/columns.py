"""The columns of a campaign's rows: the settings of the cell beside the results, each with its unit in the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa

from ltsim.campaigns.cell import fitted_construction
from ltsim.campaigns.design import Factor
from ltsim.campaigns.schema import OF_PARAMETER, column_of
from ltsim.campaigns.spec import Campaign
from ltsim.effects.effect import Effect
from ltsim.model.construction import Construction

TYPES = {"number": pa.float64(), "integer": pa.int64(), "boolean": pa.bool_()}
PER_INSTRUMENT, PER_PLACE = "@", " "
"""What follows a parameter's name where there are several instruments or places."""


def parameter_units(campaign: Campaign, true: Construction, effects: Sequence[Effect]) -> dict[str, str]:
    """Units of the parameters that rows may hold, by name; those of an effect begin with the effect's."""
    built = [fitted_construction(method) for method in campaign.methods]
    found = {p.name: p.unit for construction in (true, *built) for p in construction.parameters}
    return found | {f"{effect.name}:{p.name}": p.unit for effect in effects for p in effect.parameters}


def _metadata(name: str, parameters: Mapping[str, str]) -> dict[str, str]:
    """Unit and meaning of a column of the rows."""
    known = column_of(name)
    if known is None:
        return {"unit": "", "meaning": ""}
    own = name.partition(":")[2].partition(PER_INSTRUMENT)[0].partition(PER_PLACE)[0]
    unit = parameters.get(own, "") if known.unit == OF_PARAMETER else known.unit
    return {"unit": unit, "meaning": known.meaning}


def with_settings(
    table: pa.Table, factors: Sequence[Factor], levels: Mapping[str, Any], parameters: Mapping[str, str]
) -> pa.Table:
    """The rows of a cell with its settings behind the column `cell`, and units in the metadata of the columns."""
    columns = dict(zip(table.column_names, table.columns, strict=True))
    cell = {"cell": columns.pop("cell")}
    own = {f.name: pa.repeat(pa.scalar(levels[f.name], TYPES.get(f.kind, pa.string())), len(table)) for f in factors}
    said = {f.name: {"unit": f.unit, "keys": " ".join(f.keys)} for f in factors}
    whole = cell | own | columns
    fields = [
        pa.field(name, column.type, metadata=said.get(name) or _metadata(name, parameters))
        for name, column in whole.items()
    ]
    return pa.table(list(whole.values()), schema=pa.schema(fields))
