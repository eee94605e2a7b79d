"""Laws with memory do not take the place of simple causes of the catalogue that fit as well."""

from __future__ import annotations

import numpy as np

import ltsim as lt


def test_a_stand_that_was_touched_once_is_not_reported_as_switched() -> None:
    """A switch that is on from the touch to a time between two set-ups displaces no more than the touch."""
    recording, _ = lt.simulate("paper-workshop", seed=3)
    time = float(np.median(recording.time[recording.station == 1]))
    touched = {"name": "station-bump", "stations": ["S2"], "shape": {"time": time}}
    changes = {"effects": [touched | {"values": {"shift-x": 150.0, "shift-y": -100.0}}]}
    findings = lt.diagnose(lt.simulate("paper-workshop", seed=3, changes=changes).recording, held_out=False).findings
    assert [(finding.effect, finding.where.stations) for finding in findings] == [("station-bump", ("S2",))]
