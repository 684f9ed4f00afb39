"""Records and models in MATLAB's terms: `.mat` files, experiments like `iddata`, polynomials with MATLAB's signs.

A file holds, for every experiment, a struct with fields ``y`` (T, ny), ``u`` (T, m), ``Ts``, ``OutputName``,
``InputName``, ``OutputUnit``, ``InputUnit``, ``TimeUnit``, ``Tstart``, which is what

    s = struct('y', z.y, 'u', z.u, 'Ts', z.Ts, 'OutputName', {z.OutputName}, 'InputName', {z.InputName}); save f.mat s

writes for an ``iddata`` object ``z``. Plain variables are read too. A vector is one signal, also as a row 1 x N. Files
up to version 7 are read and written by scipy; version 7.3 is HDF5 and needs h5py (``pip install "driftfit[matlab]"``).
Objects of classes such as ``iddata`` itself are not readable outside of MATLAB: `read_mat` says how to convert them.

Sign conventions: MATLAB writes A(q) y = B(q) u + e with A = 1 + a1 q^-1 + ..; `ARX` writes y_t = a1 y_(t-1) + ..; so
MATLAB's a_i is minus ours. ``run.polynomials()`` returns A and B with MATLAB's signs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, savemat
from scipy.io.matlab import MatlabObject, MatlabOpaque

from driftfit.engine.kernel import Array
from driftfit.models.base import Model


@dataclass(frozen=True)
class Experiment:
    """One record in the terms of ``iddata``: y (T,) or (T, ny), u (T,), (T, m) or None, Ts the sampling interval."""

    y: Array
    u: Array | None = None
    Ts: float = 1.0
    y_names: tuple[str, ...] = ()
    u_names: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    time_unit: str = "seconds"
    start: float | None = None

    def __post_init__(self) -> None:
        y, u = _columns("y", self.y), None if self.u is None else _columns("u", self.u)
        if u is not None and len(u) != len(y):
            raise ValueError(f"Experiment: y has {len(y)} samples and u has {len(u)}; they must be of one length.")
        for what, names, signals in (("y_names", self.y_names, y), ("u_names", self.u_names, u)):
            count = 0 if signals is None else signals.shape[1]
            if names and len(names) != count:
                raise ValueError(f"Experiment: {what} has {len(names)} names for {count} signals.")
        object.__setattr__(self, "y", y[:, 0] if y.shape[1] == 1 else y)
        object.__setattr__(self, "u", u)

    def __len__(self) -> int:
        return len(self.y)

    @property
    def time(self) -> Array:
        """Sampling times (T,): Tstart, Tstart + Ts, ..; MATLAB's default start is Ts."""
        first = self.Ts if self.start is None else self.start
        return first + self.Ts * np.arange(len(self))


