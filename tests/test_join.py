# SPDX-License-Identifier: MIT
"""tests/tools/join.py: what is in the joined file, and what it refuses."""

import sys

import h5py
import numpy as np
import pytest
from conftest import ROOT, assert_one_sentence, run, wpc

sys.path.insert(0, str(ROOT / "tests/tools"))
import join

WIDTHS = {"observations": 11, "actions": 3, "next_observations": 11}


def columns(seed, rows=20, last=(), with_next=False):
    """Random rows in which episodes end at 6 (terminal) and 12 (timeout); `last` are
    the flags of the last row."""
    rng = np.random.default_rng(seed)
    arrays = {
        name: rng.uniform(-1, 1, (rows, width)).astype(np.float32)
        for name, width in WIDTHS.items()
    }
    if not with_next:
        del arrays["next_observations"]
    arrays["rewards"] = rng.normal(size=rows).astype(np.float32)
    arrays["terminals"], arrays["timeouts"] = np.zeros((2, rows), bool)
    arrays["terminals"][6] = arrays["timeouts"][12] = True
    for name in last:
        arrays[name][-1] = True
    return arrays


def write(path, arrays):
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array
    return path


def transitions(path):
    """Of wpc.py, each a row: state, action, reward, next state, terminal."""
    args = wpc.Args("hopper", str(path), device="cpu")
    arrays = wpc.read_dataset(path, 11, 3, 1.0)
    data, mean, std, _ = wpc.prepare_dataset(arrays, args)
    for name in ("observations", "next_observations"):
        data[name] = data[name] * std + mean
    names = ("observations", "actions", "rewards", "next_observations", "terminals")
    return np.column_stack([data[name].numpy() for name in names])


def join_files(out, *paths):
    join.main(join.Args(list(paths), out))


@pytest.mark.parametrize("with_next", [False, True])
@pytest.mark.parametrize("last", [(), ("timeouts",)])
def test_the_transitions_are_those_of_each_file(tmp_path, capsys, with_next, last):
    paths = [
        write(tmp_path / f"{i}.hdf5", columns(i, 20 + i, last, with_next))
        for i in range(3)
    ]
    alone = np.concatenate([transitions(path) for path in paths])
    out = tmp_path / "joined.hdf5"
    join_files(out, *paths)
    assert (
        f"{len(alone)} transitions in 9 episodes of 3 files" in capsys.readouterr()[0]
    )
    assert transitions(out) == pytest.approx(alone, abs=1e-5)
    with h5py.File(out) as file:
        assert np.flatnonzero(file["timeouts"]).tolist() == [12, 19, 32, 40, 53, 62]
        assert np.flatnonzero(file["terminals"]).tolist() == [6, 26, 47]


def test_a_terminal_last_row_stays_terminal(tmp_path):
    """It gives a transition, now that it isn't the last; its next state can't count."""
    paths = [
        write(tmp_path / f"{i}.hdf5", columns(i, last=("terminals",))) for i in (0, 1)
    ]
    first, second = map(transitions, paths)
    join_files(tmp_path / "joined.hdf5", *paths)
    joined = transitions(tmp_path / "joined.hdf5")
    assert len(joined) == len(first) + 1 + len(second)
    extra = joined[len(first)]
    last = columns(0)["observations"][-1]
    assert extra[:11] == pytest.approx(last, abs=1e-5) and extra[-1] == 1
    with h5py.File(tmp_path / "joined.hdf5") as file:
        assert not file["timeouts"][19]  # with which d4rl would drop it
    kept = np.delete(joined, len(first), axis=0)
    assert kept == pytest.approx(np.concatenate([first, second]), abs=1e-5)


def test_columns_of_shape_rows_1_and_other_types(tmp_path):
    plain, other = columns(0), columns(1)
    expected = transitions(write(tmp_path / "other.hdf5", other))
    for name in ("rewards", "terminals", "timeouts"):
        other[name] = other[name].astype(float)[:, None]
    other["infos/qpos"] = np.zeros(20)  # which the scripts don't read
    paths = write(tmp_path / "a.hdf5", plain), write(tmp_path / "b.hdf5", other)
    join_files(tmp_path / "joined.hdf5", *paths)
    joined = transitions(tmp_path / "joined.hdf5")
    assert joined[-len(expected) :] == pytest.approx(expected, abs=1e-5)
    with h5py.File(tmp_path / "joined.hdf5") as file:
        assert "infos" not in file and file["rewards"].shape == (40,)


def without(name, **changes):
    return {key: x for key, x in (columns(1) | changes).items() if key != name}


SECOND = {
    "no timeouts": (without("timeouts"), "D4RL's format has arrays of"),
    "next": (columns(1, with_next=True), "all with next_observations or all without"),
    "width": (without("", observations=np.zeros((20, 17))), "observations (17 wide)"),
    "the same": (columns(0), "hold the same data: name them once"),
    "short": (without("", rewards=np.zeros(19)), "as rewards and --env require"),
    "reversed": (without("", actions=np.zeros((3, 21))), "MATLAB reverses axes"),
    "255": (without("", terminals=np.full(20, 255)), "terminals is wrong in 20"),
    "text": (without("", rewards="none"), "can't be read"),
    "no rows": ({x: y[:0] for x, y in columns(1).items()}, "b.hdf5 has no rows"),
}


@pytest.mark.parametrize("name", SECOND)
@pytest.mark.parametrize("order", [1, -1])
def test_files_that_can_not_be_joined(tmp_path, name, order):
    arrays, sentence = SECOND[name]
    paths = write(tmp_path / "a.hdf5", columns(0)), write(tmp_path / "b.hdf5", arrays)
    with pytest.raises((SystemExit, wpc.UserError)) as stop:
        join_files(tmp_path / "joined.hdf5", *paths[::order])
    assert sentence in str(stop.value) and "\n" not in str(stop.value)
    assert not (tmp_path / "joined.hdf5").exists()


def test_paths_that_can_not_be_joined(tmp_path):
    path, out = write(tmp_path / "a.hdf5", columns(0)), tmp_path / "joined.hdf5"
    content = path.read_bytes()
    (tmp_path / "damaged.hdf5").write_bytes(content[: len(content) // 2])
    (tmp_path / "link.hdf5").hardlink_to(path)
    for paths, to, sentence in (
        ([path, path], out, "hold the same data"),
        ([path, tmp_path / "missing.hdf5"], out, "No such file or directory"),
        ([path], tmp_path / "link.hdf5", "is one of the files to join"),
        ([path], tmp_path / "no/joined.hdf5", "--out can't be written"),
    ):
        with pytest.raises(SystemExit) as stop:
            join_files(to, *paths)
        assert sentence in stop.value.code and "\n" not in stop.value.code
        assert not out.exists() and path.read_bytes() == content
    program = [sys.executable, ROOT / "tests/tools/join.py"]
    process = run(*program, path, tmp_path / "damaged.hdf5", "--out", out)
    assert_one_sentence(process, "damaged.hdf5 can't be read")
    process = run(*program, "--out", out)
    assert process.returncode and "name at least one file to join" in process.stderr


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    def full(path, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(wpc, "write_file", full)
    path = write(tmp_path / "a.hdf5", columns(0))
    with pytest.raises(SystemExit, match="No space left on device"):
        join_files(tmp_path / "joined.hdf5", path)
    assert list(tmp_path.iterdir()) == [path]
