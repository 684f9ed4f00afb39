"""The contract: what every tracker in the folder promises. A new file in it is found and tested."""

import pytest
from contract_table import forms, model_of, ready

from driftfit import ARX
from driftfit.engine import disk_cache
from driftfit.trackers import found

EVERY = {
    name + "".join(f"({key}={value})" for key, value in form.items()): ready(kind, **form)
    for name, kind in found().items()
    for form in forms(kind)
}


@pytest.fixture(params=list(EVERY.values()), ids=list(EVERY))
def tracker(request):
    return request.param


@pytest.fixture
def model(tracker):
    return model_of(tracker, ARX(2, 2).bind(1))


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """A folder for compiled code that is empty, and this test's alone."""
    monkeypatch.setattr(disk_cache, "folders", lambda: (tmp_path / "cache",))
    disk_cache.folder.cache_clear()
    yield tmp_path / "cache"
    monkeypatch.undo()
    disk_cache.folder.cache_clear()
