"""The HTTP interface and the WebSocket, on Starlette."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

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

from driftfit.data.csv_files import without_formulas
from driftfit.service.health import health
from driftfit.service.page import history, metrics, openapi
from driftfit.service.page.access import COOKIE, Access, Rates
from driftfit.service.page.feed import Feed, finite
from driftfit.service.page.passwords import SESSION, Sessions, password_fits
from driftfit.service.page.sockets import Sockets
from driftfit.service.settings.options import PageOptions

STATIC = Path(__file__).parent / "static"
LOGINS = 0.1
"""Attempts a second to log in, of one client on average; ten at once."""
ACTIONS = ("hold", "reset", "acknowledge", "limits", "restart")


class Page:
    """The endpoints."""

    def __init__(self, options: PageOptions, feed: Feed, sessions: Sessions) -> None:
        self.options, self.feed, self.sessions = options, feed, sessions
        self.sockets = Sockets(feed, options.viewers)
        self.logins = Rates(LOGINS, 100.0)
        self.scrypt = asyncio.Semaphore(1)

    def app(self) -> Starlette:
        """The application."""
        api: list[BaseRoute] = [
            Route("/api/units", self.units),
            Route("/api/units/{unit:path}", self.unit),
            Route("/api/history", self.history),
            Route("/api/export", self.export),
            Route("/api/events", self.events),
            Route("/api/status", self.status),
            Route("/api/me", self.me),
            Route("/api/samples", self.samples, methods=["POST"]),
            Route("/api/samples/{topic:path}", self.samples, methods=["POST"]),
            Route("/api/actions", self.actions, methods=["POST"]),
            Route("/api/login", self.login, methods=["POST"]),
            Route("/api/logout", self.logout, methods=["POST"]),
            Route("/api/openapi.json", lambda request: JSONResponse(openapi.DESCRIPTION)),
        ]
        pages: list[BaseRoute] = [
            Route(path, self.file(name))
            for path, name in (("/", "index.html"), ("/login", "login.html"), ("/api", "api.html"))
        ]
        others: list[BaseRoute] = [
            Route("/metrics", self.metrics),
            Route("/healthz", self.healthz),
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
        """The units that drift most, or those whose name contains ``search``."""
        search = request.query_params.get("search", "").lower()[:200]
        if not search:
            return Answer({"units": self.feed.fleet, "count": len(self.feed.names.names)})
        feed, found, now = self.feed, [], time.time()
        for name in feed.names.about:
            if search in name.lower():
                found.append(feed.shown(name, now) | {"age": None})
            if len(found) == 200:
                break
        return Answer({"units": found, "count": len(found)})

    async def unit(self, request: Request) -> Response:
        """Everything about a unit now."""
        name = request.path_params["unit"]
        number = self.number(name)
        row = self.feed.latest.get(number)
        about = self.feed.names.about[name]
        try:
            state = await self.feed.ask({"do": "unit", "unit": name})
        except OSError:
            state = {"error": "the engine does not answer"}
        now = {}
        if row is not None:
            names = about["names"]
            now = {
                "number": row[0], "time": row[2], "y": finite(row[3]), "y_hat": finite(row[4]), "e": finite(row[5]),
                "s": finite(row[6]), "ok": row[7], "alarm": row[10],
                "theta": dict(zip(names, map(finite, row[8]), strict=False)),
                "std": dict(zip(names, map(finite, row[9]), strict=False)),
            }  # fmt: skip
        return Answer({"unit": name, "about": about, "now": now, "state": state})

    async def history(self, request: Request) -> Response:
        """Least, largest and mean of each column of a range, in at most ``points`` parts."""
        start, stop = _range(request)
        points = min(max(int(_number(request, "points", 600.0)), 10), 5000)
        name = request.query_params.get("unit", "")
        number = self.number(name)
        recent = await self.feed.recent(number)
        found = await run_in_threadpool(history.reduced, self.feed.journal, number, recent, start, stop, points)
        return Answer({"unit": name, "columns": history.names_of(self.feed.names.about[name]), **found})

    async def export(self, request: Request) -> Response:
        """All columns of a range, as CSV or an Arrow file."""
        start, stop = _range(request)
        name, kind = request.query_params.get("unit", ""), request.query_params.get("format", "csv")
        number = self.number(name)
        if kind not in ("csv", "arrow"):
            raise HTTPException(400, f"format must be csv or arrow; got {kind!r}")
        recent = await self.feed.recent(number)
        names = history.names_of(self.feed.names.about[name])

        def made() -> bytes:
            values = history.samples(self.feed.journal, number, recent, start, stop)
            table = pl.DataFrame(values, schema=dict.fromkeys(names[: values.shape[1]], pl.Float64))
            if kind == "csv":
                return without_formulas(table).write_csv().encode()
            file = io.BytesIO()
            table.write_ipc(file)
            return file.getvalue()

        safe = "".join(one if one.isalnum() or one in "-_" else "_" for one in name)[:100]
        types = {"csv": "text/csv; charset=utf-8", "arrow": "application/vnd.apache.arrow.file"}
        headers = {"content-disposition": f'attachment; filename="{safe}.{kind}"'}
        return Response(await run_in_threadpool(made), media_type=types[kind], headers=headers)

    async def events(self, request: Request) -> Response:
        """The last events, of one unit or of all."""
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
        """Numbers of the service."""
        return Answer(self.feed.status | {"viewers": self.sockets.count, "healthy": self.feed.healthy})

    async def me(self, request: Request) -> Response:
        """Who asks."""
        user = request.scope["user"]
        return Answer({"name": user.name, "role": user.role, "login": bool(self.options.user)})

    async def samples(self, request: Request) -> Response:
        """Take samples; the answer comes when they are in the journal."""
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

    async def asked(self, header: dict[str, Any], body: bytes = b"") -> Response:
        """The engine's answer."""
        try:
            answer = await self.feed.ask(header, body)
        except (OSError, asyncio.IncompleteReadError):
            return Answer({"error": "the engine does not answer"}, 503)
        return Answer(answer, answer.pop("status", 200))

    def operator(self, request: Request) -> str:
        """The name of the user, who must be an operator."""
        user = request.scope["user"]
        if user.role != "operator":
            raise HTTPException(403, f"{user.name} is a viewer; this needs an operator")
        return str(user.name)

    async def login(self, request: Request) -> Response:
        """A session, for a name and a password."""
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
            COOKIE, self.sessions.new(found), max_age=int(SESSION), httponly=True, samesite="strict", secure=secure
        )
        return response

    async def logout(self, request: Request) -> Response:
        """End the session."""
        self.sessions.end(request.cookies.get(COOKIE, ""))
        response = Answer({})
        response.delete_cookie(COOKIE)
        return response

    async def metrics(self, request: Request) -> Response:
        """For Prometheus."""
        return PlainTextResponse(metrics.text(self.feed, self.sockets.count), media_type=metrics.TYPE)

    async def healthz(self, request: Request) -> Response:
        """200 if the engine answers and the journal can be written; with what does not work besides."""
        return JSONResponse(*health(self.feed.status, self.feed.alive, request.scope["user"] is not None))


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
