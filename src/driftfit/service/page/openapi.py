"""The description of the HTTP interface, in OpenAPI 3.1."""

from __future__ import annotations

from typing import Any

from driftfit.engine import __version__


def _path(method: str, summary: str, query: dict[str, str] | None = None, body: Any = None) -> dict[str, Any]:
    """One operation; ``query`` maps names to descriptions, and those that end with an asterisk are required."""
    found: dict[str, Any] = {
        "summary": summary,
        "responses": {
            "200": {"description": "done"},
            "default": {"description": "refused", "content": {"application/json": {"schema": _ERROR}}},
        },
    }
    if query:
        found["parameters"] = [
            {"name": name.rstrip("*"), "in": "query", "required": name.endswith("*"), "description": about,
             "schema": {"type": "string"}}
            for name, about in query.items()
        ]  # fmt: skip
    if body is not None:
        found["requestBody"] = {"required": True, "content": {"application/json": {"schema": body}}}
    return {method: found}


_ERROR = {"type": "object", "properties": {"error": {"type": "string"}}}
_CELL = {"type": ["number", "string", "null"]}
_CELLS = {"type": "object", "additionalProperties": {"oneOf": [_CELL, {"type": "array", "items": _CELL}]}}
_SAMPLES = {"oneOf": [_CELLS, {"type": "array", "items": _CELLS}]}
_ACTION = {
    "type": "object", "required": ["unit", "do", "why"],
    "properties": {
        "unit": {"type": "string"}, "do": {"enum": ["hold", "reset", "acknowledge", "limits", "restart"]},
        "why": {"type": "string", "minLength": 3, "maxLength": 500},
        "on": {"type": "boolean", "description": "hold: on or off"},
        "p": {"type": "number", "description": "reset: variance of the change"},
        "theta": {"description": "reset: new values"}, "which": {"description": "reset: names of parameters"},
        "limits": {"type": "object", "description": "limits: a range [low, high] by signal"},
    },
}  # fmt: skip
_RANGE = {"unit*": "name of the unit", "from": "first time, seconds", "to": "last time, seconds"}


def _named(operation: dict[str, Any], name: str) -> dict[str, Any]:
    """An operation with a part of the path as parameter."""
    parameter = {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
    return {**operation, "parameters": [parameter]}


DESCRIPTION: dict[str, Any] = {
    "openapi": "3.1.0",
    "info": {"title": "driftfit serve", "version": __version__},
    "security": [{}, {"token": []}, {"session": []}],
    "components": {"securitySchemes": {
        "token": {"type": "http", "scheme": "bearer"},
        "session": {"type": "apiKey", "in": "cookie", "name": "driftfit"},
    }},
    "paths": {
        "/api/units": _path("get", "The units that drift most, or a search.", {"search": "part of a name"}),
        "/api/units/{id}": _named(_path("get", "Parameters, state and counts of a unit."), "id"),
        "/api/history": _path("get", "Least, largest and mean of every column.", _RANGE | {"points": "10 to 5000"}),
        "/api/export": _path("get", "All samples of a range.", _RANGE | {"format": "csv or arrow"}),
        "/api/events": _path("get", "Alarms, failures and actions.", {"unit": "name", "limit": "1 to 1000"}),
        "/api/status": _path("get", "Numbers of the service."),
        "/api/me": _path("get", "Name and role of the user."),
        "/api/samples": _path(
            "post", "Samples by topic; answered once they are in the journal, with those that were left out.",
            body={"type": "object", "additionalProperties": _SAMPLES},
        ),
        "/api/samples/{topic}": _named(_path("post", "Samples of one topic.", body=_SAMPLES), "topic"),
        "/api/actions": _path("post", "An operator's action.", body=_ACTION),
        "/api/login": _path("post", "A session.", body={"type": "object", "required": ["name", "password"]}),
        "/api/logout": _path("post", "End the session."),
        "/metrics": _path("get", "Numbers for Prometheus."),
        "/healthz": _path("get", "200 if the service is healthy, 503 otherwise."),
    },
}  # fmt: skip
