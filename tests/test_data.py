# SPDX-License-Identifier: MIT
"""From an HDF5 file to transitions: against a slow loop, on files good and bad."""

import subprocess
import sys

import h5py
import numpy as np
import pytest
import torch
from conftest import DATASET, ROOT, SCRIPTS, d4rl_arrays, wpc, write_hdf5
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st


def load_dataset(path, state_dim=17, action_dim=6, script=wpc, **options):
    args = script.Args(**{"batch_size": 1, **options})
    return script.load_dataset(path, state_dim, action_dim, args)


def slow_load(arrays):
    """d4rl.qlearning_dataset row by row: transitions by the row that they are from, and
    the rows of each episode."""
    transitions, episodes, episode = {}, [], []
    rows = len(arrays["rewards"])
    for i in range(rows):
        episode.append(i)
        if not arrays["timeouts"][i] and i + 1 < rows:
            transitions[i] = {
                "observations": arrays["observations"][i],
                "actions": arrays["actions"][i],
                "rewards": arrays["rewards"][i],
                "next_observations": arrays["observations"][i + 1],
                "terminals": arrays["terminals"][i],
            }
        # A terminal row may be followed by one that only holds the last observation.
        goes_on = i + 1 < rows and arrays["timeouts"][i + 1]
        ends = arrays["timeouts"][i] or (arrays["terminals"][i] and not goes_on)
        if ends or i + 1 == rows:
            episodes.append(episode)
            episode = []
    return transitions, episodes


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
        "rewards": rng.normal(size=reward_shape).astype(float_type),
        "terminals": np.isin(ends, ["terminal", "both"]).astype(flag_type),
        "timeouts": np.isin(ends, ["timeout", "both"]).astype(flag_type),
    }
    if draw(st.booleans()):
        arrays["next_observations"] = np.full((rows, 1), np.nan)  # is not used
        arrays |= {"infos/qpos": np.zeros((rows, 2)), "metadata/algorithm": "SAC"}
    return arrays


fresh_folder_each = [HealthCheck.function_scoped_fixture]


@settings(max_examples=150, deadline=None, suppress_health_check=fresh_folder_each)
@given(arrays=files())
def test_random_files_load_as_in_a_slow_loop(tmp_path, arrays):
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    state_dim, action_dim = arrays["observations"].shape[1], arrays["actions"].shape[1]
    options = {"discount": 0.9, "weight": "static"}
    expected, episodes = slow_load(arrays)
    if not expected:
        with pytest.raises(SystemExit, match="has 0 transitions"):
            load_dataset(path, state_dim, action_dim, **options)
        return
    dataset, discounted_returns = load_dataset(path, state_dim, action_dim, **options)

    for key in ("observations", "actions", "rewards", "next_observations", "terminals"):
        column = np.array([row[key] for row in expected.values()], dtype=np.float32)
        assert dataset[key].dtype == torch.float32
        assert np.array_equal(dataset[key], column.reshape(len(expected), -1)), key

    rewards = arrays["rewards"].reshape(-1).astype(np.float32).astype(np.float64)
    discounted = [
        sum(rewards[i] * 0.9**t for t, i in enumerate(episode)) for episode in episodes
    ]
    assert discounted_returns == pytest.approx(discounted, abs=1e-9)

    returns = [sum(rewards[i] for i in episode) for episode in episodes]
    middle = np.median(returns)
    better = {
        i
        for total, episode in zip(returns, episodes, strict=True)
        for i in episode
        if total >= middle
    }
    assert dataset["better_half"][:, 0].tolist() == [i in better for i in expected]


