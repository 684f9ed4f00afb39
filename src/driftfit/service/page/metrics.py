"""Numbers for Prometheus, in its text format."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from driftfit.service.page.feed import Feed

TYPE = "text/plain; version=0.0.4; charset=utf-8"


def text(feed: Feed, viewers: int) -> str:
    """The page /metrics."""
    return "".join(f"{line}\n" for line in _lines(feed, viewers))


def _lines(feed: Feed, viewers: int) -> Iterator[str]:
    status = feed.status
    yield from _one("driftfit_up", "gauge", "Whether the engine answers and can write its journal.", int(feed.healthy))
    yield from _one("driftfit_samples_total", "counter", "Samples that were processed.", status.get("samples", 0))
    yield from _one("driftfit_units", "gauge", "Units.", status.get("units", 0))
    yield from _one("driftfit_units_failed", "gauge", "Units that have failed.", status.get("failed", 0))
    unarmed = {f'unit="{_label(unit)}",what="{_label(what)}",why="{_label(why)}"': 1
               for unit, found in feed.trouble.items() for what, why in found.items()}  # fmt: skip
    yield from _many("driftfit_trouble", "gauge", "What does not work in units, at most 100 of them.", unarmed)
    alarms = sum(bool(row[10]) for row in feed.latest.values())
    yield from _one("driftfit_units_in_alarm", "gauge", "Units whose alarm is on.", alarms)
    yield from _one("driftfit_waiting_samples", "gauge", "Samples that wait for the journal.", status.get("waiting", 0))
    held = status.get("held_back", 0)
    yield from _one("driftfit_held_back_total", "counter", "How often a source was held back.", held)
    yield from _one("driftfit_viewers", "gauge", "Open pages.", viewers)
    latency = {'quantile="0.5"': status.get("p50"), 'quantile="0.99"': status.get("p99")}
    yield from _many("driftfit_latency_seconds", "gauge", "From arrival to result, of recent batches.", latency)
    refused = {f'reason="{_label(why)}"': count for why, count in status.get("refused", {}).items()}
    yield from _many("driftfit_refused_total", "counter", "What was refused, by reason.", refused)
    left_out = {f'reason="{_label(why)}"': count for why, count in status.get("left_out", {}).items()}
    yield from _many("driftfit_left_out_total", "counter", "Samples that gates left out, by reason.", left_out)
    for what in ("source", "sink"):
        runners: dict[str, Any] = status.get(f"{what}s", {})
        up = {f'{what}="{_label(name)}"': int(one["state"] == "running") for name, one in runners.items()}
        yield from _many(f"driftfit_{what}_up", "gauge", f"Whether the {what} is connected.", up)
        count = {f'{what}="{_label(name)}"': one["count"] for name, one in runners.items()}
        yield from _many(f"driftfit_{what}_samples_total", "counter", f"Samples of the {what}.", count)
        failures = {f'{what}="{_label(name)}"': one["failures"] for name, one in runners.items()}
        yield from _many(f"driftfit_{what}_failures_total", "counter", f"Failures of the {what}.", failures)
    aside = {f'sink="{_label(name)}"': one["set_aside"] for name, one in status.get("sinks", {}).items()}
    yield from _many("driftfit_sink_set_aside_total", "counter", "Events that were refused and set aside.", aside)


def _one(name: str, kind: str, about: str, value: Any) -> Iterator[str]:
    yield from (f"# HELP {name} {about}", f"# TYPE {name} {kind}", f"{name} {value}")


def _many(name: str, kind: str, about: str, values: dict[str, Any]) -> Iterator[str]:
    yield from (f"# HELP {name} {about}", f"# TYPE {name} {kind}")
    yield from (f"{name}{{{labels}}} {value}" for labels, value in values.items() if value is not None)


def _label(value: str) -> str:
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
