"""Simulation of recordings in virtual halls: a scenario and a seed give a recording and its true values."""
