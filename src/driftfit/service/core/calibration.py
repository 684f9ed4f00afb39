"""The limits of a unit's alarms: its first samples are tracked as a record and judged by `Track.detect`."""

from __future__ import annotations

from typing import Any

from driftfit.data.storage import describe
from driftfit.engine.kernel import Array
from driftfit.service.settings.config import UnitSettings
from driftfit.tracking import track


def rules_of(settings: UnitSettings, rows: Array) -> dict[str, Any]:
    """The action that gives a unit its rules; ``rows`` (N, 2 + m) are time, y, u of the reference."""
    alarm = settings.alarm
    assert alarm is not None
    rules, refused = [], {}
    try:
        time = None if settings.time is None else rows[:, 0]
        run = track(
            settings.model, settings.tracker, rows[:, 1], rows[:, 2:], time=time, dt=settings.dt, gate=settings.gate
        )
    except Exception as error:
        return {"do": "calibrated", "rules": [], "refused": dict.fromkeys(alarm.on, str(error))}
    for kind in alarm.on:
        reference = None if kind == "probability" else len(rows)
        try:
            alarms = run.detect(kind, every=alarm.each, reference=reference, window=alarm.window, hold=alarm.hold)
            rules.append(describe(alarms.rule))
        except Exception as error:
            refused[kind] = str(error)
    return {"do": "calibrated", "rules": rules, "on": list(alarm.on), "refused": refused, "samples": len(rows)}
