"""A warning of parameters that a record does not determine: one warning, for one series or thousands."""

from __future__ import annotations

from collections import Counter

import numpy as np

from driftfit.engine.settings import warn
from driftfit.run.many import Many
from driftfit.run.program import Program, State
from driftfit.run.result import Track
from driftfit.run.shared_outputs import Shared


def warn_unlearned(run: Track | Shared | Many) -> None:
    """Warn of what `Tracker.unlearned` names."""
    one = run.rows if isinstance(run, Shared) else run
    if isinstance(one, Track) and not one.undetermined.any():
        return
    ends = [(one.program, one.state)] if isinstance(one, Track) else list(one.ends())
    found, counts, owners = 0, Counter[str](), []
    for program, state in ends:
        missed = _missed(program, state)
        found += bool(missed)
        counts.update(missed)
        owners += [type(program.tracker).__name__] if missed else []
    if not found:
        return
    named = ", ".join(counts)
    if not isinstance(one, Track):
        named = f"in {found} of {len(ends)} series {', '.join(f'{name} ({k})' for name, k in counts.most_common())}"
    warn(
        f"{owners[0]}: {named} could not be learned, because their regressors never varied separately from the "
        "others: std is inf. The other parameters are not affected; to avoid this warning leave out columns that are "
        "constant or repeat another.",
        UserWarning,
    )


def _missed(program: Program, state: State) -> list[str]:
    if not np.isinf(state["var"]).any():
        return []
    return [name for name, missed in zip(program.names, program.tracker.unlearned(state), strict=True) if missed]
