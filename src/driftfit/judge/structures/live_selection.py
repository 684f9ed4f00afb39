"""Orders and bases chosen on line: candidates tracked in parallel, each weighted by its recent predictions.

    log w_k <- a log w_k + log p_k(y_t | past),      p_k predicted before the sample, a just below 1

A candidate that predicts better gains weight; old predictions are forgotten, so that the choice may change: a valve
that begins to stick, an order that a new load requires. Useless parameters cost weight without a penalty, because each
density is that of a prediction made before its output was observed. A sample that one candidate cannot use changes no
weights. The tracker should be able to follow changes: parameters that a tiny q has frozen cost nothing while they are
useless, but take long to become correct once their candidate is the right one. Over the same samples the weights are
those of ``select(..).average(a)``.

Source: Raftery, Karny and Ettler (2010), Technometrics 52(1); the choice of r, m, p, q and bases on line is left open
by Feng and Hong (2021), section 6. Cost: that of the candidates.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
import scipy

from driftfit.data.arguments import check_roles
from driftfit.data.storage import Kept
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.readings.gate import FROZEN, INPUT, REFUSED, SIGNAL
from driftfit.run.gating import gate_of
from driftfit.run.live.live import Live
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.base import Tracker
from driftfit.trackers.student import log_student


class LiveSelection(Kept):
    """Track several models of one stream and choose the one that predicts best at present.

    Parameters
    ----------
    models : sequence of models
        Candidates with one output and the same inputs, as for `Live`; ``grid(..)`` makes some.
    tracker : Tracker
        How their parameters are followed, with a variance; its settings fit every number of parameters.
    forgetting : number in (0, 1]
        The weight of a log-likelihood one sample later: the memory is 1 / (1 - forgetting) samples. A smaller one finds
        a change sooner, and is misled by noise more often.
    dt : as for `Live`
    gate : bool, Gate or None
        As for `Live`. The gate decides once, before a stream of `AdaptiveKalman` on the largest model (``reference``),
        and what it leaves out is left out for all candidates, other than codes among the first samples, which are only
        recognised later: ``selection.reference.left_out``.

    Raises
    ------
    ValueError
        If there is no candidate, a model has several outputs, the tracker has no variance or weighs hypotheses, or the
        forgetting is not in (0, 1].
    """

    _kind: ClassVar[str] = "selection"

    def __init__(
        self, models: Sequence[Model], tracker: Tracker, forgetting: float = 0.99, dt: Any = None, gate: Any = None
    ) -> None:
        for model in models:
            check_roles("LiveSelection", model, tracker)
        if not models or any(len(model.outputs) > 1 for model in models):
            raise ValueError("LiveSelection: takes at least one model, each with one output.")
        if not tracker.covariance or tracker.density:
            raise ValueError(
                f"LiveSelection: {type(tracker).__name__} has no prediction with one variance to weigh; use "
                "Kalman, RLS or FLS."
            )
        if not 0.0 < forgetting <= 1.0:
            raise ValueError(f"LiveSelection: forgetting must be in (0, 1]; got {forgetting!r}.")
        judge = gate_of(tracker, gate)
        largest = max(models, key=lambda model: model.bind(model.input_names or model.m).n)
        reference = None if judge is None else Live(largest, AdaptiveKalman(), dt=dt, gate=judge)
        self._follow([Live(model, tracker, dt=dt, gate=False) for model in models], forgetting, reference)

    def _follow(self, streams: Sequence[Live], forgetting: float, reference: Live | None) -> None:
        self.reference, self._blamed = reference, 0
        self.streams, self.forgetting = tuple(streams), float(forgetting)
        self._logs, self._residuals = np.zeros((2, len(self.streams)))

    def update(self, y: float, u: Any = None, **known: Any) -> float:
        """Process one sample; returns the prediction of y made before it, averaged over the candidates by their
        weights.

        ``u`` and what is ``known`` (time, weight, drift) are as for `Live.update`.
        """
        weights = self.weights
        if self.reference is not None:
            y, known = self._judged(y, u, known)
        steps = [live.update(y, u, **known) for live in self.streams]
        terms = np.array([self._log_density(k, y, step) for k, step in enumerate(steps)])
        if np.isfinite(terms).all():
            logs = self.forgetting * self._logs + terms
            self._logs = logs - logs.max()
        return float(weights @ [step[0] for step in steps])

    def _judged(self, y: float, u: Any, known: dict[str, Any]) -> tuple[float, dict[str, Any]]:
        """(y, NaN if the gate refused it; what is known, without weight while a refused input is among the lags)."""
        assert self.reference is not None
        *_, ok = self.reference.update(y, u, **known)
        reason = int(self.reference.lane()["reason"])
        if reason % SIGNAL == INPUT:
            self._blamed = self.reference.model.steps.ages + 1
        unused = self._blamed > 0 and not ok
        self._blamed = max(self._blamed - 1, 0)
        return (np.nan if reason in (REFUSED, FROZEN) else y), {**known, "weight": 0.0} if unused else known

    def _log_density(self, k: int, y: float, step: tuple[float, float, float, bool]) -> float:
        """Log density of a sample under candidate k given those before it, NaN without one; `Track.log_density`."""
        (_, e, s, ok), live = step, self.streams[k]
        residuals = self._residuals[k]
        self._residuals[k] += ok and not np.isinf(s)
        if not (ok and np.isfinite(s) and s > 0.0):
            return float("nan")
        if live.tracker.learns_noise:
            found = log_student(*np.array([e, s, residuals]))
        else:
            found = -0.5 * (np.log(2.0 * np.pi * s) + e * e / s)
        if live.model.implicit and not live.tracker.output_error:
            found += live.model.implicit.log_jacobian(live.theta[None], np.array([y]))[0]
        return float(found)

    @property
    def weights(self) -> Array:
        """(K,) of the candidates for the next sample; they add up to 1."""
        return np.asarray(scipy.special.softmax(self.forgetting * self._logs))

    @property
    def best(self) -> Live:
        """The stream of the candidate that has the largest weight: its model, theta, blocks, forecast."""
        return self.streams[int(np.argmax(self._logs))]

    def __repr__(self) -> str:
        return f"LiveSelection among {len(self.streams)}, best now: {self.best.model!r}"

    def _written(self) -> tuple[dict[str, Any], dict[str, Array]]:
        header = {"kind": self._kind, "forgetting": self.forgetting}
        streams = {f"stream{k}": np.frombuffer(live.to_bytes(), np.uint8) for k, live in enumerate(self.streams)}
        header["blamed"] = self._blamed
        if self.reference is not None:
            streams["reference"] = np.frombuffer(self.reference.to_bytes(), np.uint8)
        return header, streams | {"logs": self._logs, "residuals": self._residuals}

    @classmethod
    def _read(cls, source: str, header: Mapping[str, Any], arrays: Mapping[str, Array], classes: Iterable[Any]) -> Self:
        found = cls.__new__(cls)
        count = len(arrays["logs"])
        streams = [Live.from_bytes(arrays[f"stream{k}"].tobytes(), classes) for k in range(count)]
        judge = Live.from_bytes(arrays["reference"].tobytes(), classes) if "reference" in arrays else None
        found._follow(streams, header["forgetting"], judge)
        found._blamed = header["blamed"]
        found._logs, found._residuals = np.array(arrays["logs"]), np.array(arrays["residuals"])
        return found
