"""A warning of parameters that a record does not determine: one warning, for one series or thousands."""

from __future__ import annotations

from collections import Counter

from driftfit.engine.settings import warn
from driftfit.run.many import Many
from driftfit.run.result import Track
from driftfit.run.shared_outputs import Shared


def warn_unlearned(run: Track | Shared | Many) -> None:
    """Warn of what `Tracker.unlearned` names."""
    one = run.rows if isinstance(run, Shared) else run
    if isinstance(one, Track):
        ends = [(one.program, one.state)] if one.undetermined.any() else []
    else:
        ends = list(one.undetermined())
    found, counts, owners = 0, Counter[str](), []
    for program, state in ends:
        missed = [name for name, left in zip(program.names, program.tracker.unlearned(state), strict=True) if left]
        found += bool(missed)
        counts.update(missed)
        owners += [type(program.tracker).__name__] if missed else []
    if not found:
        return
    named = ", ".join(counts)
    if not isinstance(one, Track):
        named = (
            f"in {found} of {len(one.keys())} series {', '.join(f'{name} ({k})' for name, k in counts.most_common())}"
        )
    warn(
        f"{owners[0]}: {named} could not be learned, because their regressors never varied separately from the "
        "others: std is inf. The other parameters are not affected; to avoid this warning leave out columns that are "
        "constant or repeat another.",
        UserWarning,
    )
