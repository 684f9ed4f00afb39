"""The lower bounds in pyproject are the versions in `lowest.txt`, and those of Numba are the ends of what was tried."""

import re
import tomllib
from pathlib import Path

from driftfit.engine.numba_internals import TRIED

HOME = Path(__file__).parents[1]
PROJECT = tomllib.loads((HOME / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]


def bounds(requirements):
    """Lowest versions by name."""
    return dict(re.match(r"([\w-]+)>=([\d.]+)", one).groups() for one in requirements)


def test_the_lowest_versions_allowed_are_those_that_are_tried():
    lines = [line for line in (HOME / "tests/lowest.txt").read_text().splitlines() if not line.startswith("#")]
    assert dict(line.split("==") for line in lines) == bounds([*PROJECT["dependencies"], *EXTRAS["plot"]])


def test_numba_is_allowed_where_its_inside_was_tried():
    (allowed,) = (one for one in PROJECT["dependencies"] if one.startswith("numba"))
    lowest, beyond = re.fullmatch(r"numba>=0\.(\d+),<0\.(\d+)", allowed).groups()
    assert {int(one.split(".")[1]) for one in TRIED["numba"]} == set(range(int(lowest), int(beyond)))


def test_an_extra_asks_for_the_same_version_everywhere():
    found = {}
    for one in (requirement for name in EXTRAS for requirement in EXTRAS[name] if ">=" in requirement):
        name, lowest = one.split(">=")
        found.setdefault(name, set()).add(lowest)
    assert {name: several for name, several in found.items() if len(several) > 1} == {}
