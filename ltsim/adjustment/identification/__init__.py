"""Identification of common errors of a network (causes of a misfit), by the log evidence of fits with these errors.

The list of causes is short: an outlier, an offset of all distances to a target, a station that moved, a wrong reference
value and so on. Each cause at each station, target or reference value is a hypothesis with a prior probability and a
change of the model. The network is fitted with the most promising hypotheses, and the log evidences of the fits are
compared. Very large errors are identified as reliably as small ones, because every fit starts at a robust state and is
iterated.

References
----------
Baarda, A testing procedure for use in geodetic networks (1968); Teunissen, Testing theory (2006): detection,
identification and adaptation of model errors. Kass and Raftery, Bayes factors, J. Am. Stat. Assoc. 90 (1995) 773.
"""

from ltsim.adjustment.identification.cause_selection import (
    CauseSelection as CauseSelection,
    adjust_with_causes as adjust_with_causes,
)
from ltsim.adjustment.identification.cause_tests import CauseTest as CauseTest, cause_tests as cause_tests
from ltsim.adjustment.identification.fit import FitInput as FitInput, NetworkFit as NetworkFit
from ltsim.adjustment.identification.hypothesis import CauseHypothesis as CauseHypothesis
from ltsim.adjustment.identification.selection import (
    identify_causes as identify_causes,
    select_causes as select_causes,
)
