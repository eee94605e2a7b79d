"""The small campaign of the tests: two cells of 600 trials in three shards each."""

from __future__ import annotations

FILE = """
format = "ltsim-campaign/1"
title = "for the tests"
scenario = "paper-workshop"
seed = 5
trials = 600
trials_per_shard = 256
verified_trials_per_shard = 1

[grid]
"instrument.noise_factor" = [1.0, 2.0]
"""
