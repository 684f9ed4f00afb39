"""Webhook: a POST for every alarm (or other event), as JSON, to a chat, a pager, a phone.

    {"unit": "pump 7", "kind": "alarm", "at": "2026-01-31T12:00:00+00:00", "text": "...", "detail": {...}}

``title`` and ``text`` are what services such as Mattermost show. With ``body = "text"`` the text alone is sent, and the
unit as the header ``Title``: so the app of ntfy shows it on a phone. Only an answer of 2xx counts as delivered. A
redirect is not followed: it makes a GET without a body of the POST, and would give the token to another address. The
header ``Idempotency-Key`` is the same when an event comes again.
"""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, ClassVar, Literal
from urllib.parse import urlsplit

from driftfit.service.connect.base import Event, Outcome, RefusedError, Sink, Writer
from driftfit.service.options import Secret

ANSWER_SECONDS = 10.0


@dataclass(frozen=True)
class WebhookSink(Sink):
    """An address to which events are posted."""

    url: str
    events: list[str] = field(default_factory=lambda: ["alarm", "failed"])
    body: Literal["json", "text"] = "json"
    token: Secret | None = None
    """Sent as ``Authorization: Bearer``."""
    one_by_one: ClassVar[bool] = True

    def check(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.hostname or parts.password:
            raise ValueError(f"webhook: url must be https://... without a password; got {self.url!r}.")

    def open(self) -> Writer:
        return _Webhook(self)


class _Webhook(Writer):
    def __init__(self, options: WebhookSink) -> None:
        self.options = options
        self.client = urllib.request.build_opener(_NoRedirect)

    def write(self, batch: Outcome) -> None:
        for event in batch.events:
            if event.kind in self.options.events:
                self._send(event)

    def _send(self, event: Event) -> None:
        content = message(event)
        if self.options.body == "json":
            headers, data = {"Content-Type": "application/json"}, json.dumps(content)
        else:  # in a header only characters of ASCII arrive everywhere
            title = event.unit.encode("ascii", "replace").decode()
            headers, data = {"Content-Type": "text/plain; charset=utf-8", "Title": title}, str(content["text"])
        headers |= {"User-Agent": "driftfit", "Idempotency-Key": event.key}
        if self.options.token is not None:
            headers["Authorization"] = f"Bearer {self.options.token.value}"
        request = urllib.request.Request(self.options.url, data.encode(), headers, method="POST")
        try:
            with self.client.open(request, timeout=ANSWER_SECONDS):
                pass
        except urllib.error.HTTPError as error:
            with error:
                raise RefusedError(f"{urlsplit(self.options.url).hostname} answered {error.code}") from None


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *args: Any) -> None:
        """Leave an answer of 3xx as the error that it is."""


def message(event: Event) -> dict[str, object]:
    detail = dict(event.detail)
    at = datetime.fromtimestamp(event.at, UTC).isoformat(timespec="seconds")
    text = f"{event.unit}: {event.kind}"
    if event.kind == "alarm":
        text = (f"{event.unit}: {detail['kind']} alarm, cause {detail['cause']}, statistic {detail['statistic']:.3g}, "
                f"limit {detail['limit']:.3g}")  # fmt: skip
    return {"unit": event.unit, "kind": event.kind, "at": at, "title": "driftfit", "text": text, "message": text,
            "number": event.number, "detail": detail}  # fmt: skip
