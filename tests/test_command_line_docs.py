"""docs/command_line.md: every command that it shows runs, and prints the text below it.

Run as a program, it prints the page again: ``python tests/test_command_line_docs.py``.
"""

import os
import re
import shlex
import tempfile
from pathlib import Path

from typer.testing import CliRunner

from driftfit import cli

PAGE = Path(__file__).parent.parent / "docs" / "command_line.md"
BLOCK = re.compile(r"```(python|bash)\n(.*?)```(?:\n\n```text\n(.*?)```)?", re.S)


def printed(commands: str) -> str:
    """What the lines of a block print; ``cat FILE |`` goes to stdin."""
    output = ""
    for line in commands.strip().splitlines():
        words, piped = shlex.split(line), None
        if words[0] == "cat":
            piped, words = Path(words[1]).read_bytes(), words[words.index("|") + 1 :]
        assert words[0] == "driftfit"
        result = CliRunner().invoke(cli.app, words[1:], input=piped)
        assert result.exit_code == 0, f"{line}\n{result.output}"
        output += result.stdout
    return "\n".join(line.rstrip() for line in output.strip("\n").splitlines())


def blocks(text: str):
    """(match, what it prints) of every block of commands, in order; blocks of Python are run."""
    for block in BLOCK.finditer(text):
        if block[1] == "python":
            exec(block[2], {})
        else:
            yield block, printed(block[2])


def squeezed(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.strip().splitlines()]


def test_every_command_prints_what_the_page_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    compared = 0
    for block, output in blocks(PAGE.read_text()):
        if block[3] is not None:
            assert squeezed(output) == squeezed(block[3]), block[2]
            compared += 1
    assert compared >= 7


def test_every_command_has_an_example():
    shown = set(re.findall(r"^(?:cat \S+ \| )?driftfit (\w+)", PAGE.read_text(), re.M))
    commands = {command.name or command.callback.__name__ for command in cli.app.registered_commands}
    # without data: the README shows them; docs/service.md shows the service
    assert commands - shown == {"demo", "trackers", "serve"}


if __name__ == "__main__":
    page = PAGE.read_text()
    os.chdir(tempfile.mkdtemp())
    for block, output in blocks(page):
        if block[3] is not None:
            page = page.replace(block[0], f"```bash\n{block[2]}```\n\n```text\n{output}\n```")
    PAGE.write_text(page)
