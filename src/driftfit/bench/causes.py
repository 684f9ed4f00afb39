"""Why a row beats `AdaptiveKalman` on a scenario: found by looking, printed beside the losses."""

from __future__ import annotations

CAUSES: dict[str, str] = {}
"""By scenario."""

REAL_CAUSES = ""
"""What the real records say."""

SPEED_CAUSES = ""
"""Why a peer is faster, where one is."""
