"""SMRs of several radii: how much farther from the seat of its nest each pointing's SMR stood than the reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import NetworkError, RecordError
from ltsim.recording.files import shown
from ltsim.recording.recording import REFLECTOR_COLUMN, Recording
from ltsim.recording.setup import Reflector
from ltsim.units import MILLIMETRE


def smrs_of(recording: Recording) -> tuple[str, ...]:
    """Name of the SMR of each pointing, '' where none is stated: that of its row, else that of its target."""
    usual = [recording.target_setup(name).reflector or "" for name in recording.targets]
    own = recording.labels.get(REFLECTOR_COLUMN, ("",) * len(recording))
    return tuple(name or usual[target] for name, target in zip(own, recording.target, strict=True))


def reference_radius(names: Sequence[str], reflectors: Mapping[str, Reflector], stated: float | None) -> float:
    """[mm] Radius of the SMR whose centre is meant by the coordinates of a target.

    Parameters
    ----------
    names : sequence of str
        The SMRs in use.
    reflectors : mapping
        Them by name.
    stated : float, optional
        `reference_radius_mm`; default the radius of all, where they have one.

    Raises
    ------
    RecordError
        When an SMR has no table, or they differ and nothing is stated.
    """
    for name in names:
        if name not in reflectors:
            raise RecordError(f"there is no table [reflectors.{shown(name)}]; reflectors: {', '.join(reflectors)}")
    radii = {reflectors[name].radius_mm: name for name in reversed(names)}
    if stated is not None:
        return stated
    if len(radii) > 1:
        found = " and ".join(f"{shown(name)} of {radius:g}" for radius, name in sorted(radii.items()))
        raise RecordError(
            f"the SMRs have different radii ({found} mm): state reference_radius_mm at the head of the file, the "
            "radius of the SMR whose centre a target's coordinates mean, or 0 for the seat of its nest"
        )
    return next(iter(radii), 0.0)


def excess_radii(recording: Recording, file: object = "setup.toml") -> Floats | None:
    """How much farther (n,) [m] than the reference each SMR's centre stood from its seat; None where none did.

    A pointing that names no SMR, such as one that is only thought of, has the reference.

    Raises RecordError when an SMR has no table, one of another radius sat in a nest without a normal, or the reference
    is not stated. `file` is named.
    """
    reflectors = recording.setup.reflectors
    if not reflectors:
        return None
    names = smrs_of(recording)
    used = tuple(name for name in dict.fromkeys(names) if name)
    try:
        reference = reference_radius(used, reflectors, recording.setup.reference_radius_mm)
    except RecordError as problem:
        raise RecordError(str(problem), file=file) from None
    off = {name: (reflectors[name].radius_mm - reference) * MILLIMETRE for name in used} | {"": 0.0}
    excess = np.array([off[name] for name in names])
    for row in np.flatnonzero(excess):
        target = recording.targets[recording.target[row]]
        if recording.target_setup(target).nest_normal is None:
            sentence = without_normal(target, names[row], reflectors[names[row]].radius_mm, reference)
            raise RecordError(sentence, file=file)
    return excess if np.any(excess) else None


def without_normal(target: str, smr: str, radius: float, reference: float) -> str:
    """The sentence for an SMR of another radius [mm] at a target whose nest has no normal."""
    return (
        f"targets.{target}.nest_normal is missing: its SMR {shown(smr)} has a radius of {radius:g} mm, the reference "
        f"{reference:g} mm, and the difference lies along the nest's normal"
    )


def require_one_radius(recording: Recording, what: str) -> None:
    """NetworkError where SMRs stand off the targets' places and `what` knows of none."""
    if excess_radii(recording) is not None:
        raise NetworkError(
            f"{what} takes every target for one place, and SMRs of several radii stood at different ones; adjust or "
            "calibrate by the network, which puts each SMR along its nest's normal"
        )
