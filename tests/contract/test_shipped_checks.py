"""The shipped checks pass for every tracker in the folder, as a user's own tracker is tested."""

from driftfit.checks import check_tracker


def test_the_shipped_checks_find_nothing(model, tracker):
    assert check_tracker(tracker, model) == []
