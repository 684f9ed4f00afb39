"""HTTP: samples that clients send to ``POST /api/samples`` of the page; and a POST for every alarm (or other event).

Samples are answered once they are in the journal. An event goes as JSON to a chat, a pager, a phone:

    {"unit": "pump 7", "kind": "alarm", "at": "2026-01-31T12:00:00+00:00", "text": "...", "detail": {...}}

``title`` and ``text`` are what services such as Mattermost show. With ``body = "text"`` the text alone is sent, and the
unit as the header ``Title``: so the app of ntfy shows it on a phone. Only an answer of 2xx counts as delivered. A
redirect is not followed: it makes a GET without a body of the POST, and would give the token to another address. The
header ``Idempotency-Key`` is the same when an event comes again."""

from __future__ import annotations

import json
import queue
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, ClassVar, Literal
from urllib.parse import urlsplit

import msgspec

from driftfit.service.connect.base import (
    ANSWER_SECONDS,
    NAMED_SAMPLES,
    NO_SIGNAL,
    TOO_MANY_NEW,
    Batch,
    Event,
    Outcome,
    Reader,
    Receipt,
    RefusedError,
    Samples,
    ShapeError,
    Sink,
    Source,
    Writer,
    decode,
)
from driftfit.service.options import Secret

SENT_BEFORE = frozenset({"late", "duplicate"})
"""Reasons for which a sender need not mend anything: it has sent the samples before, or others were faster."""
TOO_FAST = frozenset({"flood", TOO_MANY_NEW})
"""Reasons for which a sender has to wait."""
_BODY = msgspec.json.Decoder(dict[str, msgspec.Raw])


@dataclass(frozen=True)
class HttpSource(Source):
    """Samples over HTTP; host, port and tokens are those of [page]. Clients keep what is not yet acknowledged."""

    def open(self, position: Any) -> Reader:
        return _Http()


class _Http(Reader):
    def read(self, wait: float) -> Batch | None:
        try:
            return INCOMING.queue.get(timeout=wait)
        except queue.Empty:
            return None


class Incoming:
    """Samples that came over HTTP and wait for the source of kind http; bounded, so senders wait."""

    def __init__(self, most: int = 256) -> None:
        self.queue: queue.Queue[Batch] = queue.Queue(most)

    def offer(
        self, topic: str, body: bytes, client: str = "", foreign: Callable[[str], list[str]] = lambda topic: []
    ) -> dict[str, Any]:
        """Decode a request, wait until it is in the journal, and report what was received and what was left out.

        Nothing is taken if ``foreign`` names units of a topic, which the sender may not touch: the status is then 403.
        The status is 200 if anything was taken, or all of it was known already; 400 if nothing is JSON, 429 if it was
        too much for the rate of its unit, and 422 if there are no samples in it, or no unit could use them.
        """
        samples, refused, shaped = decoded(topic, body)
        for name, units in ((one.topic, foreign(one.topic)) for one in samples):
            if units:
                return {"error": f"this sender may not send samples of {', '.join(units)} ({name}).", "status": 403}
        done, receipt = threading.Event(), Receipt()
        batch = Batch(samples, done.set, client=client, refused=len(refused), arrived=time.monotonic(), receipt=receipt)
        try:
            self.queue.put(batch, timeout=ANSWER_SECONDS)
        except queue.Full:
            return {"error": "busy: samples are held back; try again later", "status": 503}
        if not done.wait(ANSWER_SECONDS):
            return {"error": "the journal does not take samples now; try again later", "status": 503}
        received, left_out = sum(one.length for one in samples), receipt.left_out
        refused = refused[:NAMED_SAMPLES]
        answer: dict[str, Any] = {"received": received, "refused": refused, "left_out": dict(left_out)}
        if not samples:
            error = "; ".join(refused) or "the body has no topic."
            return answer | {"error": error, "status": 422 if shaped else 400}
        if receipt.missing:
            answer["missing"] = receipt.missing
        reasons = left_out.keys() - {NO_SIGNAL} or left_out.keys()  # a unit that does not read a signal refuses nothing
        if left_out.total() < receipt.offered or reasons <= SENT_BEFORE:
            return answer
        why = ", ".join(f"{reason} ({count})" for reason, count in left_out.items())
        return answer | {"error": f"no sample was taken: {why}.", "status": 429 if TOO_FAST & left_out.keys() else 422}


INCOMING = Incoming()
"""The one queue of this process."""


def decoded(topic: str, body: bytes) -> tuple[list[Samples], list[str], bool]:
    """Samples of one topic, or of a mapping from topics to payloads; what could not be read; and whether all of that is
    JSON in another shape.
    """
    if topic:
        try:
            return [decode(topic, body)], [], False
        except ValueError as error:
            return [], [str(error)], isinstance(error, ShapeError)
    parts = _payloads(body)
    if parts is None:
        return [], ["the body is not an object with a payload for each topic, in JSON."], False
    samples, refused, shaped = [], [], bool(parts)
    for name, payload in parts.items():
        try:
            samples.append(decode(name, bytes(payload)))
        except ValueError as error:
            refused.append(f"{name[:100]}: {error}")
            shaped = shaped and isinstance(error, ShapeError)
    return samples, refused, shaped


def _payloads(body: bytes) -> Mapping[str, Any] | None:
    """The payload of each topic; also of JSON with NaN or Infinity, which Python's own encoder writes."""
    with suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        found: Mapping[str, Any] = _BODY.decode(body)
        return found
    with suppress(ValueError, RecursionError):
        if (b"NaN" in body or b"Infinity" in body) and isinstance(parts := json.loads(body), dict):
            return {name: json.dumps(one).encode() for name, one in parts.items()}
    return None


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
