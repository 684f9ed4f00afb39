"""A warning of parameters that a record does not determine: one warning, for one series or thousands."""

from __future__ import annotations

from collections import Counter

import numpy as np

from driftfit.engine.settings import warn
from driftfit.run.fleet import Fleet
from driftfit.run.result import Track


def warn_unlearned(run: Track | Fleet) -> None:
    """Warn of what `Tracker.unlearned` names."""
    series = [run] if isinstance(run, Track) else [one for _, one in run.items()]
    found, counts, owners = 0, Counter[str](), []
    for one in series:
        missed = _missed(one)
        found += bool(missed)
        counts.update(missed)
        owners += [type(one.tracker).__name__] if missed else []
    if not found:
        return
    named = ", ".join(counts)
    if not isinstance(run, Track):
        named = f"in {found} of {len(series)} series {', '.join(f'{name} ({k})' for name, k in counts.most_common())}"
    warn(
        f"{owners[0]}: {named} could not be learned, because their regressors never varied separately from the "
        "others: std is inf. The other parameters are not affected; to avoid this warning leave out columns that are "
        "constant or repeat another.",
        UserWarning,
    )


def _missed(run: Track) -> list[str]:
    lane = run.state
    if not np.isinf(lane["var"]).any():
        return []
    return [name for name, missed in zip(run.names, run.tracker.unlearned(lane), strict=True) if missed]
