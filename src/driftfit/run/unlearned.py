"""A warning of parameters that a record could not tell apart: one, whether it is one series or thousands."""

from __future__ import annotations

import warnings
from collections import Counter

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.run.fleet import Fleet
from driftfit.run.result import Track


def warn_unlearned(run: Track | Fleet) -> None:
    """Warn of what `Tracker.unlearned` names, from the function that calls this for its user."""
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
    warnings.warn(
        f"{owners[0]}: {named} could not be learned, because their regressors never varied separately from the "
        "others: std is inf. The other parameters are not affected; to avoid this warning leave out columns that are "
        "constant or repeat another.",
        UserWarning,
        stacklevel=3,
    )


def _missed(run: Track) -> list[str]:
    tile, l = run._tile, run._lane
    if not np.isinf(tile["var"][0, ..., l]).any():
        return []
    lane: dict[str, Array] = {name: tile[name][0, ..., l] for name in tile.dtype.names or ()}
    return [name for name, missed in zip(run.names, run.tracker.unlearned(lane), strict=True) if missed]
