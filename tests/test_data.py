# SPDX-License-Identifier: MIT
"""From an HDF5 file to transitions: against a slow loop, on files good and bad."""

import fcntl
import subprocess
import sys

import h5py
import numpy as np
import pytest
import torch
from conftest import DATASET, ROOT, SCRIPTS, d4rl_arrays, wpc, wpc_with, write_hdf5
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

EPISODES = ROOT.parent / "shared/d4rl/episodes"


def load_dataset(path, state_dim=17, action_dim=6, max_action=1.0, script=wpc, **kw):
    args = script.Args(env="Mine-v0", dataset=str(path), **kw)
    arrays = script.read_dataset(path, state_dim, action_dim, max_action)
    return script.prepare_dataset(arrays, args)


def slow_load(arrays, discount):
    """Row by row: the transitions, by the row that they are from, the rows of each
    episode, and the rows' best discounted return-to-go."""
    flags = (arrays[key].ravel() > 0 for key in ("terminals", "timeouts"))
    terminals, timeouts = map(np.ndarray.tolist, flags)
    rewards = np.float64(np.float32(arrays["rewards"])).ravel()
    transitions, episodes, best = {}, [[]], -np.inf
    rows = len(rewards)
    for i in range(rows):
        episodes[-1].append(i)
        if (terminals[i] or not timeouts[i]) and i + 1 < rows:
            transitions[i] = {key: arrays[key][i] for key in KEYS if key in arrays}
            if "next_observations" not in arrays:
                transitions[i]["next_observations"] = arrays["observations"][i + 1]
        if (terminals[i] or timeouts[i]) and i + 1 < rows:
            episodes.append([])
    for episode in episodes:
        for i in episode:
            rest = [discount ** (j - i) * rewards[j] for j in episode if j >= i]
            best = max(best, sum(rest))
    return transitions, episodes, best


KEYS = ("observations", "actions", "rewards", "next_observations", "terminals")


@st.composite
def files(draw):
    """The arrays of a random file: sizes, ends of episodes, types, and other groups."""
    rows, seed = draw(st.integers(2, 60)), draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    float_type = draw(st.sampled_from([np.float32, np.float64]))
    flag_type = draw(st.sampled_from([bool, np.uint8, np.float32]))
    end = st.sampled_from(["", "", "", "terminal", "timeout", "both"])
    ends = np.array(draw(st.lists(end, min_size=rows, max_size=rows)))
    states = rng.normal(3, 2, (rows, draw(st.integers(1, 4))))
    actions = rng.uniform(-1, 1, (rows, draw(st.integers(1, 3))))
    reward_shape = draw(st.sampled_from([(rows,), (rows, 1)]))
    arrays = {
        "observations": states.astype(float_type),
        "actions": actions.astype(float_type),
        "rewards": rng.normal(-1, 1, reward_shape).astype(float_type),
        "terminals": np.isin(ends, ["terminal", "both"]).astype(flag_type),
        "timeouts": np.isin(ends, ["timeout", "both"]).astype(flag_type),
    }
    if draw(st.booleans()):
        arrays["terminals"] = arrays["terminals"][:, None]
        arrays["timeouts"] = arrays["timeouts"][:, None]
    if draw(st.booleans()):
        arrays["next_observations"] = (states + rng.normal()).astype(float_type)
        arrays |= {"infos/qpos": np.zeros((rows, 2)), "metadata/algorithm": "SAC"}
    return arrays


fresh_folder_each = [HealthCheck.function_scoped_fixture]


@settings(max_examples=150, deadline=None, suppress_health_check=fresh_folder_each)
@given(arrays=files())
def test_random_files_load_as_in_a_slow_loop(tmp_path, arrays):
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    state_dim, action_dim = arrays["observations"].shape[1], arrays["actions"].shape[1]
    options = {"discount": 0.9, "script": wpc_with("static")}
    expected, episodes, best = slow_load(arrays, 0.9)
    if not expected:
        with pytest.raises(wpc_with("static").UserError, match=r"\b0 transitions"):
            load_dataset(path, state_dim, action_dim, **options)
        return
    dataset, mean, std, best_return = load_dataset(
        path, state_dim, action_dim, **options
    )
    assert best_return == pytest.approx(best, abs=1e-9)

    columns = {}
    for key in KEYS:
        column = np.array([row[key] for row in expected.values()], dtype=np.float32)
        columns[key] = column.reshape(len(expected), -1)
    states = np.float64(columns["observations"])
    assert mean.numpy() == pytest.approx(states.mean(axis=0), rel=1e-6)
    assert std.numpy() == pytest.approx(states.std(axis=0) + 1e-3, rel=1e-5)
    for key in ("observations", "next_observations"):
        columns[key] = (columns[key] - mean.numpy()) / std.numpy()
    for key, column in columns.items():
        assert dataset[key].dtype == torch.float32
        assert np.array_equal(dataset[key], column), key

    rewards = np.float64(np.float32(arrays["rewards"])).ravel()
    returns = [sum(rewards[i] for i in episode) for episode in episodes]
    middle = np.median(returns)
    better = {
        i
        for total, episode in zip(returns, episodes, strict=True)
        for i in episode
        if total >= middle
    }
    assert dataset["better_half"][:, 0].tolist() == [i in better for i in expected]
    assert dataset.keys() == {*KEYS, "better_half"}


