"""The HTTP interface and the WebSocket, on Starlette."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import polars as pl
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from driftfit.data.files import without_formulas
from driftfit.engine import __version__
from driftfit.service.control import health
from driftfit.service.options import PageOptions
from driftfit.service.page.access import COOKIE, SESSION_SECONDS, Access, Rates, Sessions, password_fits
from driftfit.service.page.feed import (
    Feed,
    column_names,
    columns_of,
    metrics_of,
    newest_blocks,
    reduced,
    samples,
)

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


STATIC = Path(__file__).parent / "static"
LOGIN_RATE = 0.1
"""Attempts a second to log in, of one client on average; ten at once."""
IDENTIFY_SECONDS = 180.0
"""For a record from which a unit is made."""
REFRESH_SECONDS = 0.4
"""Time between two messages to an open page."""
REQUEST_BYTES = 2000
"""Size of a message from an open page, at most."""


class Page:
    """The endpoints."""

    def __init__(self, options: PageOptions, feed: Feed, sessions: Sessions) -> None:
        self.options, self.feed, self.sessions = options, feed, sessions
        self.sockets = Sockets(feed, options.viewers)
        self.logins = Rates(LOGIN_RATE, 100.0)
        self.scrypt, self.identifying = asyncio.Semaphore(1), asyncio.Lock()

    def app(self) -> Starlette:
        api: list[BaseRoute] = [
            *(Route(one.path, getattr(self, one.name), methods=[one.method.upper()]) for one in OPERATIONS),
            Route("/api/openapi.json", lambda request: JSONResponse(description())),
        ]
        files = {"/": "index.html", "/login": "login.html", "/api": "api.html"}
        pages: list[BaseRoute] = [Route(path, self.file(name)) for path, name in files.items()]
        others: list[BaseRoute] = [
            WebSocketRoute("/ws", self.sockets.endpoint),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        errors: Any = {
            HTTPException: lambda request, error: JSONResponse({"error": error.detail}, error.status_code),
            ValueError: lambda request, error: JSONResponse({"error": str(error)}, 400),
            ClientDisconnect: lambda request, error: PlainTextResponse("", 400),
        }
        middleware = [Middleware(Access, page=self.options, sessions=self.sessions)]
        return Starlette(
            routes=[*api, *pages, *others], middleware=middleware, exception_handlers=errors, lifespan=self.lifespan
        )

    @contextlib.asynccontextmanager
    async def lifespan(self, app: Starlette) -> AsyncIterator[None]:
        """The feed runs as long as the page."""
        task = asyncio.create_task(self.feed.run())
        yield
        task.cancel()

    def file(self, name: str) -> Any:
        """A page of the folder ``static``."""

        async def send(request: Request) -> Response:
            return FileResponse(STATIC / name)

        return send

    def number(self, name: str) -> int:
        """The number of a unit; 404 if there is none."""
        found = self.feed.find(name)
        if found is None:
            raise HTTPException(404, f"there is no unit {name!r}")
        return found

    async def units(self, request: Request) -> Response:
        search = request.query_params.get("search", "").lower()[:200]
        if not search:
            return Answer({"units": self.feed.fleet, "count": len(self.feed.names.names)})
        matching, now = (name for name in self.feed.names.about if search in name.lower()), time.time()
        found = [self.feed.shown(name, now) | {"age": None} for name in islice(matching, 200)]
        return Answer({"units": found, "count": len(found)})

    async def unit(self, request: Request) -> Response:
        name = request.path_params["unit"]
        number = self.number(name)
        row, about = self.feed.latest.get(number), self.feed.names.about[name]
        try:
            state = await self.feed.ask({"do": "unit", "unit": name})
        except OSError:
            state = {"error": "the engine does not answer"}
        now = {}
        if row is not None:
            named = {what: dict(zip(about["names"], getattr(row, what), strict=False)) for what in ("theta", "std")}
            now = row._asdict() | named | {"unit": name}
        return Answer({"unit": name, "about": about, "now": now, "state": state})

    async def history(self, request: Request) -> Response:
        start, stop = _range(request)
        points = min(max(int(_number(request, "points", 600.0)), 10), 5000)
        name = request.query_params.get("unit", "")
        number = self.number(name)
        recent = await self.feed.recent(number)
        found = await run_in_threadpool(reduced, self.feed.journal, number, recent, start, stop, points)
        return Answer({"unit": name, "columns": column_names(self.feed.names.about[name]), **found})

    async def export(self, request: Request) -> Response:
        start, stop = _range(request)
        name, kind = request.query_params.get("unit", ""), request.query_params.get("format", "csv")
        number = self.number(name)
        if kind not in ("csv", "arrow"):
            raise HTTPException(400, f"format must be csv or arrow; got {kind!r}")
        recent = await self.feed.recent(number)
        names = column_names(self.feed.names.about[name])

        def made() -> bytes:
            values = samples(self.feed.journal, number, recent, start, stop)
            table = pl.DataFrame(values, schema=dict.fromkeys(names[: values.shape[1]], pl.Float64))
            if kind == "csv":
                return without_formulas(table).write_csv().encode()
            file = io.BytesIO()
            table.write_ipc(file)
            return file.getvalue()

        types = {"csv": "text/csv; charset=utf-8", "arrow": "application/vnd.apache.arrow.file"}
        headers = {"content-disposition": f'attachment; filename="{_safe(name)}.{kind}"'}
        return Response(await run_in_threadpool(made), media_type=types[kind], headers=headers)

    async def events(self, request: Request) -> Response:
        limit = min(max(int(_number(request, "limit", 100.0)), 1), 1000)
        name = request.query_params.get("unit")
        where, values = ("where unit = ?", [self.number(name)]) if name else ("", [])
        where += " order by rowid desc limit ?"
        rows = await run_in_threadpool(lambda: [*self.feed.journal.rows("event", where, *values, limit)])
        self.feed.names.read()
        names = self.feed.names.names
        found = [{"number": n, "unit": names.get(u, ""), "at": at, "kind": kind, "detail": json.loads(detail)}
                 for n, u, at, kind, detail, _ in rows]  # fmt: skip
        return Answer({"events": found})

    async def status(self, request: Request) -> Response:
        return Answer(self.feed.status | {"viewers": self.sockets.count, "healthy": self.feed.healthy})

    async def me(self, request: Request) -> Response:
        user = request.scope["user"]
        return Answer({"name": user.name, "role": user.role, "login": bool(self.options.user)})

    async def samples(self, request: Request) -> Response:
        user = request.scope["user"]
        if user.role == "viewer":
            raise HTTPException(403, f"{user.name} is a viewer; this needs a sender or an operator")
        client = user.name if self.options.user else request.client.host if request.client else "local"
        header = {"do": "samples", "topic": request.path_params.get("topic", ""), "units": user.units, "client": client}
        return await self.asked(header, await request.body())

    async def actions(self, request: Request) -> Response:
        """An operator's action: {"unit": ..., "do": "hold", "on": true, "why": "..."}."""
        user = self.operator(request)
        try:
            given = msgspec.json.decode(await request.body(), type=dict[str, Any])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            raise HTTPException(400, "the body is not an object in JSON") from None
        name, do, why = given.pop("unit", None), given.get("do"), given.get("why", "")
        if do not in ACTIONS:
            raise HTTPException(400, f"do must be one of {', '.join(ACTIONS)}")
        if not isinstance(name, str) or not isinstance(why, str) or not 3 <= len(why.strip()) <= 500:
            raise HTTPException(400, "give the unit, and in why the reason, in 3 to 500 characters")
        given |= {"who": user, "why": why.strip()}
        self.number(name)
        return await self.asked({"do": "act", "unit": name, "action": given})

    async def identify(self, request: Request) -> Response:
        """What `driftfit identify` says of a record, with its page; one record at a time, in a process of its own."""
        self.operator(request)
        if self.identifying.locked():
            raise HTTPException(429, "another record is being identified; wait until it is done")
        name, y = _safe(request.query_params.get("name", "")) or "unit", request.query_params.get("y", "")
        async with self.identifying:
            with tempfile.TemporaryDirectory() as folder:
                place = Path(folder)
                (place / f"{name}.csv").write_bytes(await request.body())
                options = ["--quiet", "--json", "-", "--page", "page.html", *([f"--y={y}"] if y else [])]
                process = await asyncio.create_subprocess_exec(
                    sys.executable, "-m", "driftfit", "identify", f"./{name}.csv", *options,
                    cwd=place, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
                )  # fmt: skip
                try:
                    found, said = await asyncio.wait_for(process.communicate(), IDENTIFY_SECONDS)
                except TimeoutError:
                    raise HTTPException(503, "the record takes too long; identify a shorter one") from None
                finally:
                    if process.returncode is None:
                        process.kill()
                if not found:
                    raise HTTPException(400, said.decode(errors="replace").strip()[-1000:])
                page = (place / "page.html").read_text(encoding="utf-8")
        return Answer(json.loads(found) | {"page": page})

    async def asked(self, header: dict[str, Any], body: bytes = b"") -> Response:
        try:
            answer = await self.feed.ask(header, body)
        except (OSError, asyncio.IncompleteReadError):
            return Answer({"error": "the engine does not answer"}, 503)
        return Answer(answer, answer.pop("status", 200))

    def operator(self, request: Request) -> str:
        user = request.scope["user"]
        if user.role != "operator":
            raise HTTPException(403, f"{user.name} is a viewer; this needs an operator")
        return str(user.name)

    async def login(self, request: Request) -> Response:
        client = request.client.host if request.client else "local"
        if not self.logins.allows(client):
            raise HTTPException(429, "too many attempts; wait a while")
        try:
            given = msgspec.json.decode(await request.body(), type=dict[str, str])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            raise HTTPException(400, "the body is not an object of texts in JSON") from None
        name, password = given.get("name", ""), given.get("password", "")[:200]
        found = next((one for one in self.options.user if one.name == name and one.password), None)
        stored = found.password if found else "scrypt$16384$AAAA$AAAA"  # an unknown name takes as long
        async with self.scrypt:
            fits = await run_in_threadpool(password_fits, password, stored)
        if found is None or not fits:
            raise HTTPException(401, "name or password is wrong")
        response = Answer({"name": name, "role": found.role})
        secure = bool(self.options.certificate) or self.options.behind_proxy
        response.set_cookie(
            COOKIE, self.sessions.new(found), int(SESSION_SECONDS), httponly=True, samesite="strict", secure=secure
        )
        return response

    async def logout(self, request: Request) -> Response:
        self.sessions.end(request.cookies.get(COOKIE, ""))
        response = Answer({})
        response.delete_cookie(COOKIE)
        return response

    async def metrics(self, request: Request) -> Response:
        media = "text/plain; version=0.0.4; charset=utf-8"
        return PlainTextResponse(metrics_of(self.feed, self.sockets.count), media_type=media)

    async def healthz(self, request: Request) -> Response:
        return JSONResponse(*health(self.feed.status, self.feed.alive, request.scope["user"] is not None))


