"""Errors that several readings share, as a covariance between them states: each is estimated beside the network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.physics.effects.signature import Parameter, Signature
from ltsim.recordings.recording import ENDINGS, OBSERVABLES, SHARED_COLUMN, SIGMA_UNITS, Recording
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class SharedErrors(Signature):
    """q independent errors, in standard deviations, each of which reaches several readings.

    Readings with a noise D of their own and these errors F have the covariance D^2 + F F'; to estimate the errors
    beside the network is to adjust with that covariance.
    """

    reach: Floats
    """(n, 3, q) [m, rad]: change of each reading by one standard deviation."""
    flat: Bools
    """(n,): distances reduced to the horizontal."""

    @property
    def name(self) -> str:
        """Name of the law."""
        return "shared-errors"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One an error, of one standard deviation."""
        return (Parameter("shared-error", "", "error that readings share", 1.0),) * self.reach.shape[2]

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, q) of the raw readings by each error.

        A horizontal distance h = r cos(e) is reduced from raw readings, but its error is stated by itself: r changes by
        what it asks for, and by what makes up for the error of e.
        """
        reach, (range_, _, elevation) = self.reach.copy(), sightings.read[self.flat].T[:, :, None]
        cosine = np.cos(elevation)
        change = np.sign(cosine) * reach[self.flat, 0] + range_ * np.sin(elevation) * reach[self.flat, 2]
        reach[self.flat, 0] = change / cosine
        return reach


def shared_errors(recording: Recording) -> tuple[SharedErrors, ...]:
    """The errors that the columns `shared_NAME_...` of a recording state; an empty cell is none."""
    columns = {name: parts for name in recording.covariates if (parts := SHARED_COLUMN.fullmatch(name))}
    names = list(dict.fromkeys(parts[1] for parts in columns.values()))
    if not names:
        return ()
    reach = np.zeros((len(recording), len(OBSERVABLES), len(names)))
    for name, parts in columns.items():
        k = ENDINGS.index(parts[2])
        reach[:, k, names.index(parts[1])] = np.nan_to_num(recording.covariates[name]) * SIGMA_UNITS[k]
    return (SharedErrors(reach, recording.is_horizontal),)