def raw(dataset, mean, std, key="observations"):
    """The first component of states as they are in the file."""
    return (dataset[key] * std + mean)[:, 0].numpy().round(4).tolist()


def test_which_rows_are_dropped_by_hand(tmp_path):
    arrays = d4rl_arrays(6, 1, 1)
    arrays["observations"] = np.arange(6, dtype=np.float32)[:, None]
    arrays["terminals"] = np.array([0, 0, 1, 0, 1, 0], bool)
    arrays["timeouts"] = np.array([0, 1, 0, 0, 1, 0], bool)
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    *loaded, _ = load_dataset(path, 1, 1)
    # 1 is a timeout, 5 the last row; 4 is a timeout, too, but terminal
    assert raw(*loaded) == [0, 2, 3, 4]
    assert raw(*loaded, "next_observations") == [1, 3, 4, 5]
    assert loaded[0]["terminals"][:, 0].tolist() == [0, 1, 0, 1]


def test_rows_that_are_terminal_and_timeouts_end_the_task(tmp_path):
    """As where Gymnasium's terminated and truncated are both true, or where timeouts
    mark the end of every episode."""
    arrays = d4rl_arrays(30, 1, 1)
    ends = np.arange(30) % 10 == 9
    for timeouts in (ends, np.zeros(30, bool)):
        arrays |= {"terminals": ends, "timeouts": timeouts}
        path = write_hdf5(tmp_path / "data.hdf5", arrays)
        dataset, *_ = load_dataset(path, 1, 1)
        assert dataset["terminals"][:, 0].tolist() == ends[:-1].tolist()


def test_the_best_return_by_hand(tmp_path):
    """It may begin in the middle of an episode, and doesn't go on past an end."""
    arrays = d4rl_arrays(9, 1, 1)
    arrays["rewards"] = np.float32([-9, 4, 4, 5, 0, 5, -1, 6, 2])
    cases = {  # by the row that ends an episode, and how
        (): 4 + 0.5 * (4 + 0.5 * (5 + 0.5 * (0 + 0.5 * (5 + 0.5 * 2.5)))),
        (2, "terminals"): 6 + 0.5 * 2,
        (2, "timeouts"): 6 + 0.5 * 2,
        (7, "timeouts"): 4 + 0.5 * (4 + 0.5 * (5 + 0.5 * (0 + 0.5 * (5 + 0.5 * 2)))),
    }
    for end, best in cases.items():
        for key in ("terminals", "timeouts"):
            arrays[key] = np.zeros(9, bool)
        if end:
            row, key = end
            arrays[key][row] = True
        path = write_hdf5(tmp_path / "data.hdf5", arrays)
        assert load_dataset(path, 1, 1, discount=0.5)[-1] == pytest.approx(best), end


def test_shuffled_and_subsampled_files_give_their_own_pairs(tmp_path):
    states = np.float32(np.random.default_rng(0).permutation(300))[:, None]
    arrays = d4rl_arrays(300, 1, 1) | {"observations": states}
    arrays["next_observations"] = states + 0.5
    shuffled = np.random.default_rng(1).permutation(300)
    for order in (shuffled, np.arange(0, 300, 7)):
        file = {key: column[order] for key, column in arrays.items()}
        *loaded, _ = load_dataset(write_hdf5(tmp_path / "data.hdf5", file), 1, 1)
        assert raw(*loaded) == states[order][:-1][~file["timeouts"][:-1], 0].tolist()
        following = raw(*loaded, "next_observations")
        assert following == [x + 0.5 for x in raw(*loaded)]


