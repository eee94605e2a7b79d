"""The columns of a campaign's rows: the settings of the cell beside the results, each with its unit in the file."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from ltsim.arrays import Floats
from ltsim.campaigns.calibrators import fitted_construction
from ltsim.campaigns.design import Factor
from ltsim.campaigns.engine import FAILED, STATUSES, Calibrated
from ltsim.campaigns.judge import Columns
from ltsim.campaigns.schema import OF_PARAMETER, column_of
from ltsim.campaigns.spec import Campaign
from ltsim.campaigns.truth import Block, Truth
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


def parameter_columns(construction: Construction, instruments: tuple[str, ...], values: Floats, prefix: str) -> Columns:
    """Parameters (I, p, B) [SI] as columns in display units: ``estimate:beam-tilt``, with ``@name`` of several."""
    names = construction.names_of(instruments)
    shown = (values / np.array([p.factor for p in construction.parameters])[:, None]).reshape(-1, values.shape[2])
    return {f"{prefix}:{name}": own for name, own in zip(names, shown, strict=True)}


def effect_columns(effects: Sequence[Effect], values: Floats, prefix: str) -> Columns:
    """Parameters (q, B) [SI] of effects in display units, with place and number: ``true:head-sag:sag S2``."""
    columns: Columns = {}
    rows = iter(values)
    for effect in effects:
        for parameter in effect.parameters:
            name = f"{prefix}:{effect.name}:{parameter.name}" + (f" {effect.place}" if effect.place else "")
            again = sum(known == name or known.startswith(f"{name} #") for known in columns)
            columns[f"{name} #{again + 1}" if again else name] = next(rows) / (
                1.0 if prefix == "z" else parameter.factor
            )
    return columns


def per_trial(sigma: Floats) -> Floats:
    """Standard deviations with a last index for trials."""
    return sigma[:, :, None] if sigma.ndim == 2 else sigma


def z_scores(truth: Truth, block: Block, found: Calibrated, construction: Construction) -> Columns:
    """(estimate - truth) / sigma of the parameters that the true instrument has under the same name."""
    names = truth.recording.instruments
    both = [name for name in construction.names if name in truth.construction.names]
    fitted = [construction.index(name) for name in both]
    true = [truth.construction.index(name) for name in both]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (found.values[:, fitted] - block.values[:, true]) / per_trial(found.sigma)[:, fitted]
    flat = np.array(construction.names_of(names)).reshape(len(names), construction.size)[:, fitted].ravel()
    return {f"z:{name}": own for name, own in zip(flat, z.reshape(len(flat), z.shape[2]), strict=True)}


def effect_z_scores(truth: Truth, block: Block, found: Calibrated, effects: Sequence[Effect]) -> Columns:
    """The same of fitted effects that are among the true ones."""
    if not effects:
        return {}
    both = [(law.effect, own) for law, own in zip(truth.effects, block.amounts, strict=True) if law.effect in effects]
    columns: Columns = {}
    parts = np.split(np.arange(len(found.extra)), np.cumsum([len(e.parameters) for e in effects])[:-1])
    for effect, rows in zip(effects, parts, strict=True):
        true = next((own for other, own in both if other == effect), None)
        if true is not None:
            z = (found.extra[rows] - true) / found.extra_sigma[rows]
            columns |= effect_columns([effect], z, "z")
    return columns


def rows_of_method(cell: int, method: str, parts: list[Columns]) -> pa.Table:
    """Columns as a table; numbers that people read are kept to seven digits, empty where a geometry has none."""
    names = dict.fromkeys(name for part in parts for name in part)
    merged = {
        name: np.concatenate([part[name] if name in part else np.full(len(part["trial"]), np.nan) for part in parts])
        for name in names
    }
    order = np.argsort(merged["trial"])
    merged = {name: values[order] for name, values in merged.items()}
    trial, status = merged.pop("trial"), merged.pop("status").astype(np.int64)
    count = len(trial)
    lost = status == STATUSES.index(FAILED)
    columns: dict[str, pa.Array] = {
        "cell": pa.array(np.full(count, cell), pa.int32()),
        "method": pa.array([method] * count, pa.string()),
        "trial": pa.array(trial, pa.int64()),
        "status": pa.array([STATUSES[s] for s in status], pa.string()),
    }
    for name, values in merged.items():
        empty = np.isnan(values) | (lost if name.startswith(("z:", "estimate:")) or "after" in name else False)
        columns[name] = pa.array(values.astype(np.float32), pa.float32(), mask=empty)
    return pa.table(columns)
