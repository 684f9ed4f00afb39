"""The operations of the HTTP interface, and their description in OpenAPI 3.1."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from driftfit.engine import __version__

ACTIONS = ("hold", "reset", "acknowledge", "limits", "restart")
_ERROR = {"type": "object", "properties": {"error": {"type": "string"}}}
_CELL = {"type": ["number", "string", "null"]}
_CELLS = {"type": "object", "additionalProperties": {"oneOf": [_CELL, {"type": "array", "items": _CELL}]}}
_SAMPLES = {"oneOf": [_CELLS, {"type": "array", "items": _CELLS}]}
_ACTION = {
    "type": "object", "required": ["unit", "do", "why"],
    "properties": {
        "unit": {"type": "string"}, "do": {"enum": [*ACTIONS]},
        "why": {"type": "string", "minLength": 3, "maxLength": 500},
        "on": {"type": "boolean", "description": "hold: on or off"},
        "p": {"type": "number", "description": "reset: variance of the change"},
        "theta": {"description": "reset: new values"}, "which": {"description": "reset: names of parameters"},
        "limits": {"type": "object", "description": "limits: a range [low, high] by signal"},
    },
}  # fmt: skip
_RANGE = {"unit*": "name of the unit", "from": "first time, seconds", "to": "last time, seconds"}


class Operation(NamedTuple):
    """One operation, which a method of the page of this ``name`` carries out."""

    path: str
    name: str
    summary: str
    query: Mapping[str, str] = {}
    """Descriptions by name; those that end with an asterisk are required."""
    body: Any = None
    """Its schema."""
    method: str = "get"
    media: str = "application/json"
    """The type of the body."""

    def described(self) -> dict[str, Any]:
        found: dict[str, Any] = {
            "summary": self.summary,
            "responses": {
                "200": {"description": "done"},
                "default": {"description": "refused", "content": {"application/json": {"schema": _ERROR}}},
            },
        }
        text = {"type": "string"}
        if self.query:
            found["parameters"] = [
                {"name": name.rstrip("*"), "in": "query", "required": name.endswith("*"), "description": about,
                 "schema": text}
                for name, about in self.query.items()
            ]  # fmt: skip
        elif "{" in self.path:
            name = self.public.partition("{")[2].rstrip("}")
            found["parameters"] = [{"name": name, "in": "path", "required": True, "schema": text}]
        if self.body is not None:
            found["requestBody"] = {"required": True, "content": {self.media: {"schema": self.body}}}
        return {self.method: found}

    @property
    def public(self) -> str:
        return self.path.replace("{unit:path}", "{id}").replace(":path", "")


OPERATIONS = (
    Operation("/api/units", "units", "The units that drift most, or a search.", {"search": "part of a name"}),
    Operation("/api/units/{unit:path}", "unit", "Parameters, state and counts of a unit."),
    Operation("/api/history", "history", "Least, largest and mean of every column.", _RANGE | {"points": "10 to 5000"}),
    Operation("/api/export", "export", "All samples of a range.", _RANGE | {"format": "csv or arrow"}),
    Operation("/api/events", "events", "Alarms, failures and actions.", {"unit": "name", "limit": "1 to 1000"}),
    Operation("/api/status", "status", "Numbers of the service."),
    Operation("/api/me", "me", "Name and role of the user."),
    Operation("/api/samples", "samples",
              "Samples by topic; answered once they are in the journal, with those that were left out.",
              body={"type": "object", "additionalProperties": _SAMPLES}, method="post"),
    Operation("/api/samples/{topic:path}", "samples", "Samples of one topic.", body=_SAMPLES, method="post"),
    Operation("/api/actions", "actions", "An operator's action.", body=_ACTION, method="post"),
    Operation("/api/identify", "identify", "A unit from a record in CSV: its model, what moved, a page.",
              {"y": "the output", "name": "name of the unit"}, {"type": "string"}, "post", "text/csv"),
    Operation("/api/login", "login", "A session.", body={"type": "object", "required": ["name", "password"]},
              method="post"),
    Operation("/api/logout", "logout", "End the session.", method="post"),
    Operation("/metrics", "metrics", "Numbers for Prometheus."),
    Operation("/healthz", "healthz", "200 if the service is healthy, 503 otherwise."),
)  # fmt: skip


def description() -> dict[str, Any]:
    return {
        "openapi": "3.1.0",
        "info": {"title": "driftfit serve", "version": __version__},
        "security": [{}, {"token": []}, {"session": []}],
        "components": {"securitySchemes": {
            "token": {"type": "http", "scheme": "bearer"},
            "session": {"type": "apiKey", "in": "cookie", "name": "driftfit"},
        }},
        "paths": {one.public: one.described() for one in OPERATIONS},
    }  # fmt: skip