def test_which_rows_are_dropped_by_hand(tmp_path):
    arrays = d4rl_arrays(6, 1, 1)
    arrays["observations"] = np.arange(6, dtype=np.float32)[:, None]
    arrays["terminals"] = np.array([0, 0, 1, 0, 1, 0], bool)
    arrays["timeouts"] = np.array([0, 1, 0, 0, 1, 0], bool)
    dataset, _ = load_dataset(write_hdf5(tmp_path / "data.hdf5", arrays), 1, 1)
    # 1 is a timeout, 4 a timeout and terminal, 5 the last row
    assert dataset["observations"][:, 0].tolist() == [0, 2, 3]
    assert dataset["terminals"][:, 0].tolist() == [0, 1, 0]
    assert dataset["next_observations"][:, 0].tolist() == [1, 3, 4]


HALVES = [([1, 3, 2], [0, 1, 1]), ([4, 1, 2, 3], [1, 0, 0, 1]), ([5, 5], [1, 1])]


@pytest.mark.parametrize("returns, half", HALVES)
def test_the_better_half_of_the_episodes(tmp_path, returns, half):
    arrays = d4rl_arrays(2 * len(returns), 1, 1)
    arrays["rewards"] = np.repeat(np.float32(returns) / 2, 2)
    arrays["terminals"] = np.arange(2 * len(returns)) % 2 == 1
    arrays["timeouts"] = np.zeros(2 * len(returns), bool)
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    dataset, _ = load_dataset(path, 1, 1, weight="static")
    expected = np.repeat(half, 2)[:-1].tolist()  # the last row gives no transition
    assert dataset["better_half"][:, 0].tolist() == expected
    assert "better_half" not in load_dataset(path, 1, 1)[0]  # Figure 4 alone needs it


def test_normalize_states_by_hand():
    states = torch.tensor([[0.0, 5.0], [2.0, 5.0], [4.0, 5.0]])
    transitions = {"observations": states.clone(), "next_observations": states + 1}
    mean, std = wpc.normalize_states(transitions)
    assert mean.tolist() == [2, 5]
    assert std.tolist() == pytest.approx([(8 / 3) ** 0.5 + 1e-3, 1e-3])
    for key, raw in (("observations", states), ("next_observations", states + 1)):
        assert transitions[key].numpy() == pytest.approx(((raw - mean) / std).numpy())


def test_batches_are_uniform_with_replacement():
    dataset = {"rewards": torch.arange(4.0)[:, None], "actions": torch.arange(4.0)}
    torch.manual_seed(0)
    batch = wpc.sample_batch(dataset, 40_000)
    assert torch.equal(batch["rewards"][:, 0], batch["actions"])  # the same rows
    counts = batch["actions"].int().bincount()
    assert (counts / 40_000).tolist() == pytest.approx([0.25] * 4, abs=0.01)


def test_the_scripts_load_alike():
    ours, our_returns = load_dataset(DATASET)
    for script in SCRIPTS.values():
        dataset, returns = load_dataset(DATASET, script=script)
        assert dataset.keys() == ours.keys() and (returns == our_returns).all()
        assert all(torch.equal(dataset[key], ours[key]) for key in ours)


def without(key):
    return lambda arrays: arrays.pop(key)


def replaced(key, change):
    return lambda arrays: arrays.update({key: change(arrays[key])})


def with_value(key, value):
    def change(array):
        array = array.astype(np.float64)
        array[7] = value
        return array

    return replaced(key, change)


def every(change):
    return lambda arrays: arrays.update({k: change(v) for k, v in arrays.items()})


