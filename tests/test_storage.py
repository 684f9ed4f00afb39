"""Files: damaged, truncated, of another kind, for another model, from the future; complete or absent."""

import io
import json
import os
import sys
import zipfile

import numpy as np
import pytest
from support import arx_record, same

from driftfit import ARX, RLS, Kalman, Live, Track, track
from driftfit.data import storage
from driftfit.run import layout as states

Y, U = arx_record(60, 1)


@pytest.fixture(params=["state", "track"])
def saved(request, tmp_path):
    """(path, load) of a file of each kind."""
    path = tmp_path / "file"
    if request.param == "state":
        live = Live(ARX(2, 2), Kalman(q=1e-3, r=0.1))
        for t in range(60):
            live.update(Y[t], U[t : t + 1])
        live.save(path)
        return path, Live.load
    track(ARX(2, 2), Kalman(q=1e-3, r=0.1), Y, U).save(path)
    return path, Track.load


def rewrite(path, change_header=None, change_arrays=None):
    """Write the file again with another header or other arrays."""
    packed = path.read_bytes().startswith(storage.MAGIC)
    if packed:
        header, arrays = storage.read(path, "state")
    else:
        with np.load(path) as file:
            arrays = dict(file)
        header = json.loads(str(arrays.pop("header")))
    if change_header:
        change_header(header)
    if change_arrays:
        change_arrays(arrays)
    if packed:
        path.write_bytes(storage.compact(header, arrays))
    else:
        with open(path, "wb") as file:
            np.savez(file, header=np.array(json.dumps(header | {"arrays": [*arrays]})), **arrays)


def test_a_missing_file_is_a_missing_file(tmp_path):
    for load in (Live.load, Track.load):
        with pytest.raises(FileNotFoundError):
            load(tmp_path / "absent")


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04 not really", b"\x93NUMPY" + bytes(100)])
def test_other_files_are_named(tmp_path, content):
    path = tmp_path / "other"
    path.write_bytes(content)
    for load in (Live.load, Track.load):
        with pytest.raises(ValueError, match=r"other is not a driftfit file, or it is damaged"):
            load(path)
    with pytest.raises(ValueError, match="what was given is not a driftfit file, or it is damaged"):
        Live.from_bytes(content)


def test_files_of_arrays_that_are_not_ours_are_named(tmp_path):
    path = tmp_path / "other.npz"
    for arrays in (
        {"a": np.ones(3)},
        {"header": np.array("[1, 2]")},
        {"header": np.array("7")},
        {"header": np.ones(2)},
    ):
        np.savez(path, **arrays)
        with pytest.raises(ValueError, match=r"other\.npz"):
            Live.load(path)
    np.savez(path, header=np.array({"kind": "state"}, dtype=object))  # a pickle: never opened
    with pytest.raises(ValueError, match=r"not a driftfit file"):
        Live.load(path)


