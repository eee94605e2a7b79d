"""The public function of acceptance tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ltsim.acceptance.accept import accept as accepted
from ltsim.acceptance.files import AcceptanceFile
from ltsim.acceptance.spec import Acceptance, acceptance_from, load_acceptance


def accept(acceptance: str | Path | Mapping[str, Any] | Acceptance, folder: str | Path = ".") -> AcceptanceFile:
    """Predict acceptance tests of a tracker, or judge errors that were found, against its maker's limits.

    Parameters
    ----------
    acceptance : str, Path, mapping or Acceptance
        An acceptance file, or its tables; `format` may be left out of tables.
    folder : str or Path
        From where tables name other files.

    Raises
    ------
    SetupError, RecordError, NetworkError
        When a file is missing or does not fit the plan of tests.

    Examples
    --------
    >>> import ltsim as lt
    >>> found = lt.accept({"standard": "asme-b89.4.19-2006", "instrument": "leica-at500"})
    >>> found.kind, len(found.tests)
    ('predicted', 74)
    """
    if isinstance(acceptance, Acceptance):
        return accepted(acceptance, Path(folder))
    if isinstance(acceptance, Mapping):
        return accepted(acceptance_from({"format": "ltsim-acceptance/1", **acceptance}, "acceptance"), Path(folder))
    return accepted(load_acceptance(Path(acceptance)), Path(acceptance).parent)
