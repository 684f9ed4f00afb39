"""No test writes a field that begins with an underscore: what a test needs to set, a user needs too."""

import ast
from pathlib import Path

import pytest

HOME = Path(__file__).parent.parent
TESTS = sorted([*HOME.glob("tests/**/*.py"), *HOME.glob("lab/tests/**/*.py")])


SETTERS = ("setattr", "delattr", "__setattr__", "__delattr__")


def is_private(name):
    """Whether the last part of a dotted name begins with an underscore, and is no special method."""
    last = name.rpartition(".")[2]
    return last.startswith("_") and not last.endswith("__")


def set_by_name(node):
    """Whether a call sets or deletes a private field that it names: ``setattr``, or pytest's monkeypatch."""
    called = getattr(node.func, "attr", getattr(node.func, "id", ""))
    texts = [part for one in node.args[:2] for part in getattr(one, "values", [one])]  # also those of an f-string
    names = [one.value for one in texts if isinstance(one, ast.Constant) and isinstance(one.value, str)]
    return called in SETTERS and any(map(is_private, names))


def written(text):
    """Lines that assign to a private field of anything but the object itself, or to a part of one."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and set_by_name(node):
            found.append(node.lineno)
        if isinstance(node, ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store | ast.Del):
            place = node
            while isinstance(place, ast.Attribute | ast.Subscript):
                of_itself = isinstance(place.value, ast.Name) and place.value.id in ("self", "cls")
                if isinstance(place, ast.Attribute) and is_private(place.attr) and not of_itself:
                    found.append(node.lineno)
                    break
                place = place.value
    return found


def test_what_writes_private_fields_is_found():
    assert written("live._tile['theta'][0] = 1.0\nlive._tile += 1\ndel live._tile.x") == [1, 2, 3]
    assert written("setattr(live, '_tile', 0)\npatch.setattr('a.b._c', 0)\nobject.__setattr__(run, '_x', 1)") == [
        1,
        2,
        3,
    ]
    assert written("setattr(live, 'tile', '_')\npatch.setattr('a._b.c', 0)\npatch.setattr(a, '__len__', f)") == []
    assert written("self._tile = live._tile\nlive.tile = _x\nx = live._tile[0]") == []


@pytest.mark.parametrize("path", TESTS, ids=lambda path: path.relative_to(HOME).as_posix())
def test_no_test_writes_private_fields(path):
    assert written(path.read_text()) == []