def _safe(name: str) -> str:
    """The name of a file."""
    return "".join(one if one.isalnum() or one in "-_" else "_" for one in name)[:100]


class Answer(JSONResponse):
    """JSON by msgspec, which writes NaN as null."""

    def render(self, content: Any) -> bytes:
        text: bytes = msgspec.json.encode(content)
        return text


def _number(request: Request, name: str, default: float) -> float:
    """A number of the query; 400 if it is none."""
    given = request.query_params.get(name)
    try:
        found = default if given is None else float(given)
    except ValueError:
        found = float("nan")
    if found != found or (name in ("points", "limit") and abs(found) > 1e9):
        raise HTTPException(400, f"{name} must be a number; got {str(given)[:50]!r}")
    return found


def _range(request: Request) -> tuple[float, float]:
    return _number(request, "from", float("-inf")), _number(request, "to", float("inf"))


class Sockets:
    """The open pages: two and a half times a second the overview, or the new results of one unit.

    A page states what it shows: {"view": "fleet"} or {"view": "unit", "unit": "pump 7"}. Each viewer has a separate
    task, which waits for that viewer only; one that is slow is sent less often.
    """

    def __init__(self, feed: Feed, most: int) -> None:
        self.feed, self.most = feed, most
        self.count = 0
        self._of: Counter[str] = Counter()
        """Open pages by client."""

    async def endpoint(self, socket: WebSocket) -> None:
        """Serve one page until it closes."""
        await socket.accept()
        client = socket.client.host if socket.client else "local"
        if self.count >= self.most or self._of[client] >= max(1, self.most // 2):
            await socket.close(4429, "too many open pages")
            return
        self.count += 1
        self._of[client] += 1
        view: dict[str, Any] = {"view": "fleet", "unit": "", "at": 0}
        sender = asyncio.create_task(self._send(socket, view))
        try:
            while True:
                text = await socket.receive_text()
                if len(text) > REQUEST_BYTES:
                    break
                given = msgspec.json.decode(text, type=dict[str, str])
                view |= {"view": given.get("view", "fleet"), "unit": given.get("unit", ""), "at": 0}
        except (WebSocketDisconnect, msgspec.DecodeError, KeyError, RuntimeError):
            pass
        finally:
            self.count -= 1
            self._of -= Counter([client])
            sender.cancel()
            with contextlib.suppress(RuntimeError):  # it may be closed
                await socket.close(4400)

    async def _send(self, socket: WebSocket, view: dict[str, Any]) -> None:
        """Messages until the page is gone."""
        try:
            while socket.scope["still"]() is not None:
                message = await self._message(view)
                await socket.send_text(msgspec.json.encode(message).decode())
                await asyncio.sleep(REFRESH_SECONDS)
            await socket.close(4401, "the session has ended")
        except (WebSocketDisconnect, RuntimeError):
            pass

    async def _message(self, view: dict[str, Any]) -> dict[str, Any]:
        feed = self.feed
        status = {name: feed.status.get(name) for name in ("samples", "units", "problem", "reasons", "p99")}
        status["alive"] = feed.healthy
        if view["view"] != "unit":
            return {"view": "fleet", "status": status, "units": feed.fleet}
        number = feed.find(view["unit"])
        if number is None:
            return {"view": "unit", "unit": view["unit"], "status": status, "missing": True}
        unit, after = view["unit"], view["at"]
        recent = await feed.recent(number)
        rows = [row for row in recent if row.number > after]
        columns = columns_of(rows).T.tolist() if rows else []
        if after == 0:
            columns = (await asyncio.to_thread(newest_blocks, feed.journal, number, recent)).T.tolist()
        if unit == view["unit"] and rows:
            view["at"] = max(row.number for row in rows)
        on = rows[-1].alarm if rows else None
        return {"view": "unit", "unit": unit, "status": status, "columns": columns, "alarm": on}
