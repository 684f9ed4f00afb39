"""How the command line starts a service."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from driftfit.service.core.journal import Journal
from driftfit.service.settings.config import Config, ProblemsError, read
from driftfit.service.supervisor import Service, log_to_stderr

__all__ = ["DEMO", "ProblemsError", "configured", "described", "greeting", "rebuild", "run"]
DEMO = Path(__file__).parent / "demo.toml"


def configured(file: Path, port: int | None, folder: Path | None) -> tuple[Config, Path]:
    """(the configuration, the folder of the data), as changed by the command line."""
    config = read(file)
    if port is not None:
        config = replace(config, page=replace(config.page, port=port))
    return config, folder or Path(config.service.folder)


def described(config: Config) -> str:
    """A valid configuration in words."""
    lines = [f"The configuration is valid: {len(config.sources)} sources, {len(config.units)} sections of units, "
             f"{len(config.sinks)} sinks."]  # fmt: skip
    for unit in config.units:
        inputs = ", ".join(unit.u) or "its own past"
        lines.append(
            f"  {unit.match.text}: {unit.y} from {inputs}, {unit.model!r}, {unit.tracker!r}"
            + ("" if unit.gate else ", without a gate")
        )
    return "\n".join(lines)


def greeting(config: Config, folder: Path) -> str:
    """The messages at the start."""
    page = config.page
    scheme = "https" if page.certificate else "http"
    where = f"{scheme}://{page.host}:{page.port}/" if page.enabled else "no page"
    return f"driftfit serve: {where}  (data in {folder}; Ctrl-C stops)"


def rebuild(folder: Path) -> None:
    """Let the service compute all states again from its journal."""
    Journal(folder, rebuild=True).close()


def run(config: Config, folder: Path) -> None:
    """Run until a signal."""
    log_to_stderr(config.service.log)
    Service(config, folder).run()
