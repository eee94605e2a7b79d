"""SMRs of different radii: height of the SMR centre above the seat of its nest, minus a reference height."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError, RecordError
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.recording import REFLECTOR_COLUMN, Recording
from ltsim.recordings.setup import Reflector


def smr_names(recording: Recording) -> tuple[str, ...]:
    """Name of the SMR in each pointing, from its row or else from the table of its target; '' if neither gives one."""
    default_names = [recording.target_setup(name).reflector or "" for name in recording.targets]
    row_names = recording.labels.get(REFLECTOR_COLUMN, ("",) * len(recording))
    return tuple(name or default_names[target] for name, target in zip(row_names, recording.target, strict=True))


def excess_radii_from_smr_names(
    names: Sequence[str],
    targets: Sequence[str],
    targets_without_normal: Collection[str],
    reflectors: Mapping[str, Reflector],
    reference_mm: float | None,
    file: object = None,
) -> Floats:
    """Height (n,) [m] of the SMR centre above the seat of its nest in n pointings, minus the reference height.

    `names` are the SMRs and `targets` the targets of the n pointings. `reflectors` are the declared SMRs by name;
    `file` is named in errors. The reference height is `reference_mm`, or the radius that all SMRs have in common if
    None. A pointing without SMR ('' in `names`), such as a planned one, has the reference height.

    Raises RecordError if an SMR has no table, or if radii differ without declared reference. Raises it also if the nest
    of an SMR with another radius than the reference has no normal (`targets_without_normal`).
    """
    names_used = [name for name in dict.fromkeys(names) if name]
    for name in names_used:
        if name not in reflectors:
            names_of_tables = ", ".join(reflectors)
            raise RecordError(
                f"there is no table [reflectors.{safe_excerpt(name)}]; reflectors: {names_of_tables}", file=file
            )
    radii = {reflectors[name].radius_mm: name for name in reversed(names_used)}
    if reference_mm is None and len(radii) > 1:
        radii_text = " and ".join(f"{safe_excerpt(name)} of {radius:g}" for radius, name in sorted(radii.items()))
        raise RecordError(
            f"the SMRs have different radii ({radii_text} mm); set reference_radius_mm at the head of the file, the "
            "radius of the SMR at whose centre the coordinates lie, or 0 for the seat of the nest",
            file=file,
        )
    reference = next(iter(radii), 0.0) if reference_mm is None else reference_mm
    excess_mm = {name: reflectors[name].radius_mm - reference for name in names_used} | {"": 0.0}
    for name, target in zip(names, targets, strict=True):
        if excess_mm[name] and target in targets_without_normal:
            raise RecordError(
                f"targets.{target}.nest_normal is missing: its SMR {safe_excerpt(name)} has a radius of "
                f"{reflectors[name].radius_mm:g} mm, the reference {reference:g} mm, and the difference lies along the "
                "nest's normal",
                file=file,
            )
    return np.array([excess_mm[name] for name in names]) * MILLIMETRE


def excess_radii(recording: Recording, file: object = "setup.toml") -> Floats | None:
    """Height (n,) [m] of the SMR centre above the seat of its nest in n pointings, minus the reference height.

    The result is None if all differences are 0. Raises RecordError, which names `file`, for an SMR without table, for
    different radii without reference height, and for a nest without normal that needs one.
    """
    setup = recording.setup
    if not setup.reflectors:
        return None
    targets = [recording.targets[t] for t in recording.target]
    targets_without_normal = [name for name in recording.targets if recording.target_setup(name).nest_normal is None]
    excess = excess_radii_from_smr_names(
        smr_names(recording), targets, targets_without_normal, setup.reflectors, setup.reference_radius_mm, file
    )
    return excess if np.any(excess) else None


def require_equal_radii(recording: Recording, task: str) -> None:
    """Check that all SMRs have the reference radius, so that the centre of each SMR is at its target.

    Raises NetworkError, which names the `task` that needs this.
    """
    if excess_radii(recording) is not None:
        raise NetworkError(
            f"{task} assumes one centre per target, but SMRs of different radii have different centres; use `adjust` "
            "or the method network of `calibrate`, which displace each SMR centre along the normal of its nest"
        )
