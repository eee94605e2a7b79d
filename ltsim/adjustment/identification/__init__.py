"""Detection, identification and adaptation: simple causes that the readings support, compared by one log evidence.

A simple cause is one of a short list at one place: an outlier, an offset of all distances to a target, a station that
moved, a wrong reference value. Each is a hypothesis with a prior and a change of the model; the network is fitted with
it, and its log evidence is compared with that of the others. A cause of a million standard deviations is identified as
reliably as one of twenty, because every fit starts at a robust state and is relinearised.

References
----------
Baarda, A testing procedure for use in geodetic networks (1968); Teunissen, Testing theory (2006): detection,
identification and adaptation of model errors. Kass and Raftery, Bayes factors, J. Am. Stat. Assoc. 90 (1995) 773.
"""

from ltsim.adjustment.identification.adaptation import adjust_with_causes as adjust_with_causes
from ltsim.adjustment.identification.cause_selection import CauseSelection as CauseSelection
from ltsim.adjustment.identification.fit import FitInput as FitInput, NetworkFit as NetworkFit
from ltsim.adjustment.identification.hypothesis import Hypothesis as Hypothesis
from ltsim.adjustment.identification.selection import (
    identify_causes as identify_causes,
    select_causes as select_causes,
)
from ltsim.adjustment.identification.tests import CauseTest as CauseTest, cause_tests as cause_tests
