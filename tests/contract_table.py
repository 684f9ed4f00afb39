"""What the contract tests need to know of a tracker that they have never seen: numbers for its required settings."""

from dataclasses import MISSING, fields

VALUES = {"q": 1e-3, "r": 0.1, "p0": 10.0, "forgetting": 0.98, "mu": 1.0, "particles": 4}
"""By the name of the setting, not of the tracker; 1 / (1 - forgetting) is 50 samples."""

SLOW = {"q": 1e-6, "r": 0.01, "p0": 10.0, "forgetting": 0.995, "mu": 1500.0, "particles": 4}
"""For long runs of systems with noise of standard deviation 0.1 that drift slowly."""


def no_default(field):
    return field.init and field.default is MISSING and field.default_factory is MISSING


def ready(kind, values=VALUES, **settings):
    """A tracker of this class with its required settings filled in."""
    if values is SLOW and hasattr(kind, "from_fls_mu"):  # its mu is not that of FLS
        return kind.from_fls_mu(values["mu"], n=4, s=8.0)
    if values is SLOW and kind.output_error:  # the noise of an ARX record drives the system, it is none of the sensor
        settings = {"q_w": values["r"]} | settings
    if any(field.name == "r" and field.default == 1.0 for field in fields(kind)):  # a dispersion: here the noise
        settings = {"r": values["r"]} | settings
    needed = dict.fromkeys([*kind.required, *(one.name for one in fields(kind) if no_default(one))])
    unknown = needed.keys() - values.keys() - settings.keys()
    assert not unknown, f"{kind.__name__}: give the required settings {sorted(unknown)} a value in contract_table.py"
    return kind(**{name: values[name] for name in needed if name not in settings} | settings)


def forms(kind):
    """The settings of every form that a tracker comes in."""
    return [{}, {"form": "sqrt"}] if "form" in {field.name for field in fields(kind)} else [{}]


def model_of(tracker, model):
    """The model of a test, or what takes its place for a tracker that works on its own models only.

    ``ARX(na, nb)`` of one input becomes a model of the same lags, ``Regression(n)`` one on n present and past inputs.
    """
    lags = (model.na, model.nb, 1) if hasattr(model, "na") else (0, model.m, 0)
    return (tracker.own_model(*lags) or model).bind(1 if tracker.own_model(*lags) else model.m)


def as_arx(tracker, theta, na=2, nb=2):
    """Paths of ARX parameters from those of the model that `model_of` gave."""
    own = tracker.own_model(na, nb, 1)
    return theta if own is None else theta[:, : na + nb] * ([-1.0] * na + [1.0] * nb)


def unusable(tracker, model, signal, first, last=None):
    """The samples that a tracker cannot use when a signal is missing from ``first`` to ``last``."""
    last = first if last is None else last
    if signal == "u":
        return list(range(first + 1, last + 3))  # nk = 1, nb = 2: the input of a sample is in phi of the next two
    touched = [model.implicit and model.implicit.touched(place, signal) for place in range(first, last + 1)]
    if tracker.output_error or None in touched:
        return list(range(first, last + 1))
    return sorted({t for places in touched for t in places})