def test_a_truncated_file_is_refused_at_every_length(saved):
    path, load = saved
    whole = path.read_bytes()
    for length in range(0, len(whole), max(1, len(whole) // 60)):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"not a driftfit file, or it is damaged"):
            load(path)


def test_a_flipped_bit_is_refused_or_without_effect(saved):
    path, load = saved
    whole = path.read_bytes()
    expected = load(path)
    rng = np.random.default_rng(0)
    stored = np.ones(len(whole), bool)
    if not whole.startswith(storage.MAGIC):  # of a zip only the data of its entries is checked
        stored[:] = False
        with zipfile.ZipFile(path) as archive:  # after 30 bytes and the name of an entry its data
            parts = [(info.header_offset + 30 + len(info.filename), info) for info in archive.infolist()]
        for begin, info in parts:
            extra = int.from_bytes(whole[info.header_offset + 28 : info.header_offset + 30], "little")
            stored[begin + extra : begin + extra + info.compress_size] = True
    refused = 0
    for place in rng.choice(len(whole), 250, replace=False):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            got = load(path)
        except ValueError:
            refused += 1
        else:
            assert not stored[place]
            assert same(got.theta, expected.theta)
            assert got.tracker == expected.tracker
    assert refused >= 250 * stored.mean() - 4.0 * np.sqrt(250 * stored.mean() * (1.0 - stored.mean()))


def test_the_wrong_kind_is_named(saved):
    path, load = saved
    other, holds, wanted = (Live, "track", "state") if load == Track.load else (Track, "state", "track")
    with pytest.raises(ValueError, match=f"holds a {holds}, not a {wanted}"):
        other.load(path)


def test_a_future_format_is_named(saved):
    path, load = saved
    if load == Track.load:
        rewrite(path, lambda header: header.update(format=99))
    else:
        data = path.read_bytes()
        path.write_bytes(data[:8] + (99).to_bytes(2, "little") + data[10:])
    with pytest.raises(ValueError, match=r"newer driftfit \(format 99\); this one reads \d"):
        load(path)


def part(header, which):
    """The description of a model or of the first tracker, of which a stream has one and results have a list."""
    return header["trackers"][0] if which == "tracker" and "trackers" in header else header[which]


@pytest.mark.parametrize("which", ["model", "tracker"])
def test_a_class_that_is_not_here_is_named(saved, which):
    path, load = saved
    rewrite(path, lambda header: part(header, which).update({"class": "plant.pumps:Absent"}))
    with pytest.raises(ValueError, match=r"needs plant\.pumps:Absent, .* hand it in: classes=\[plant\.pumps\.Absent\]"):
        load(path)
    rewrite(path, lambda header: part(header, which).update({"class": f"{__name__}:rewrite"}))
    with pytest.raises(ValueError, match=f"{__name__}:rewrite as its {which}, which it is not"):
        load(path, classes=[rewrite])


@pytest.mark.parametrize("place", ["trap:Model", "driftfit.__main__:Model", "os:system", "driftfit.data.storage:os"])
@pytest.mark.parametrize("which", ["model", "tracker"])
def test_nothing_is_imported_by_what_a_file_says(saved, which, place, tmp_path, monkeypatch):
    """A forged file ran code in the current folder."""
    path, load = saved
    (tmp_path / "trap.py").write_text("raise SystemExit('code of a file was run')")
    monkeypatch.syspath_prepend(tmp_path)
    rewrite(path, lambda header: part(header, which).update({"class": place}))
    with pytest.raises(ValueError, match=f"needs {place}"):
        load(path)
    assert "trap" not in sys.modules


@pytest.mark.parametrize(
    "forged",
    [
        {"tracker": {"class": "driftfit.bank.bank:Bank", "settings": {"sensors": [
            {"kind": "own", "likelihood": {"function": "trap:density"}}]}}},
        {"model": {"class": "driftfit.models.hammerstein_wiener.model:HammersteinWiener", "settings": {
            "na": 1, "nb": 1, "input": {"class": "Functions", "settings": {
                "values": {"function": "trap:f"}, "slopes": {"function": "trap:f"}}}}}},
        {"model": {"class": "driftfit.models.hammerstein_wiener.model:HammersteinWiener", "settings": {
            "na": 1, "nb": 1, "input": {"class": "Functions", "settings": {"values": "trap:f", "slopes": "trap:f"}}}}},
    ],
    ids=["likelihood", "functions", "text"],
)  # fmt: skip
def test_no_function_is_imported_by_what_a_file_says(saved, forged, tmp_path, monkeypatch):
    path, load = saved
    (tmp_path / "trap.py").write_text("raise SystemExit('code of a file was run')")
    monkeypatch.syspath_prepend(tmp_path)
    rewrite(path, lambda header: [part(header, name).update(given) for name, given in forged.items()])
    with pytest.raises(ValueError, match=r"needs trap:|must be functions"):
        load(path)


FORGED = {
    "no model": lambda header: header.pop("model"),
    "no settings": lambda header: header["model"].pop("settings"),
    "a number for a class": lambda header: header.update(tracker=7),
    "a model beyond memory": lambda header: header["model"]["settings"].update(na=10**6, nb=10**6),
    "a text for a number": lambda header: part(header, "tracker")["settings"].update(q={"a": 1}),
    "facts of another kind": lambda header: header.update(extra=3, labels=3),
    "unknown facts": lambda header: header.update(extra={"alarms": [[0, {}]]}, labels={"x": 1}),
}


@pytest.mark.parametrize("forged", FORGED)
def test_a_forged_header_is_one_clear_error(saved, forged):
    path, load = saved
    rewrite(path, FORGED[forged])
    with pytest.raises(ValueError, match=r"does not write|does not fit|another version|must be|needs"):
        load(path)


@pytest.mark.parametrize("which", ["model", "tracker"])
def test_a_setting_that_is_not_here_is_named(saved, which):
    path, load = saved
    rewrite(path, lambda header: part(header, which)["settings"].update(viscosity=1.0))
    with pytest.raises(ValueError, match=r"written by another version: .*'viscosity'"):
        load(path)


def test_a_state_of_another_model_is_refused(saved):
    path, load = saved
    rewrite(path, lambda header: header["model"].update(settings={"na": 1, "nb": 2, "inputs": 1}))
    with pytest.raises(ValueError, match=r"does not fit"):
        load(path)


def test_a_state_with_other_fields_is_refused(saved):
    path, load = saved
    if load == Track.load:
        rewrite(path, change_arrays=lambda arrays: arrays.pop("state0_theta"))
    else:
        words = states.unpacked(Live.load(path).program.pack(Live.load(path)._tile))[1]
        packed = np.frombuffer(states.packed(bytes(8), words[:-1]), np.uint8)
        rewrite(path, change_arrays=lambda arrays: arrays.update(state0=packed))
    with pytest.raises(ValueError, match=r"does not fit.*('theta'|run the record again)"):
        load(path)


def test_a_failure_while_writing_leaves_the_old_file(saved, monkeypatch):
    path, load = saved
    before = path.read_bytes()
    again = load(path)

    def fails(handle):
        raise OSError("no space left")

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises(OSError, match="no space left"):
        again.save(path)
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == [path.name]


def test_a_failure_at_the_first_writing_leaves_nothing(tmp_path, monkeypatch):
    run = track(ARX(2, 2), RLS(0.9), Y, U)
    monkeypatch.setattr(os, "replace", lambda *paths: (_ for _ in ()).throw(OSError("busy")))
    with pytest.raises(OSError, match="busy"):
        run.save(tmp_path / "run")
    assert os.listdir(tmp_path) == []


def test_a_file_holds_no_pickle_and_opens_anywhere(saved):
    path, load = saved
    if load == Live.load:
        assert b'"q":0.001' in path.read_bytes()
        return
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            np.load(io.BytesIO(archive.read(name)), allow_pickle=False)
    with np.load(path, allow_pickle=False) as file:
        header = json.loads(str(file["header"]))
    assert part(header, "tracker")["settings"]["q"] == 1e-3


def test_a_path_may_be_text_and_is_written_over(tmp_path):
    path = str(tmp_path / "run")
    for q in (1e-3, 1e-2):
        track(ARX(2, 2), Kalman(q=q, r=0.1), Y, U).save(path)
    assert Track.load(path).tracker.q == 1e-2


@pytest.mark.skipif(os.name != "posix", reason="rights of files as POSIX has them")
def test_others_may_read_a_file_where_they_may_read_any(saved):
    path, _ = saved
    (path.parent / "plain").write_text("")
    assert path.stat().st_mode == (path.parent / "plain").stat().st_mode
