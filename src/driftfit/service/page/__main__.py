"""The process of the page; the service starts it and sends it its settings on standard input."""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path

import uvicorn

from driftfit.service.page.app import Page
from driftfit.service.page.connections import Connection
from driftfit.service.page.feed import Feed
from driftfit.service.page.passwords import Sessions
from driftfit.service.settings.options import PageOptions, build


def main() -> None:
    """Serve until the service ends, which closes the standard input."""
    given = json.loads(sys.stdin.readline())
    options = build(PageOptions, given["page"])
    folder = Path(given["folder"])
    threading.Thread(target=_watch, daemon=True).start()
    page = Page(options, Feed(folder, Path(given["control"])), Sessions(folder))
    uvicorn.run(
        page.app(), host=options.host, port=options.port, log_level="warning", access_log=False, server_header=False,
        proxy_headers=options.behind_proxy, ssl_certfile=options.certificate or None, ssl_keyfile=options.key or None,
        http=Connection, limit_concurrency=500, timeout_keep_alive=10, timeout_graceful_shutdown=3, ws_max_size=4096,
        h11_max_incomplete_event_size=65536,
    )  # fmt: skip


def _watch() -> None:
    """End with the service."""
    while sys.stdin.read(1):
        pass
    os._exit(0)


main()