@dataclass(frozen=True)
class Experiments:
    """Several records of one system, as ``merge(z1, z2)`` makes them in MATLAB."""

    records: tuple[Experiment, ...]

    def __post_init__(self) -> None:
        shapes = {
            (np.ndim(one.y) == 1 or one.y.shape[1], None if one.u is None else one.u.shape[1]) for one in self.records
        }
        if len(shapes) != 1:
            raise ValueError("Experiments: all experiments need the same numbers of outputs and inputs.")

    def __len__(self) -> int:
        return len(self.records)

    def __iter__(self) -> Iterator[Experiment]:
        return iter(self.records)

    def __getitem__(self, place: int) -> Experiment:
        return self.records[place]

    @property
    def arguments(self) -> dict[str, Any]:
        """What `track`, `tune` and `select` take: ``tune(model, Kalman(), **merge(z1, z2).arguments)``.

        A table with one row per sample, and the names of its columns: the experiment (0, 1, ..), the time, the signals
        by their names (y, y1, y2, .., u1, u2, .. without). Each experiment begins with unknown parameters: `track`
        returns a fleet, `tune` and `select` add the log-likelihoods. ValueError for different sampling intervals.
        """
        import polars as pl

        first = self[0]
        if len({one.Ts for one in self}) > 1:
            raise ValueError(f"Experiments: Ts must be the same in all; got {', '.join(f'{z.Ts:g}' for z in self)}.")
        ny, m = _columns("y", first.y).shape[1], 0 if first.u is None else first.u.shape[1]
        outputs = first.y_names or (("y",) if ny == 1 else tuple(f"y{i + 1}" for i in range(ny)))
        inputs = first.u_names or tuple(f"u{j + 1}" for j in range(m))
        tables = []
        for k, one in enumerate(self):
            columns = {"experiment": np.full(len(one), k), "time": one.time}
            columns |= dict(zip(outputs, _columns("y", one.y).T, strict=True))
            columns |= dict(zip(inputs, np.zeros((0, len(one))) if one.u is None else one.u.T, strict=True))
            tables.append(pl.DataFrame(columns))
        return {
            "y": outputs[0] if ny == 1 else list(outputs), "u": list(inputs) or None, "data": pl.concat(tables),
            "by": "experiment", "time": "time", "dt": "label",
        }  # fmt: skip

    def joined(self, model: Model) -> tuple[Array, Array | None]:
        """(y, u) of all experiments as one record, through which the parameters are followed (compare `arguments`).

        Between two experiments are ``model.reach + 1`` missing samples, so that no regressor of ``model`` (or of one
        that looks back less far) combines two experiments. Parameters are carried over; they drift for these samples.
        """
        gap = model.bind(0 if self[0].u is None else self[0].u.shape[1]).reach + 1
        y = _stacked([_columns("y", one.y) for one in self], gap)
        outputs = y[:, 0] if y.shape[1] == 1 else y
        return outputs, None if self[0].u is None else _stacked([one.u for one in self if one.u is not None], gap)


def merge(*experiments: Experiment | Experiments) -> Experiments:
    """Several experiments as one object; ValueError if their numbers of signals differ."""
    return Experiments(
        tuple(one for given in experiments for one in ([given] if isinstance(given, Experiment) else given))
    )


def read_mat(
    path: str | PathLike[str], name: str | None = None, *, y: str | Sequence[str] | None = None,
    u: str | Sequence[str] | None = None,
) -> Experiments:  # fmt: skip
    """Read the experiments of a `.mat` file, version 5 to 7.3.

    Parameters
    ----------
    path : path
    name : str or None
        The variable: a struct, or a vector of structs. None: the only struct, or plain variables ``y`` and ``u``.
    y, u : names of plain variables
        The outputs and the inputs, if the file has no struct: ``y="level", u=["valve", "pump"]``.

    Raises
    ------
    ValueError
        If the file has no such variable, if it is an object of a class, or if it has no field ``y``.
    """
    variables = _variables(Path(path))
    if y is not None:
        outputs, y_names = _signals(path, variables, y)
        inputs, u_names = (None, ()) if u is None else _signals(path, variables, u)
        plain = {"y": outputs, "u": inputs, "OutputName": y_names, "InputName": u_names}
        return Experiments(
            (_experiment({key: variables[key] for key in ("Ts", "Tstart") if key in variables} | plain),)
        )
    structs = {key: value for key, value in variables.items() if isinstance(value, list) and value}
    if name is None:
        if len(structs) == 1:
            name = next(iter(structs))
        elif "y" in variables and not structs:
            return Experiments((_experiment(variables),))
        else:
            raise ValueError(f"{path}: name= must say which variable to read; the file has {sorted(variables)}.")
    if name not in variables:
        raise ValueError(f"{path} has no variable {name!r}; it has {sorted(variables)}.")
    if name not in structs:
        raise ValueError(
            f"{path}: {name!r} is not a struct. Convert an iddata object z in MATLAB: s = struct('y', z.y, 'u', z.u, "
            f"'Ts', z.Ts); save('data.mat', 's')"
        )
    return Experiments(tuple(_experiment(one) for one in structs[name]))


