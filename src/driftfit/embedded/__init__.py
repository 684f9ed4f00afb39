"""Export a tracker as standalone C99, for controllers without Python.

The source is translated from the steps that run live, on records and in fleets (`driftfit.embedded.functions`). A new
tracker can therefore be exported without further work, and the double-precision build gives the same bits. States can
be transferred in both directions as bytes.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from driftfit.data.arguments import check_ready
from driftfit.embedded.project import files_of, translation, write
from driftfit.engine.settings import whole
from driftfit.models.base import Model
from driftfit.readings.gate import Gate
from driftfit.run.gating import gate_of
from driftfit.run.program import Program
from driftfit.streams import Live
from driftfit.trackers.base import Tracker
from driftfit.use.control import check_plannable


def export_c(
    model: Model,
    tracker: Tracker,
    path: str | PathLike[str],
    *,
    fixed_rate: bool = False,
    gate: Gate | bool | None = None,
    horizon: int | None = None,
) -> None:
    """Write a tracker as C99 into a folder: ``tracker.h``, ``tracker.c``, a self-test, an S-function and ``README.md``.

    Parameters
    ----------
    model, tracker : Model, Tracker
        As for `Live`: the model must declare its inputs if there are several. All trackers except `Bank`.
    path : path
        The folder; it is created if it does not exist, and files of these names are replaced.
    fixed_rate : bool
        Samples come at one fixed rate and nothing else is known of them: the fields ``interval``, ``noise`` and
        ``drift`` of the next sample are 1, as constants of the code. The results are the same, in less time and
        memory. (``noise`` remains where the steps themselves change it within a sample, as those of
        `AdaptiveKalman` do.)
    gate : bool, `Gate` or None
        As for `track`: whether readings are judged before they are used.
    horizon : int or None
        Write also ``tracker_control``, which plans the inputs of so many samples as `Live.control` does. The first
        acts in the next row: with ``nk=0`` a row is an output, and the input that acted on it.

    Raises
    ------
    ValueError
        For a `Bank`, whose compiled routine works with vectors of eight numbers and on many leaves; for several
        outputs; for incomplete settings; for a user's step that uses something without a translation; with
        ``horizon``, for a model that is no ARX with inputs.
    """
    if tracker.weighs:
        raise ValueError(
            f"export_c: {type(tracker).__name__} has no C form: its compiled routine works in vectors of eight numbers "
            "and on many leaves; export AdaptiveKalman, or a Kalman with settings from a Bank's run."
        )
    if len(model.outputs) > 1:
        raise ValueError(f"export_c: one output at a time; export a tracker for each of {', '.join(model.outputs)}.")
    bound = model.bind(model.m)
    if horizon is not None:
        check_plannable("export_c", bound, tracker)
        whole("export_c", "horizon", horizon, 1)
    program = Program(bound, check_ready(tracker), gate=gate_of(tracker, gate))
    what = f"{bound!r}, {tracker!r}" + ("" if program.gate is None else ", with a gate")
    write(Path(path), files_of(program, what, fixed_rate, horizon))


def to_struct(live: Live, *, fixed_rate: bool = False) -> bytes:
    """The state of a stream as the bytes of ``tracker_state`` (double precision, the byte order of this computer).

    ``fixed_rate`` must be that of `export_c`.

    Raises
    ------
    ValueError
        If a field that the exported tracker has as a constant has another value in this stream.
    """
    return translation(live.program, fixed_rate).bytes_of(live.lane())


def from_struct(
    model: Model, tracker: Tracker, state: bytes, *, fixed_rate: bool = False, gate: Gate | bool | None = None
) -> Live:
    """A stream that continues from the bytes of a ``tracker_state`` of the double-precision build.

    ``fixed_rate`` and ``gate`` must be those of `export_c`.

    Raises
    ------
    ValueError
        If the number of bytes is not the one that this model and tracker need.
    """
    live = Live(model, tracker, gate=gate)
    made = translation(live.program, fixed_rate)
    size = made.layout(8).itemsize
    if len(state) != size:
        raise ValueError(f"from_struct: this model and tracker have a state of {size} bytes; got {len(state)}.")
    made.read(live.lane(), state)
    return live
