"""Whether the service works, for supervisors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def health(status: Mapping[str, Any], alive: bool, named: bool) -> tuple[dict[str, Any], int]:
    """(the answer, its status of HTTP) by the status of a service; 503 if it takes no samples.

    It is degraded where units have failed, alarms are not armed, or sources and sinks are away. Not everyone may know
    their names: without ``named`` they are only counted.
    """
    problem = status.get("problem", "") if alive else "the engine does not answer"
    reasons = status.get("reasons", [])
    state = "failing" if problem else "degraded" if reasons else "healthy"
    told = reasons if named or not reasons else [f"{len(reasons)} units, sources or sinks; log in for their names"]
    return {"healthy": not problem, "state": state, "problem": problem, "reasons": told}, 503 if problem else 200
