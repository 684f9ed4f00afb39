"""The process in which compiled code checks its indices; `lab.bounds.commands` starts it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import pytest

from lab.bounds.banks import run_banks
from lab.bounds.checks import Violations, watch


class EveryTest:
    """Fails a test in which something was out of bounds."""

    def __init__(self, violations: Violations) -> None:
        self.violations = violations

    def _judged(self) -> Iterator[None]:
        result = yield
        wrong = self.violations.take()
        if wrong:
            pytest.fail("out of bounds: " + "; ".join(wrong), pytrace=False)
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: Any) -> Iterator[None]:
        return (yield from self._judged())

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: Any) -> Iterator[None]:
        return (yield from self._judged())


def main(first: int, banks: int, quick: bool, tests: list[str]) -> int:
    """Returns 1 if anything was found."""
    violations, bad = watch(), 0
    if banks:
        bad = run_banks(range(first, first + banks), quick, violations)
        print(f"{banks} banks, {bad} at fault", flush=True)
    if not tests:
        return int(bad > 0)
    failed = pytest.main(["-n", "0", "-p", "no:cacheprovider", *tests], plugins=[EveryTest(violations)])
    print(f"tests: exit status {int(failed)}; {violations.checks} checks were compiled, the rest was on disk")
    return int(bad > 0 or failed != 0)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "True", sys.argv[4:]))
