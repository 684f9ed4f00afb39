"""The contract: what every tracker that stands in the folder promises. A new file there is tested by being there."""

import pytest
from contract_table import ready

from driftfit import ARX
from driftfit.trackers import found


@pytest.fixture(params=list(found().values()), ids=list(found()))
def tracker(request):
    return ready(request.param)


@pytest.fixture
def model():
    return ARX(2, 2).bind(1)
