"""Changes of parameters, with their dates and sizes, from the probabilities of a smoother of mixtures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from driftfit.bank.reduction import Hybrid
from driftfit.bank.results.events import LEVEL, Event, Probabilities, Span, changes_of
from driftfit.engine.kernel import Array
from driftfit.run.result import Track
from driftfit.smooth.problem import walk_of
from driftfit.smooth.unknown_drift import PER_SAMPLE


def changes(run: Track, threshold: float) -> list[Event]:
    """The changes of a run whose tracker estimates the drift: `driftfit.smooth.unknown_drift`.

    One of all parameters is named "all", others by the parameters of their group. There are none where slopes are more
    probable than levels. All are known at the end of the record.
    """
    walk = walk_of(run, turned=True)
    found = walk.mixture
    if found is None:
        return []
    labels = ["all" if one.all() else ", ".join(np.array(run.names)[one]) for one in found.moves[1:]]
    names = ["none", *dict.fromkeys(labels)]
    joined = np.array([[label == name for name in names[1:]] for label in labels], float)
    found = found._replace(events=np.column_stack([found.events[:, :1], found.events[:, 1:] @ joined]))
    found = found.turned(walk.basis) if len(walk.basis) else found
    prior = np.full((len(run), 1), 1.0 - PER_SAMPLE)
    return dated(run, found.events, found.increment, prior, names, threshold, Hybrid.remembered, [])


def dated(
    run: Track, probable: Array, increment: Callable[[int, int], tuple[Array, Array]], prior: Array,
    names: Sequence[str], threshold: float, W: int, known: Sequence[Span],
) -> list[Event]:  # fmt: skip
    """Changes more probable than the threshold within W samples, with credible sets of dates, sizes, and times.

    ``probable`` (T, E) are the probabilities of the events before each sample, none of them first, ``increment`` is the
    mean and standard deviation (n,) of how far theta moved from a first to a last sample.
    ``prior`` (T, 1) is the probability of no event before the record is seen, ``names`` are those of the events, and
    ``known`` what a filter found, each with the sample at which it did.
    """
    last, used = len(run) - 1, run.ok
    p, before = gathered(probable, used), gathered(np.column_stack([prior, 1.0 - prior]), used)
    # no more likely than before the record was seen: at the end of a record, say
    p = np.where(p[:, :1] < before[:, :1], p, np.eye(1, p.shape[1]))
    total = np.r_[np.zeros(W), np.cumsum(1.0 - p[:, 0])]
    given = Probabilities(p, total[W:] - total[:-W], used, W, tuple(names), ("nominal",))
    events = []
    for event in changes_of(given, threshold):
        first, final = event.span.first, event.span.last
        when = [span.known for span in known if first - W < span.date < final + W and span.known >= first]
        span = event.span._replace(known=min(when, default=last))
        sized = replace(event, span=span, level=LEVEL).measured(run.names, *increment(first, final))
        events.append(sized.timed(lambda sample: run.time[sample]))
    return events


def gathered(p: Array, used: Array) -> Array:
    """Probabilities (T, E) of events with those at unused samples moved to the next one that was used."""
    at = np.minimum(np.cumsum(used) - used, max(used.sum() - 1, 0))
    to = np.flatnonzero(used)[at] if used.any() else np.arange(len(p))
    result = np.zeros_like(p)
    np.add.at(result[:, 1:], to, p[:, 1:])
    result[:, 0] = 1.0 - result[:, 1:].sum(axis=1)
    return result
