"""Simulation of virtual halls: a scenario and a seed give a recording and its truth."""
