"""Go or no-go in the field: one set-up at a time, from what was measured twice."""

from ltsim.check.check import Check, Item, check
from ltsim.check.files import check_file, write_check

__all__ = ["Check", "Item", "check", "check_file", "write_check"]
