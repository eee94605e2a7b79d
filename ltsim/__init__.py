"""Simulate, calibrate, plan and diagnose laser-tracker networks.

The names most used live in their rooms: `ltsim.recording.read`, `ltsim.adjust.adjust`,
`ltsim.calibrate.calibrate_network`, `ltsim.diagnose.diagnose`, `ltsim.simulate.simulator.simulate`.
"""
