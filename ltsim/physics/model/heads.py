"""Heights of heads over their marks as observations: each occupation has its own, which the network corrects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects.signature import Parameter, Signature, by_displacement
from ltsim.recordings.recording import OCCUPATION_COLUMNS, Recording
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class HeadHeights(Signature):
    """Heights of instrument and reflector over their marks, less the declared ones, one for each of q occupations."""

    sigma: float
    """[m] of each."""
    lift: Floats
    """(n, q): 1 for pointings to an occupation, -1 for those from it."""
    up: Floats
    """(n, 3): direction of plumb."""

    @property
    def name(self) -> str:
        """Name of the law."""
        return "head-heights"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One an occupation; `prior_sigma` is what is stated."""
        return (Parameter("head-height", "mm", "height of a head", self.sigma),) * self.lift.shape[1]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, q) of the raw readings by each height."""
        return by_displacement(sightings, self.up[:, :, None] * self.lift[:, None])


def head_heights(recording: Recording, vertical: Floats) -> tuple[HeadHeights, ...]:
    """The heights of a recording that states how well they are known; `vertical` (S, 3) at its stations.

    An occupation is what a cell of the columns `instrument_setup` and `target_setup` names; an empty one has none.
    """
    sigma = recording.setup.heads_sigma_mm
    if sigma is None:
        return ()
    occupations = [recording.labels.get(column, ("",) * len(recording)) for column in OCCUPATION_COLUMNS]
    marks = [recording.targets[t] for t in recording.target]
    ends = [[("", occupation) for occupation in occupations[0]], list(zip(marks, occupations[1], strict=True))]
    number_of = {key: i for i, key in enumerate(dict.fromkeys(key for end in ends for key in end if key[1]))}
    if not number_of:
        return ()
    rows = np.eye(len(number_of) + 1, len(number_of))
    at, to = (rows[[number_of.get(key, len(number_of)) for key in end]] for end in ends)
    return (HeadHeights(sigma * MILLIMETRE, to - at, vertical[recording.station]),)
