"""Experiments about ltsim and the paper: `python -m experiments` lists them, `python -m experiments 02` runs one."""
