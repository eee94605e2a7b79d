"""Simulation of virtual workshops: a scenario and a seed give a recording and its truth."""
