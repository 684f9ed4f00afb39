"""The promises of trackers and models as code, for those that stand outside this package as well.

from driftfit.checks import check_model, check_tracker

for sentence in check_tracker(MyTracker(gain=0.1)):
    print(sentence)
"""

from driftfit.checks.model import check_model
from driftfit.checks.tracker import check_tracker

__all__ = ["check_model", "check_tracker"]
