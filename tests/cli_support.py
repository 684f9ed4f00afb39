"""The command line as tests call it: what it prints, or the one line with which it refuses."""

from typer.testing import CliRunner

from driftfit.cli import app


def run(*arguments, stdin=None):
    """What a command prints on stdout."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], input=stdin)
    assert result.exit_code == 0, result.output
    return result.stdout


def fails(*arguments):
    """The one line on stderr."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 2, result.output
    (line,) = result.stderr.strip().splitlines()
    assert line.startswith("driftfit: ")
    assert "Traceback" not in result.output
    return line
