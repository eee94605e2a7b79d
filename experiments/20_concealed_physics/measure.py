"""Model of an answer, and the fraction of the true signal that it explains; RULES.md has the formulas."""

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from .law import OBSERVABLES
from .network import Network
from .tracker import Array, Change

MODEL, LENGTHS, NOTES = "model.csv", "lengths.csv", "model.json"
UNITS = {"distance_um": 1e-6, "azimuth_urad": 1e-6, "elevation_urad": 1e-6}
VARIANCES = tuple(f"{name}_variance" for name in OBSERVABLES)
LENGTH = "length_um"


@dataclass(frozen=True)
class Model:
    """Modelled changes of readings (n, 3) [m, rad, rad] and lengths (g,) [m], and factors on the variance (n, 3)."""

    change: Array
    variance: Array
    lengths: Array
    notes: dict[str, Any]
    """Optional notes: `coefficients`, the number of estimated coefficients; `law`, the name in the list of laws."""

    @classmethod
    def nothing(cls, network: Network) -> Self:
        """Model without changes."""
        hall = network.hall
        return cls(np.zeros((hall.n, 3)), np.ones((hall.n, 3)), np.zeros(len(hall.bars)), {})

    @classmethod
    def read(cls, folder: Path, network: Network) -> Self:
        """Model of an answer; no change if a file is missing."""
        model = cls.nothing(network)
        rows = _columns(folder / MODEL, (*UNITS, *VARIANCES), len(model.change))
        lengths = _columns(folder / LENGTHS, (LENGTH,), len(model.lengths))
        notes = folder / NOTES
        return cls(
            model.change if rows is None else rows[:, :3] * [*UNITS.values()],
            model.variance if rows is None else rows[:, 3:],
            model.lengths if lengths is None else 1e-6 * lengths[:, 0],
            json.loads(notes.read_text(encoding="utf-8")) if notes.is_file() else {},
        )

    def write(self, folder: Path) -> None:
        """Write `model.csv`, `lengths.csv` and `model.json` into a folder."""
        rows = np.column_stack([self.change / [*UNITS.values()], self.variance]).tolist()
        _write(folder / MODEL, (*UNITS, *VARIANCES), rows)
        _write(folder / LENGTHS, (LENGTH,), (1e6 * self.lengths[:, None]).tolist())
        (folder / NOTES).write_text(json.dumps(self.notes) + "\n", encoding="utf-8")

    def whitened(self, network: Network) -> Array:
        """(m,) Whitened change of the readings and lengths."""
        return network.whitened(self.change, self.lengths)

    def explained_fraction(self, network: Network, truth: Change) -> float:
        """Fraction of the strength of the truth that the model explains; negative if the model does harm."""
        if truth.variance is not None:
            factor = 1.0 + truth.variance
            return float(1.0 - network.noise_strengths(factor / self.variance).sum() / network.strengths(truth).sum())
        signal = network.signature(truth)
        rest, whole = (network.residual(v) for v in (signal - self.whitened(network), signal))
        return float(1.0 - (rest @ rest) / (whole @ whole))

    def observables(self, network: Network, min_fraction: float, *, noise: bool) -> set[str]:
        """Observables with more than the fraction `min_fraction` of the strength of the model."""
        parts = network.noise_strengths(self.variance) if noise else network.mean_strengths(self.whitened(network))
        return {name for name, part in zip(OBSERVABLES, parts[:3], strict=True) if part > min_fraction * parts.sum()}


def _columns(file: Path, names: Sequence[str], rows: int) -> Array | None:
    """(rows, k) Numbers of columns of a file; None if the file is missing."""
    if not file.is_file():
        return None
    with file.open(encoding="utf-8") as lines:
        values = np.array([[float(row[name]) for name in names] for row in csv.DictReader(lines)])
    if len(values) != rows or not np.isfinite(values).all():
        raise ValueError(f"{file} has {len(values)} rows; expected {rows} rows of finite numbers")
    return values


def _write(file: Path, names: Sequence[str], rows: list[list[float]]) -> None:
    lines = [",".join(names), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
