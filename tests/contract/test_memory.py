"""The memory of a stream is constant, and a record needs no more than its inputs and outputs."""

import gc
import tracemalloc

import numpy as np
from support import arx_record

from driftfit import Live, track


def test_a_stream_does_not_grow(model, tracker):
    y, u = (signal.tolist() for signal in arx_record(400, 1))
    live = Live(model, tracker)
    weights = [1.0] * 399 + [2.0]

    def feed(times):
        for _ in range(times):
            for sample in zip(y, u, weights, strict=True):
                live.update(*sample[:2], None, sample[2])
            live.predict(0.0), live.std, live.theta

    feed(2)
    gc.freeze()  # what the process has so far, which took a second to search
    tracemalloc.start()
    try:
        feed(1)
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        feed(10)
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
        peak = tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()
        gc.unfreeze()
    assert grown < 20_000  # one number kept per update would be 32_000; processes of pytest allocate a little too
    assert peak < 100_000


def test_a_record_needs_its_outputs_and_no_more(model, tracker):
    T = 30_000
    y, u = arx_record(T, 2)
    track(model, tracker, y[:10], u[:10])
    tracemalloc.start()
    try:
        run = track(model, tracker, y, u)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < run._lane.out.nbytes + 0.5 * T * np.dtype(float).itemsize
