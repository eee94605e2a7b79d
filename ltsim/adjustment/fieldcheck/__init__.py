"""Field check: a go or no-go decision from repeated measurements at each set-up, before the tripod is moved."""

from ltsim.adjustment.fieldcheck.check import check as check
from ltsim.adjustment.fieldcheck.result import Check as Check, CheckItem as CheckItem
