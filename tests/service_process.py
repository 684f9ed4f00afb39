"""A service in a process of its own, from a file to sinks; processes begin as copies of one that imported this."""

import threading
import time

from driftfit import ARX, Kalman, Live
from driftfit.service.config import parse
from driftfit.service.core.engine import Engine
from driftfit.service.supervisor import SinkThread, SourceThread

Live(ARX(1, 1), Kalman(q=1e-4, r=0.1), dt=1.0)  # compiled once for all processes


def work(text, folder, count):
    """A service in a process of its own, from the file to the sinks."""
    config = parse(text)
    engine = Engine(config, folder)
    runners = [SourceThread(engine, one) for one in config.sources] + [SinkThread(engine, one) for one in config.sinks]
    for runner in runners:
        runner.start()
    threading.Thread(target=stop_at_the_end, args=(engine, runners, count), daemon=True).start()
    engine.run()
    for runner in runners:
        runner.stop()
    for runner in runners:
        runner.join(30)
    engine.close()


def stop_at_the_end(engine, runners, count):
    """Stop once everything is tracked and written."""
    while engine.next <= count or engine._pending or any(one.at < engine.last_stored for one in runners[1:]):
        time.sleep(0.05)
    engine.stop()
