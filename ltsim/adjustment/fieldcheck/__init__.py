"""Go or no-go in the field: one set-up at a time, from what was measured twice."""

from ltsim.adjustment.fieldcheck.check import (
    Check as Check,
    check as check,
    check_file as check_file,
    write_check as write_check,
)
from ltsim.adjustment.fieldcheck.items import Item as Item
