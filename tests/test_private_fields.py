"""No test writes a field that begins with an underscore: users need what tests set. No module imports one."""

import ast
from pathlib import Path

HOME = Path(__file__).parent.parent
INSIDE = HOME / "tests/contract/test_numba_internals.py"
"""Its subject is the private side of Numba."""
TESTS = sorted({*HOME.glob("tests/**/*.py"), *HOME.glob("lab/tests/**/*.py")} - {INSIDE})
SETTERS = ("setattr", "delattr", "__setattr__", "__delattr__", "object", "setitem", "delitem", "patch")
"""Calls that set what their first arguments name, of pytest and of unittest.mock too."""
CHANGERS = (
    "add", "append", "clear", "discard", "extend", "fill", "insert", "itemset", "pop", "popitem", "put", "remove",
    "resize", "reverse", "setdefault", "setfield", "sort", "update",
)  # fmt: skip
"""Methods that change their object."""
FILLERS = ("copyto", "fill_diagonal", "place", "put", "putmask", "shuffle")
"""Functions of NumPy that change their first argument."""


def is_private(name):
    """Whether the last part of a dotted name begins with an underscore, and is no special method."""
    last = name.rpartition(".")[2]
    return last.startswith("_") and not last.endswith("__")


def texts(node):
    """The text of a constant, and the constant parts of an f-string."""
    parts = getattr(node, "values", [node])
    return [one.value for one in parts if isinstance(one, ast.Constant) and isinstance(one.value, str)]


def at_fault(check, paths):
    """What a check finds in files, by file."""
    found = {path.relative_to(HOME).as_posix(): check(path.read_text()) for path in paths}
    return {name: faults for name, faults in found.items() if faults}


def called(node):
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


def within(node, known):
    """Whether a place is a private field, a part of one, or a part of what one of the ``known`` names stands for."""
    while isinstance(node, ast.Attribute | ast.Subscript | ast.Call):
        if isinstance(node, ast.Attribute):
            if is_private(node.attr):
                return True
            node = node.value
        elif isinstance(node, ast.Subscript):
            fields = getattr(node.value, "attr", "") == "__dict__" or (
                isinstance(node.value, ast.Call) and called(node.value) == "vars"
            )
            if fields and any(map(is_private, texts(node.slice))):
                return True
            node = node.value
        else:
            if called(node) == "getattr" and any(map(is_private, texts(node.args[1]))):
                return True
            if called(node) not in ("getattr", "vars"):
                return False
            node = node.args[0]
    return isinstance(node, ast.Name) and node.id in known


def changes(node, known):
    """Whether a call changes a private field."""
    name, given = called(node), node.args
    if name in SETTERS and (any(is_private(text) for one in given[:2] for text in texts(one)) or
                            any(within(one, known) for one in given[:1])):  # fmt: skip
        return True
    if name in FILLERS and given and within(given[0], known):
        return True
    return name in CHANGERS and isinstance(node.func, ast.Attribute) and within(node.func.value, known)


def written(text):
    """Lines that change a private field, or a part of one, also under another name."""
    tree, known, found = ast.parse(text), set(), []
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and within(node.value, known):
            known |= {one.id for one in node.targets if isinstance(one, ast.Name)}
    for node in ast.walk(tree):
        stored = isinstance(node, ast.Attribute | ast.Subscript) and isinstance(node.ctx, ast.Store | ast.Del)
        if (stored and within(node, known)) or (isinstance(node, ast.Call) and changes(node, known)):
            found.append(node.lineno)
    return sorted(set(found))


WRITES = """
live._tile['theta'][0] = 1.0
live._tile += 1
del live._tile.x
self._tile = 0
setattr(live, '_tile', 0)
patch.setattr('a.b._c', 0)
object.__setattr__(run, '_x', 1)
patch.object(live, '_tile', 0)
patch.setitem(live._cache, 'a', 0)
live._tile['theta'].fill(0.0)
live._alarms.append(1)
np.copyto(live._tile, 0.0)
live.__dict__['_tile'] = 0
vars(live)['_tile'] = 0
getattr(live, '_tile')[0] = 1
tile = live._tile
tile['theta'][:] = 0.0
""".strip().splitlines()
READS = """
setattr(live, 'tile', '_')
patch.setattr('a._b.c', 0)
patch.setattr(a, '__len__', f)
live.tile = _x
x = live._tile[0]
y = live._run(3)
y[0] = 1.0
seen.append(live._tile)
live.__dict__['tile'] = 0
""".strip().splitlines()


def test_what_writes_private_fields_is_found():
    lines = written("\n".join(WRITES))
    assert [line for k, line in enumerate(WRITES, 1) if k not in lines] == ["tile = live._tile"]
    assert [READS[k - 1] for k in written("\n".join(READS))] == []


def test_no_test_writes_private_fields():
    assert len(TESTS) > 100
    assert at_fault(written, TESTS) == {}


def imported(text):
    """Private names that a module imports; what it reads as an attribute is for ruff (SLF001)."""
    lines = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom))
    return [one.name for line in lines for one in line.names if is_private(one.name)]


def test_no_module_imports_private_names_of_another():
    assert imported("from a import _b, c") == ["_b"]
    assert list(at_fault(imported, (HOME / "src").rglob("*.py"))) == ["src/driftfit/engine/numba_internals.py"]
