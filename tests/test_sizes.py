"""No function is so long, or takes so much one by one, that nobody reads it: computed from the source."""

import ast
from pathlib import Path

import driftfit

HOME = Path(driftfit.__file__).parent
LAB = Path(__file__).parent.parent / "lab"
LINES, ARGUMENTS = 60, 8
SOURCES = sorted([*HOME.rglob("*.py"), *LAB.rglob("*.py")])


def functions(text):
    """All functions in a text, those inside of others too."""
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def length(function):
    """Lines from ``def`` to the last statement, without the docstring."""
    lines = function.end_lineno - function.lineno + 1
    first = function.body[0]
    documented = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    return lines - (first.end_lineno - first.lineno + 1 if documented else 0)


def positional(function):
    """How many arguments can be given by their places; ``self`` is not counted, ``cls`` is: its function constructs."""
    given = [one.arg for one in (*function.args.posonlyargs, *function.args.args)]
    return len(given) - (given[:1] == ["self"])


def too_large(text):
    """Names of the functions that are too long or take too much."""
    found = functions(text)
    return [one.name for one in found if length(one) > LINES or positional(one) > ARGUMENTS]


def test_what_is_too_large_is_found():
    long = "def f():\n" + "    x = 1\n" * (LINES + 1)
    many = f"def f({', '.join(f'x{i}' for i in range(ARGUMENTS + 1))}):\n    pass\n"
    assert too_large(long) == too_large(many) == ["f"]
    assert too_large("def f():\n" + "    x = 1\n" * (LINES - 1)) == []
    assert too_large(many.replace("x0", "self")) == []


def test_functions_are_short_and_take_few_arguments():
    found = {path.relative_to(HOME if HOME in path.parents else LAB.parent).as_posix(): path for path in SOURCES}
    assert len(found) > 350
    large = {name: too_large(path.read_text()) for name, path in found.items()}
    assert {name: functions for name, functions in large.items() if functions} == {}