def _signals(path: Any, variables: Mapping[str, Any], names: str | Sequence[str]) -> tuple[Array, tuple[str, ...]]:
    """(plain variables side by side (T, k), the names of their columns)."""
    given = [names] if isinstance(names, str) else list(names)
    for name in given:
        if not isinstance(variables.get(name), np.ndarray):
            raise ValueError(f"{path} has no numbers of the name {name!r}; it has {sorted(variables)}.")
    parts = {name: _columns(name, variables[name]) for name in given}
    if len({len(part) for part in parts.values()}) > 1:
        lengths = ", ".join(f"{name} {len(part)}" for name, part in parts.items())
        raise ValueError(f"{path}: signals must be of one length; their numbers of samples are: {lengths}.")
    columns = [[name] if part.shape[1] == 1 else [f"{name}{j + 1}" for j in range(part.shape[1])]
               for name, part in parts.items()]  # fmt: skip
    return np.hstack(list(parts.values())), tuple(name for each in columns for name in each)


def write_mat(path: str | PathLike[str], experiments: Experiment | Experiments, name: str = "s") -> None:
    """Write experiments as a struct (or a vector of structs) ``name``, version 5, which every MATLAB reads.

    In MATLAB: ``load data.mat; z = iddata(s.y, s.u, s.Ts, 'OutputName', s.OutputName, 'InputName', s.InputName)``.
    """
    several = merge(experiments)
    fields = [_struct(one) for one in several]
    matrix = np.empty((1, len(fields)), dtype=[(key, object) for key in fields[0]])
    for place, one in enumerate(fields):
        for key, value in one.items():
            matrix[key][0, place] = value
    savemat(str(path), {name: matrix}, do_compression=True)


def _variables(path: Path) -> dict[str, Any]:
    """The variables of a file; structs as lists of mappings from fields to values."""
    data = path.read_bytes()
    try:
        found = loadmat(BytesIO(data), squeeze_me=False, chars_as_strings=True)
    except NotImplementedError:
        return _variables_hdf5(path)
    except Exception as error:  # scipy, zlib and NumPy raise a dozen kinds of errors for damaged files
        raise ValueError(f"{path} is not a .mat file, or it is damaged: {error}.") from None
    return {key: _plain(value) for key, value in found.items() if not key.startswith("__")}


def _plain(value: Any) -> Any:
    """A value of scipy: structs as lists of mappings, text as str or tuple of str."""
    if isinstance(value, MatlabObject | MatlabOpaque):
        return None
    if isinstance(value, np.ndarray) and value.dtype.names:
        return [{key: _plain(one[key]) for key in value.dtype.names} for one in value.ravel()]
    if isinstance(value, np.ndarray) and value.dtype == object:
        return tuple("".join(_texts(_plain(one))) for one in value.ravel())
    if isinstance(value, np.ndarray) and value.dtype.kind == "U":
        return _texts(value)
    return value


def _texts(value: Any) -> tuple[str, ...]:
    if value is None:
        return ()
    if isinstance(value, tuple):
        return value
    return tuple(str(one).strip() for one in np.ravel(value))


def _variables_hdf5(path: Path) -> dict[str, Any]:
    try:
        import h5py
    except ImportError:
        raise ImportError(f'{path} is of version 7.3, which needs h5py: pip install "driftfit[matlab]"') from None
    try:
        with h5py.File(path) as file:
            return {str(key): _from_hdf5(file, value) for key, value in file.items() if not key.startswith("#")}
    except Exception as error:  # h5py raises many kinds too
        raise ValueError(f"{path} is damaged: {error}.") from None


