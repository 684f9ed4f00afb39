"""Parameters and hidden states of four plants, with driftfit and with what else Python users have, on the same numbers.

    python benchmarks/joint_filters.py [--quick]    a way whose package is not installed is left out, and named

The plants are those of examples/equations.py (the heat exchanger) and examples/hidden_states.py. What a user writes is
in benchmarks/hidden_states; its lines are counted in each function, without blank ones, and without the loop over the
samples. Times are of the processor, the shortest of several, in microseconds for each sample; compilation is not in
them. Errors are root mean squares in the second half of the records. ``apart`` is the largest difference from the
unscented filter of filterpy, in standard deviations of ours.
"""

from __future__ import annotations

import inspect
import sys
import time
from collections.abc import Callable
from pathlib import Path
from runpy import run_path
from typing import Any, NamedTuple

import numpy as np

from driftfit import JointKalman, Live, ParticleFilter, track

HERE = Path(__file__).parent
QUICK = "--quick" in sys.argv
RECORDS = 1 if QUICK else 5
OF_OURS, OF_THEIRS = 200, 1000
"""Particles: ours draws hidden states alone and computes what is linear given them."""


class Found(NamedTuple):
    """What one way makes of a record: estimates (T, n), and seconds per sample live and for a whole record."""

    path: Any
    live: float = np.nan
    record: float = np.nan
    std: Any = None


def best(work: Callable[[Any], Any], T: int, times: int = 5, before: Callable[[], Any] = lambda: None) -> float:
    """The shortest of several times of the processor, in seconds for each of T samples, without what comes before."""
    found = []
    for _ in range(1 if QUICK else times):
        given = before()
        begin = time.process_time()
        work(given)
        found.append((time.process_time() - begin) / T)
    return min(found)


def script(name: str, plant: str) -> Any:
    """The function of a plant in benchmarks/hidden_states."""
    return run_path(str(HERE / "hidden_states" / f"by_{name}.py"))[plant]


def lines(function: Any) -> int:
    """Those of its body that are not blank."""
    return sum(bool(line.strip()) for line in inspect.getsource(function).splitlines()) - 1


def ours(tracker: Callable[..., Any]) -> Any:
    """A way: a tracker of ours."""

    def follow(make: Any, y: Any, u: Any, timed: bool) -> Found:
        model, settings = make()
        one = tracker(**settings)
        run = track(model, one, y, u)
        if not timed:
            return Found(run.theta, std=run.std)
        values, drives = y.tolist(), [None] * len(y) if u is None else u.tolist() if u.ndim == 1 else list(u)

        def stream(live: Live) -> None:
            for value, drive in zip(values, drives, strict=True):
                live.update(value, drive)

        seconds = best(stream, len(y), 6, lambda: Live(model, one))
        return Found(run.theta, seconds, best(lambda _: track(model, one, y, u), len(y)), run.std)

    return follow


def filterpy(make: Any, y: Any, u: Any, timed: bool) -> Found:
    drives = np.zeros(len(y)) if u is None else u
    path: list[Any] = []

    def stream(_: Any) -> None:
        step = make()
        path[:] = [np.array(step(value, drive)) for value, drive in zip(y, drives, strict=True)]

    live = best(stream, len(y), 2 if timed else 1)
    return Found(np.array(path), live)


def dynamax(method: str) -> Any:
    """A way: one of the filters of dynamax, compiled before it is timed."""

    def follow(make: Any, y: Any, u: Any, timed: bool) -> Found:
        import jax
        from dynamax.nonlinear_gaussian_ssm import UKFHyperParams, extended_kalman_filter, unscented_kalman_filter

        params, fields = make(), ["filtered_means"]

        def whole(y: Any, u: Any) -> Any:
            if method == "extended":
                return extended_kalman_filter(params, y, u, output_fields=fields).filtered_means
            points = UKFHyperParams(
                alpha=1.0, beta=0.0, kappa=max(3.0 - len(params.initial_mean), 0.0)
            )  # those of filterpy's Julier points
            return unscented_kalman_filter(params, y, points, u, output_fields=fields).filtered_means

        run, drives = jax.jit(whole), np.zeros((len(y), 1)) if u is None else u.reshape(len(y), -1)
        path = np.asarray(run(y[:, None], drives))
        record = best(lambda _: run(y[:, None], drives).block_until_ready(), len(y)) if timed else np.nan
        return Found(path, record=record)

    return follow


