"""No test writes a field that begins with an underscore: what a test needs to set, a user needs too."""

import ast
from pathlib import Path

import pytest

HOME = Path(__file__).parent.parent
TESTS = sorted([*HOME.glob("tests/**/*.py"), *HOME.glob("lab/tests/**/*.py")])


def written(text):
    """Lines that assign to a private field of anything but the object itself, or to a part of one."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store | ast.Del):
            place = node
            while isinstance(place, ast.Attribute | ast.Subscript):
                of_itself = isinstance(place.value, ast.Name) and place.value.id in ("self", "cls")
                private = (
                    isinstance(place, ast.Attribute) and place.attr.startswith("_") and not place.attr.endswith("__")
                )
                if private and not of_itself:
                    found.append(node.lineno)
                    break
                place = place.value
    return found


def test_what_writes_private_fields_is_found():
    assert written("live._tile['theta'][0] = 1.0\nlive._tile += 1\ndel live._tile.x") == [1, 2, 3]
    assert written("self._tile = live._tile\nlive.tile = _x\nx = live._tile[0]") == []


@pytest.mark.parametrize("path", TESTS, ids=lambda path: path.relative_to(HOME).as_posix())
def test_no_test_writes_private_fields(path):
    assert written(path.read_text()) == []