def _from_hdf5(file: Any, value: Any) -> Any:
    """A variable of version 7.3: groups are structs, references are cells, uint16 with MATLAB_class char is text."""
    import h5py

    if isinstance(value, h5py.Group):
        columns = {str(key): _cells(file, one) for key, one in value.items()}
        count = max((len(one) for one in columns.values()), default=1)
        return [{key: one[place] for key, one in columns.items()} for place in range(count)]
    if value.dtype == h5py.ref_dtype:
        return tuple("".join(_texts(_from_hdf5(file, file[one]))) for one in value[()].ravel())
    if value.attrs.get("MATLAB_class") == b"char":
        return ("".join(map(chr, value[()].ravel(order="F"))),)
    return value[()].T


def _cells(file: Any, value: Any) -> list[Any]:
    """The values of one field of a struct: one for each element where MATLAB stored references."""
    import h5py

    held = isinstance(value, h5py.Dataset) and value.dtype == h5py.ref_dtype and value.attrs.get("MATLAB_class") is None
    return [_from_hdf5(file, file[one]) for one in value[()].ravel()] if held else [_from_hdf5(file, value)]


def _experiment(fields: Mapping[str, Any]) -> Experiment:
    by_lower = {key.lower(): value for key, value in fields.items()}
    if by_lower.get("y") is None:
        raise ValueError(f"the struct needs a field y (samples in rows); it has {sorted(fields)}.")
    u, start = by_lower.get("u"), np.ravel(by_lower.get("tstart", ()))
    y_names, u_names = _texts(by_lower.get("outputname")), _texts(by_lower.get("inputname"))
    of_y, of_u = _texts(by_lower.get("outputunit")), _texts(by_lower.get("inputunit"))
    units = dict(zip((*y_names, *u_names), (*of_y, *of_u), strict=False)) if of_y or of_u else {}
    interval = np.ravel(by_lower.get("ts", 1.0))
    return Experiment(
        np.asarray(by_lower["y"], dtype=float),
        None if u is None or np.size(u) == 0 else np.asarray(u, dtype=float),
        float(interval[0]) if len(interval) else 1.0, y_names, u_names,
        {name: unit for name, unit in units.items() if unit},
        (_texts(by_lower.get("timeunit")) or ("seconds",))[0], float(start[0]) if len(start) else None,
    )  # fmt: skip


def _struct(one: Experiment) -> dict[str, Any]:
    y = _columns("y", one.y)
    u = np.empty((len(one), 0)) if one.u is None else one.u
    y_names = one.y_names or tuple(f"y{i + 1}" for i in range(y.shape[1]))
    u_names = one.u_names or tuple(f"u{j + 1}" for j in range(u.shape[1]))
    return {
        "y": y, "u": u, "Ts": one.Ts, "OutputName": _cell(y_names), "InputName": _cell(u_names),
        "OutputUnit": _cell([one.units.get(name, "") for name in y_names]),
        "InputUnit": _cell([one.units.get(name, "") for name in u_names]),
        "TimeUnit": one.time_unit, "Tstart": one.Ts if one.start is None else one.start,
    }  # fmt: skip


def _cell(texts: Sequence[str]) -> Array:
    """A cell array of texts, (k, 1)."""
    return np.array(texts, dtype=object).reshape(-1, 1)


def _stacked(parts: Sequence[Array], gap: int) -> Array:
    """Signals of all experiments, with missing samples between two."""
    missing = np.full((gap, parts[0].shape[1]), np.nan)
    return np.concatenate([piece for part in parts for piece in (part, missing)][:-1])


def _columns(name: str, values: Any) -> Array:
    """Samples in rows, (T, k); a vector is one signal, whatever its orientation."""
    columns = np.asarray(values, dtype=float)
    if columns.ndim == 2 and len(columns) == 1:
        columns = columns.T
    if columns.ndim not in (1, 2):
        raise ValueError(f"Experiment: {name} has shape {columns.shape}; samples are rows, signals are columns.")
    return columns[:, None] if columns.ndim == 1 else columns
