"""The parts of `driftfit.tune`: settings as knobs, a record under many settings at once, the search."""