BAD = [
    (without("observations"), "has no 'observations'"),
    (without("actions"), "has no 'actions'"),
    (without("rewards"), "has no 'rewards'"),
    (without("terminals"), "has no 'terminals'"),
    (without("timeouts"), "has no 'timeouts'"),
    (
        replaced("actions", lambda x: x[:-1]),
        r"'actions' has shape \(39, 6\), not \(40, 6\)",
    ),
    (replaced("timeouts", lambda x: x[:-2]), r"'timeouts' has shape \(38, 1\), not"),
    (
        replaced("observations", lambda x: x[:, :11]),
        r"has shape \(40, 11\), not \(40, 17\)",
    ),
    (replaced("actions", lambda x: x[:, :3]), r"'actions' has shape \(40, 3\)"),
    (
        replaced("rewards", lambda x: np.stack([x, x], 1)),
        r"'rewards' has shape \(40, 2\)",
    ),
    (replaced("terminals", lambda x: np.bool_(True)), "in D4RL's format"),
    (replaced("rewards", lambda x: np.array([b"one"] * 40)), "in D4RL's format"),
    (lambda a: a.update({"rewards/inner": a.pop("rewards")}), "in D4RL's format"),
    (with_value("observations", np.nan), "'observations' holds NaN or infinite"),
    (with_value("actions", -np.inf), "'actions' holds NaN or infinite"),
    (with_value("rewards", 1e300), "'rewards' holds NaN or infinite"),
    (with_value("terminals", np.nan), "'terminals' holds NaN or infinite"),
    (every(lambda x: x[:0]), "has 0 transitions, too few"),
    (every(lambda x: x[:1]), "has 0 transitions"),
    (lambda a: a.update(timeouts=np.ones(40, bool)), "has 0 transitions"),
]


@pytest.mark.filterwarnings("error")  # and no warning stands before the sentence
@pytest.mark.parametrize("spoil, sentence", BAD, ids=[sentence for _, sentence in BAD])
def test_bad_files_are_refused_in_one_sentence(tmp_path, spoil, sentence):
    arrays = d4rl_arrays(40)
    spoil(arrays)
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    with pytest.raises(SystemExit, match=sentence) as stop:
        load_dataset(path)
    assert str(path) in stop.value.code and "\n" not in stop.value.code


def test_a_batch_larger_than_the_dataset_is_refused(tmp_path):
    path = write_hdf5(tmp_path / "data.hdf5", d4rl_arrays(40))
    with pytest.raises(SystemExit, match="too few for --batch-size 256"):
        load_dataset(path, batch_size=256)


NO_HDF5 = {"empty": b"", "text": b"none", "short": DATASET.read_bytes()[:100_000]}


@pytest.mark.parametrize("content", NO_HDF5.values(), ids=NO_HDF5)
def test_files_that_are_no_hdf5_or_cut_short(tmp_path, content):
    path = tmp_path / "data.hdf5"
    path.write_bytes(content)
    with pytest.raises(SystemExit, match="delete it to download it again"):
        load_dataset(path)


def damage(content, rng):
    """The bytes with some flipped, or cut short."""
    content = bytearray(content)
    if rng.random() < 0.3:
        return bytes(content[: rng.integers(len(content))])
    for i in rng.integers(len(content), size=rng.integers(1, 4)):
        content[i] ^= 1 << rng.integers(8)
    return bytes(content)


def test_damaged_files(tmp_path):
    """They are told, or load as something that fits."""
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
            dataset, _ = load_dataset(path)
            assert dataset["observations"].shape[1] == 17
            assert all(torch.isfinite(column).all() for column in dataset.values())
        except SystemExit as stop:
            told += 1
            assert str(path) in stop.code and "\n" not in stop.code
    assert told > 100


MEASURE = """
import time, wpc
def peak():
    return 1024 * int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0])
before, start = peak(), time.perf_counter()
dataset, _ = wpc.load_dataset({path!r}, {state_dim}, {action_dim}, wpc.Args())
wpc.normalize_states(dataset)
size = sum(column.nbytes for column in dataset.values())
print(time.perf_counter() - start, (peak() - before) / size, len(dataset["rewards"]))
"""
FULL_SIZES = [  # one of each kind of D4RL's files
    (1_000_000, 11, 3, np.float32),
    (402_000, 11, 3, np.float64),
    (2_000_000, 17, 6, np.float32),
]


@pytest.mark.parametrize("rows, state_dim, action_dim, dtype", FULL_SIZES)
def test_full_size_files_load_in_seconds_within_three_times_their_size(
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
    seconds, memory, transitions = map(float, process.stdout.split())
    assert transitions == rows - rows // 1000
    assert seconds < 60 and 1 < memory < 3
