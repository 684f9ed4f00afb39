"""The contract: what every tracker that stands in the folder promises. A new file there is tested by being there."""

import pytest
from contract_table import model_of, ready

from driftfit import ARX
from driftfit.trackers import found


@pytest.fixture(params=list(found().values()), ids=list(found()))
def tracker(request):
    return ready(request.param)


@pytest.fixture
def model(tracker):
    return model_of(tracker, ARX(2, 2).bind(1))
