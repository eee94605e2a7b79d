"""A second simulator that shares no formula with ltsim: numpy alone, and the recording to hand over."""