@pytest.mark.skipif(
    not EPISODES.exists(), reason=f"no episodes of D4RL's in {EPISODES}"
)
@pytest.mark.parametrize("robot", wpc.D4RL_ROBOTS)
def test_d4rls_own_files_train_the_same_without_next_observations(tmp_path, robot):
    """But for the next states of terminal rows, which don't count."""
    arrays = dict(np.load(EPISODES / f"{robot}_medium-v2.npz"))
    dims = arrays["observations"].shape[1], arrays["actions"].shape[1]
    path = write_hdf5(tmp_path / "with.hdf5", arrays)
    theirs, *facts = load_dataset(path, *dims)
    arrays.pop("next_observations")
    path = write_hdf5(tmp_path / "without.hdf5", arrays)
    ours, *our_facts = load_dataset(path, *dims)
    assert all(map(np.array_equal, facts, our_facts))
    running = theirs["terminals"][:, 0] == 0
    assert len(running) - running.sum() == (robot == "hopper")  # the other is the last
    for key in KEYS:
        same = (theirs[key] == ours[key]).all(dim=1)
        assert same[running].all()
        assert same.all() or key == "next_observations"


# Figure 4's weight, of the copy of wpc.py that tests/tools/weights.py writes
HALVES = [([1, 3, 2], [0, 1, 1]), ([4, 1, 2, 3], [1, 0, 0, 1]), ([5, 5], [1, 1])]


@pytest.mark.parametrize("returns, half", HALVES)
def test_the_better_half_of_the_episodes(tmp_path, returns, half):
    arrays = d4rl_arrays(2 * len(returns), 1, 1)
    arrays["rewards"] = np.repeat(np.float32(returns) / 2, 2)
    arrays["terminals"] = np.arange(2 * len(returns)) % 2 == 1
    arrays["timeouts"] = np.zeros(2 * len(returns), bool)
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    dataset, *_ = load_dataset(path, 1, 1, script=wpc_with("static"))
    expected = np.repeat(half, 2)[:-1].tolist()  # the last row gives no transition
    assert dataset["better_half"][:, 0].tolist() == expected
    assert "better_half" not in load_dataset(path, 1, 1)[0]  # Figure 4 alone needs it


def test_normalization_by_hand(tmp_path):
    """By mean and deviation of the states that transitions start from."""
    arrays = d4rl_arrays(5, 2, 1)
    arrays["observations"] = np.float32([[0, 5], [2, 5], [4, 5], [90, 90], [80, 80]])
    arrays["timeouts"][3] = True
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    dataset, mean, std, _ = load_dataset(path, 2, 1)
    assert mean.tolist() == [2, 5]
    deviation = (8 / 3) ** 0.5 + 1e-3
    assert std.tolist() == pytest.approx([deviation, 1e-3])
    assert dataset["observations"][:, 0].numpy() == pytest.approx(
        np.array([-2, 0, 2]) / deviation
    )
    assert dataset["next_observations"].numpy() == pytest.approx(
        np.array([[0, 0], [2 / deviation, 0], [88 / deviation, 85_000]])
    )


def test_batches_are_uniform_with_replacement():
    dataset = {"rewards": torch.arange(4.0)[:, None], "actions": torch.arange(4.0)}
    torch.manual_seed(0)
    batch = wpc.sample_batch(dataset, 40_000)
    assert torch.equal(batch["rewards"][:, 0], batch["actions"])  # the same rows
    counts = batch["actions"].int().bincount()
    assert (counts / 40_000).tolist() == pytest.approx([0.25] * 4, abs=0.01)


def test_arrays_in_memory_stay_as_they_are():
    arrays = wpc.read_dataset(DATASET, 17, 6, 1.0)
    copies = {key: column.copy() for key, column in arrays.items()}
    static = wpc_with("static")
    args = static.Args(env="halfcheetah", dataset="-", device="cpu")
    static.prepare_dataset(arrays, args)
    assert arrays.keys() == copies.keys()
    assert all(np.array_equal(arrays[key], copies[key]) for key in arrays)


def test_the_scripts_load_alike():
    ours, *facts = load_dataset(DATASET)
    for script in SCRIPTS.values():
        dataset, *their_facts = load_dataset(DATASET, script=script)
        assert dataset.keys() == ours.keys()
        assert all(map(np.array_equal, facts, their_facts))
        assert all(torch.equal(dataset[key], ours[key]) for key in ours)


def test_actions_at_the_bounds_are_fine(tmp_path):
    """Whatever the bounds are, and with a policy's rounding."""
    arrays = d4rl_arrays(40)
    arrays["actions"] = np.sign(arrays["actions"]) * 2.001
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    dataset, *_ = load_dataset(path, max_action=2.0)
    assert len(dataset["actions"]) == 38
    assert dataset["actions"].abs().max() == pytest.approx(2.001)
    with pytest.raises(wpc.UserError, match=r"actions within \+-1\.0"):
        load_dataset(tmp_path / "data.hdf5", max_action=1.0)


# Files that can't be read


