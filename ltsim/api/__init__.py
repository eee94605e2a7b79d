"""The functions of the front door, `ltsim.NAME`: each takes files or objects and gives an object that shows itself."""
