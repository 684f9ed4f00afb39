"""The promises of trackers and models as code, also for those outside this package.

from driftfit.checks import check_model, check_tracker

for sentence in check_tracker(MyTracker(gain=0.1)):
    print(sentence)
"""

from driftfit.checks.model import check_model
from driftfit.checks.tracker import check_tracker

__all__ = ["check_model", "check_tracker"]