def reason(path):
    """Why a file can't be read: one sentence, which names the file, gives the library's
    own reason, and advises nothing."""
    with pytest.raises(wpc.UserError) as stop:
        load_dataset(path)
    sentence = str(stop.value)
    assert sentence.startswith(f"{path} can't be read: ") and "\n" not in sentence
    assert "delete" not in sentence and "damaged" not in sentence
    return sentence


def test_files_that_are_no_hdf5_or_not_there(tmp_path):
    path = tmp_path / "data.hdf5"
    assert "No such file" in reason(path)
    for content in (b"", b"none"):
        path.write_bytes(content)
        assert "file signature not found" in reason(path)
    path.write_bytes(DATASET.read_bytes()[:100_000])
    assert "truncated file" in reason(path)


def test_a_file_that_another_process_writes(tmp_path):
    path = write_hdf5(tmp_path / "data.hdf5", d4rl_arrays(40))
    with path.open("rb+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert "unable to lock file" in reason(path)
    load_dataset(path)


def test_a_column_that_cannot_be_decompressed(tmp_path):
    """A filter whose plugin is not installed, and bytes that are no gzip."""
    path = write_hdf5(tmp_path / "data.hdf5", d4rl_arrays(40))
    gzip = h5py.h5z.FILTER_DEFLATE
    for number, words in ((32_001, "plugin"), (gzip, "filter returned failure")):
        with h5py.File(path, "a") as file:
            del file["rewards"]
            properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            properties.set_chunk((40,))
            properties.set_filter(number, h5py.h5z.FLAG_OPTIONAL, (4,))
            space = h5py.h5s.create_simple((40,))
            column = h5py.h5d.create(
                file.id, b"rewards", h5py.h5t.IEEE_F32LE, space, properties
            )
            column.write_direct_chunk((0,), b"no such format")
        assert words in reason(path)


def damage(content, rng):
    """The bytes with some flipped, or cut short."""
    content = bytearray(content)
    if rng.random() < 0.3:
        return bytes(content[: rng.integers(len(content))])
    for i in rng.integers(len(content), size=rng.integers(1, 4)):
        content[i] ^= 1 << rng.integers(8)
    return bytes(content)


def test_damaged_files(tmp_path):
    """They are told in a sentence, or load as something that fits."""
    rng, told = np.random.default_rng(0), 0
    arrays = d4rl_arrays(40)
    plain, packed = write_hdf5(tmp_path / "plain.hdf5", arrays), tmp_path / "packed"
    with h5py.File(packed, "w") as file:
        for key, value in arrays.items():
            file.create_dataset(key, data=value, compression="gzip", chunks=True)
    path = tmp_path / "damaged.hdf5"
    for i in range(400):
        path.write_bytes(damage((plain, packed)[i % 2].read_bytes(), rng))
        try:
            dataset, *_ = load_dataset(path)
        except wpc.UserError as error:
            told += 1
            assert str(path) in str(error) and "\n" not in str(error)
        else:
            assert dataset["observations"].shape[1] == 17
            assert all(torch.isfinite(column).all() for column in dataset.values())
    assert told > 100


MEASURE = """
import time, wpc
def peak():
    return 1024 * int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0])
before, start = peak(), time.perf_counter()
arrays = wpc.read_dataset({path!r}, {state_dim}, {action_dim}, 1.0)
dataset, *_ = wpc.prepare_dataset(arrays, wpc.Args())
size = sum(column.nbytes for column in dataset.values())
print(time.perf_counter() - start, (peak() - before) / size, len(dataset["rewards"]))
"""
FULL_SIZES = [  # a replay file of D4RL's, and a medium one
    (402_000, 11, 3, np.float64),
    (1_000_000, 17, 6, np.float32),
]


@pytest.mark.parametrize("rows, state_dim, action_dim, dtype", FULL_SIZES)
def test_full_size_files_load_in_seconds_within_five_times_their_size(
    tmp_path, rows, state_dim, action_dim, dtype
):
    arrays = {
        "observations": np.ones((rows, state_dim), dtype),
        "actions": np.zeros((rows, action_dim), dtype),
        "rewards": np.ones(rows, dtype),
        "terminals": np.zeros(rows, bool),
        "timeouts": np.arange(rows) % 1000 == 999,
        "infos/qpos": np.zeros((rows, 2), dtype),
        "metadata/policy/fc0/weight": np.zeros((256, state_dim), dtype),
        "metadata/policy/nonlinearity": "relu",
    }
    path = str(write_hdf5(tmp_path / "data.hdf5", arrays))
    program = MEASURE.format(path=path, state_dim=state_dim, action_dim=action_dim)
    line = [sys.executable, "-c", program]
    process = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=True)
    seconds, memory, transitions = map(float, process.stdout.splitlines()[-1].split())
    assert transitions == rows - rows // 1000
    assert seconds < 60 and 1 < memory < 5
