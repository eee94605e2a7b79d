"""Every sentence of advice, once: what to do, and what it would bring."""

from __future__ import annotations

ADVICE = {
    # from the last station, before it is left
    "other face here": "measure all targets from {station} in the other face as well",
    "close here": "measure the first {count} targets of {station} again before leaving it",
    "reverse here": "measure all targets of {station} again in the reverse order",
    "look again": "measure {targets} from {station} {count} more times, without touching the reflector",
    "to and fro": "measure all targets of {station} {count} more times, to and fro",
    "unmeasured": "measure from {station} the targets it has not measured ({targets})",
    # a further set-up
    "turned": "set up once more at {station}, the base turned by {turn:.0f} degrees, and measure all targets",
    "new station": "add station {station} at ({place[0]:.2f}, {place[1]:.2f}, {place[2]:.2f}) m, "
    "yaw {yaw:.0f} deg ({frame}), and measure all targets",
    # the whole work in another way
    "other face": "measure every target in both faces",
    "close": "measure the first {count} targets again before leaving each station",
    "reverse": "measure every station's targets again in the reverse order",
    # other things than pointings
    "length": "calibrate a length of about {length:.0f} m, such as that between {targets}",
    "near": "add reflectors at 1 to 1.5 m from two stations and measure them from all",
    "other face and near": "measure in both faces, and add reflectors at 1 to 1.5 m from two stations",
    # what it brings
    "decided": "{do}: expected chi-square between {first} and {others} from {now} to {then}",
    "left open": "; nothing that was tried tells it from {others} as well",
    "undecided": "nothing that was tried tells {first} from {others} (expected chi-square {then}, {needed:.0f} would); "
    "an independent measurement of the cause would",
    "cause": "an independent measurement of its cause",
    "determined": "{do} (gain {now:.2f} to {then:.2f})",
    "determined already": "use the network method: it determines this from the same recording (gain {then:.2f})",
    "not determined": "none of the measurements that were tried shows it; only a tighter guarantee would",
}


def advice(key: str, **values: object) -> str:
    """A sentence of the table with its values."""
    return ADVICE[key].format(**values)


def listed(names: list[str] | tuple[str, ...]) -> str:
    """Names with `and`."""
    return " and ".join(names)
