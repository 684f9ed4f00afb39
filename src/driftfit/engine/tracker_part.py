"""The part of a record that the steps of a tracker see, as a type of its own.

A record begins with the fields of the tracker and those that every record has, which end at the field `BOUNDARY`; those
of the model follow. The part up to there depends on the tracker, the number of parameters and the lanes only. Steps
that are compiled for it serve every model with that many parameters, at a third of the time of compiling them again.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from numba import types

from driftfit.engine.kernel import State, kernel
from driftfit.engine.numba_internals import named_intrinsic

BOUNDARY = "boundary"
"""The field behind the last one that a tracker sees, which fills a cache line. It holds the distance in bytes to the
open fields, which are at the end of the record, if there are any.
"""


@lru_cache(maxsize=256)
def _part(record: Any) -> Any:
    """The type of the part; its last field has a name that no record has, for which Numba would take it to be one."""
    boundary = record.fields[BOUNDARY]
    own = {name: field for name, field in record.fields.items() if field.offset < boundary.offset} | {"end": boundary}
    return types.Record(
        [(name, {"type": one.type, "offset": one.offset, "alignment": one.alignment}) for name, one in own.items()],
        boundary.offset + 8 * boundary.type.nitems,
        record.aligned,
    )


def seen_as(name: str, part: Any) -> Any:
    """f(s): the same memory as a record s, as one of the type ``part(type of s)``."""

    def typed(context: Any, record: Any) -> Any:
        kind = part(record)

        def build(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            return builder.bitcast(given[0], context.get_value_type(kind))

        return kind(record), build

    return named_intrinsic(name, typed)


tracker_part = seen_as("tracker_part", _part)
"""tracker_part(s): the same memory as s, of which only the fields of the tracker and the common ones can be named."""


@kernel
def whole_record(s: State) -> State:
    """All of the record, for steps that read fields of the model."""
    return s