def bootstrap(make: Any, y: Any, u: Any, timed: bool) -> Found:
    import particles
    from particles.collectors import Moments
    from particles.state_space_models import Bootstrap

    np.random.seed(0)  # noqa: NPY002  the package draws from the global generator
    means: list[Any] = []

    def stream(_: Any) -> None:
        filtered = particles.SMC(fk=Bootstrap(ssm=make(u), data=y), N=OF_THEIRS, collect=[Moments()])
        for _ in filtered:
            pass
        means[:] = [one["mean"] for one in filtered.summaries.moments]

    with np.errstate(all="ignore"):
        live = best(stream, len(y), 2 if timed else 1)
    return Found(np.array(means).reshape(len(y), -1), live)


WAYS: dict[str, tuple[str, Any]] = {
    "filterpy, unscented": ("filterpy_unscented", filterpy),
    "filterpy, extended": ("filterpy_extended", filterpy),
    "dynamax, unscented": ("dynamax", dynamax("unscented")),
    "dynamax, extended": ("dynamax", dynamax("extended")),
    f"particles, bootstrap of {OF_THEIRS}": ("particles", bootstrap),
    "driftfit, unscented": ("driftfit", ours(JointKalman)),
    "driftfit, extended": ("driftfit", ours(lambda **given: JointKalman(**given, method="extended"))),
    f"driftfit, {OF_OURS} particles": ("driftfit", ours(lambda **given: ParticleFilter(OF_OURS, **given))),
}  # fmt: skip
PLANTS = {"exchanger": ("UA",), "battery": ("capacity", "R0"), "epidemic": ("contact",), "vehicle": ("mass", "drag")}


def record(plant: str, seed: int) -> tuple[Any, Any, dict[str, Any]]:
    """y, u and the true paths."""
    rng, examples = np.random.default_rng(seed), HERE.parent / "examples"
    if plant == "exchanger":
        data, truth = run_path(str(examples / "equations.py"), run_name="plants")["exchanger"](rng)
        y, u = data["outlet"].to_numpy(), data[["steam", "inlet", "flow"]].to_numpy()
    else:
        _, _, _, _, y, u, truth = run_path(str(examples / "hidden_states.py"), run_name="plants")[plant](rng)
    T = 100 if QUICK else len(y)
    return y[:T], None if u is None else u[:T], {name: path[:T] for name, path in truth.items()}


def compared(plant: str, followed: tuple[str, ...]) -> None:
    """The rows of a plant."""
    records = [record(plant, seed) for seed in range(RECORDS)]
    heads = "".join(f"{'error of ' + name:>19}" for name in followed)
    print(f"{plant:30}{'live':>9}{'record':>9}{'times':>7}{'lines':>7}{'apart':>8}{heads}")
    names, first = script("driftfit", plant)()[0].names, None
    for way, (file, follow) in WAYS.items():
        try:
            make = script(file, plant)
            found = [follow(make, y, u, seed == 0) for seed, (y, u, _) in enumerate(records)]
        except ImportError as error:
            print(f"{way:30} left out: {error.name} is not installed")
            continue
        first = first or found[0]
        speed = np.nanmin([found[0].live, found[0].record])
        live = found[0].live if found[0].live == found[0].live else speed
        shown = "".join(f"{1e6 * s:9.2f}" if s == s else f"{'':9}" for s in (found[0].live, found[0].record))
        same = found[0].std is not None and "unscented" in way and first.std is None
        apart = f"{np.nanmax(np.abs(found[0].path - first.path) / found[0].std):8.0e}" if same else f"{'':8}"
        errors = ""
        for name in followed:
            k = names.index(name)
            misses = [
                (one.path[:, k] - truth[name])[len(y) // 2 :] for one, (y, _, truth) in zip(found, records, strict=True)
            ]
            errors += f"{np.sqrt(np.mean(np.square(misses))):19.2g}"
        print(f"{way:30}{shown}{first.live / live:7.0f}{lines(make):7}{apart}{errors}", flush=True)


def main() -> None:
    """Print the table."""
    for plant in ["battery"] if QUICK else PLANTS:
        compared(plant, PLANTS[plant])


if __name__ == "__main__":
    main()
