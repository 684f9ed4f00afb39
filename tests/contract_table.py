"""What the contract tests need to know of a tracker that they have never seen: numbers for its required settings."""

VALUES = {"q": 1e-3, "r": 0.1, "forgetting": 0.98, "mu": 1.0}
"""By the name of the setting, not of the tracker; 1 / (1 - forgetting) is 50 samples."""

SLOW = {"q": 1e-6, "r": 0.01, "forgetting": 0.995, "mu": 1500.0}
"""For long runs of systems with noise of standard deviation 0.1 that drift slowly."""


def ready(kind, values=VALUES, **settings):
    """A tracker of this class with its required settings filled in."""
    if values is SLOW and hasattr(kind, "from_fls_mu"):  # its mu is not that of FLS
        return kind.from_fls_mu(values["mu"], n=4, s=8.0)
    unknown = set(kind.required) - values.keys() - settings.keys()
    assert not unknown, f"{kind.__name__}: give the required settings {sorted(unknown)} a value in contract_table.py"
    return kind(**{name: values[name] for name in kind.required if name not in settings} | settings)
