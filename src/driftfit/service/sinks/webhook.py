"""Webhook: a POST for every alarm (or other event), as JSON, to a chat, a pager, a phone.

    {"unit": "pump 7", "kind": "alarm", "at": "2026-01-31T12:00:00+00:00", "text": "...", "detail": {...}}

``title`` and ``text`` are what services such as Mattermost show. With ``body = "text"`` the text alone is sent, and the
unit as the header ``Title``: so the app of ntfy shows it on a phone. An answer other than 2xx is tried again;
a 4xx other than 408 and 429 would not be better later, and is logged and left out. The header ``Idempotency-Key`` is
the same when an event comes again.
"""

from __future__ import annotations

import json
import logging
import urllib.error
import urllib.request
from dataclasses import dataclass, field
from datetime import UTC, datetime
from urllib.parse import urlsplit

from driftfit.service.settings.options import Secret
from driftfit.service.sinks.contract import Event, Outcome, Sink, Writer

log = logging.getLogger("driftfit.service")
TIMEOUT = 10.0


@dataclass(frozen=True)
class Webhook(Sink):
    """An address to which events are posted."""

    url: str
    events: list[str] = field(default_factory=lambda: ["alarm", "failed"])
    body: str = "json"
    """json, or text."""
    token: Secret | None = None
    """Sent as ``Authorization: Bearer``."""

    def check(self) -> None:
        """The address."""
        parts = urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.hostname or parts.password:
            raise ValueError(f"webhook: url must be https://... without a password; got {self.url!r}.")
        if self.body not in ("json", "text"):
            raise ValueError(f"webhook: body must be json or text; got {self.body!r}.")

    def open(self) -> Writer:
        """Nothing is connected before an event."""
        return _Webhook(self)


class _Webhook(Writer):
    def __init__(self, options: Webhook) -> None:
        self.options = options
        self.sent: set[tuple[int, str, str]] = set()

    def write(self, batch: Outcome) -> None:
        """A request for each event; those of the batch that were sent before are left out."""
        for event in batch.events:
            key = (event.number, event.unit, event.kind)
            if event.kind in self.options.events and key not in self.sent:
                self._send(event)
                self.sent.add(key)
        self.sent.clear()

    def _send(self, event: Event) -> None:
        content = message(event)
        if self.options.body == "json":
            headers, data = {"Content-Type": "application/json"}, json.dumps(content)
        else:  # in a header only characters of ASCII arrive everywhere
            title = event.unit.encode("ascii", "replace").decode()
            headers, data = {"Content-Type": "text/plain; charset=utf-8", "Title": title}, str(content["text"])
        headers |= {"User-Agent": "driftfit", "Idempotency-Key": f"{event.number}-{event.kind}"}
        if self.options.token is not None:
            headers["Authorization"] = f"Bearer {self.options.token.value}"
        request = urllib.request.Request(self.options.url, data.encode(), headers, method="POST")
        try:
            with urllib.request.urlopen(request, timeout=TIMEOUT):
                pass
        except urllib.error.HTTPError as error:
            with error:
                if not 400 <= error.code < 500 or error.code in (408, 429):
                    raise ConnectionError(f"{urlsplit(self.options.url).hostname} answered {error.code}") from None
                log.error("webhook refused", extra={"unit": event.unit, "detail": f"status {error.code}"})


def message(event: Event) -> dict[str, object]:
    """An event as JSON."""
    detail = dict(event.detail)
    at = datetime.fromtimestamp(event.at, UTC).isoformat(timespec="seconds")
    text = f"{event.unit}: {event.kind}"
    if event.kind == "alarm":
        text = (f"{event.unit}: {detail['kind']} alarm, {detail['cause']} is {detail['statistic']:.3g}, "
                f"limit {detail['limit']:.3g}")  # fmt: skip
    return {"unit": event.unit, "kind": event.kind, "at": at, "title": "driftfit", "text": text, "message": text,
            "number": event.number, "detail": detail}  # fmt: skip
