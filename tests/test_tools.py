# SPDX-License-Identifier: MIT
"""The tools that make datasets and films: make_dataset.py, from_minari.py, play.py, and
check_steps.py.

tests/data/minari holds datasets that Minari's own DataCollector made (see
tests/data/minari/make.py): some episodes of Hopper-v5 end and some are cut off,
all of Pendulum-v1's are cut off.
"""

import hashlib
import importlib.util
import os
import re
import runpy
import shlex
import sys
import warnings
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import h5py
import minari
import mujoco
import numpy as np
import pytest
import torch
from conftest import DATASET, ROOT, assert_one_sentence, run, run_here, wpc, wpc_with
from gymnasium.spaces import Box, Dict, Discrete
from minari.data_collector import EpisodeBuffer
from PIL import Image
from scipy.stats import norm

sys.path.insert(0, str(ROOT / "tests/tools"))
import check_steps
import eras  # noqa: F401, registers Hopper-before-3.5-v5
import from_minari
import make_dataset
import play

MINARI = ROOT / "tests/data/minari/test"
D4RL = ROOT.parent / "shared/d4rl"  # not in the repository
SHORT = ["--max-timesteps", 2, "--eval-freq", 2, "--eval-episodes", 1]
SHORT += ["--batch-size", 32, "--device", "cpu"]


def read(path):
    with h5py.File(path) as file:
        return {key: file[key][:] for key in file}


def refusal_of(main, args):
    """The sentence with which a tool ends."""
    with pytest.raises((SystemExit, getattr(wpc, "UserError", SystemExit))) as stop:
        main(args)
    sentence = str(stop.value)
    assert sentence and "\n" not in sentence
    return sentence


def run_printed_command(output, run_dir):
    """Runs the command that a tool printed last, for a few steps."""
    line = output.splitlines()[-1].removeprefix("to train: ")
    run_here(wpc, *shlex.split(line), *SHORT, "--run-dir", run_dir)
    assert (run_dir / "checkpoint.pt").exists()


# make_dataset.py


def collect(out, steps, **options):
    make_dataset.main(make_dataset.Args("hopper", steps, out, **options))
    return read(out)


def random_policy():
    """A policy of Hopper's shapes, by the names of D4RL's files."""
    rng = np.random.default_rng(0)
    layers = {"fc0": (256, 11), "fc1": (256, 256)}
    layers |= dict.fromkeys(("last_fc", "last_fc_log_std"), (3, 256))
    arrays = {}
    for layer, shape in layers.items():
        arrays[f"{layer}.weight"] = rng.normal(size=shape, scale=0.1)
        arrays[f"{layer}.bias"] = rng.normal(size=shape[0], scale=0.1)
    return arrays


@pytest.fixture
def policy(tmp_path):
    """The file of a policy."""
    np.savez(tmp_path / "policy.npz", **random_policy())
    return tmp_path / "policy.npz"


def test_a_policy_in_a_d4rl_file(tmp_path, policy):
    with h5py.File(tmp_path / "d4rl.hdf5", "w") as file:
        for name, array in random_policy().items():
            file[f"metadata/policy/{name.replace('.', '/')}"] = array
    theirs = make_dataset.load_policy(tmp_path / "d4rl.hdf5", 11, 3)
    ours = make_dataset.load_policy(policy, 11, 3)
    for pair, other in zip(ours, theirs, strict=True):
        assert all(map(np.array_equal, pair, other))


@pytest.mark.parametrize("robot", wpc.D4RL_ROBOTS)
def test_the_policy_gives_the_probabilities_that_d4rl_recorded(robot):
    if not D4RL.exists():
        pytest.skip(f"{D4RL} is not there")
    data = np.load(D4RL / f"episodes/{robot}_medium-v2.npz")
    states, actions = data["observations"], data["actions"].astype(float)
    path = D4RL / f"policies/{robot}_medium.npz"
    policy = make_dataset.load_policy(path, states.shape[1], actions.shape[1])
    outputs = [make_dataset.distribution(policy, state) for state in states]
    means, stds = zip(*outputs, strict=True)
    unsaturated = np.abs(actions).max(1) < 0.999  # else float32 tells too little
    ours = norm.logpdf(np.arctanh(actions.clip(-0.9999, 0.9999)), means, stds)
    ours = (ours - np.log(1 - actions**2 + 1e-6)).sum(1)
    theirs = data["action_log_probs"]
    assert unsaturated.mean() > 0.2
    assert ours[unsaturated] == pytest.approx(theirs[unsaturated], abs=0.01)


def rows_of(name, steps, seed=0, policy=None):
    """The columns of so many steps by a policy, or with uniform actions."""
    env = wpc.make_envs(name, 1).envs[0]
    args = make_dataset.Args(name, steps, Path("unused"), seed)
    data = make_dataset.make_columns(steps, env)
    assert [n for n, _ in make_dataset.collect(args, env, data, policy)][-1] == steps
    return data


def test_rows_follow_from_each_other_in_d4rls_physics(policy):
    policy = make_dataset.load_policy(policy, 11, 3)
    data = rows_of("hopper", 60, 7, policy)
    states, next_states = data["observations"], data["next_observations"]
    over, k = True, -1
    env = wpc.make_envs("hopper", 1).envs[0]
    for i in range(60):
        if over:  # each episode has random numbers of its own
            k += 1
            rng = np.random.default_rng([7, k])
            state, _ = env.reset(seed=int(rng.integers(2**31)))
        assert np.array_equal(states[i], np.float32(state))
        mean, std = make_dataset.distribution(policy, states[i])
        drawn = np.tanh(mean + std * rng.standard_normal(3))
        assert data["actions"][i] == pytest.approx(drawn, abs=1e-6)
        state, reward, over, *_ = env.step(data["actions"][i])
        assert np.array_equal(next_states[i], np.float32(state))
        assert data["rewards"][i] == np.float32(reward)
        assert data["terminals"][i] == over and not data["timeouts"][i]
    assert k > 1

    other_seed = rows_of("hopper", 1, 8, policy)
    assert not np.array_equal(other_seed["observations"][0], states[0])
    uniform = rows_of("hopper", 500)["actions"]
    shares = np.histogram(uniform, 4, (-1, 1))[0] / uniform.size
    assert shares == pytest.approx([0.25] * 4, abs=0.05)


def test_an_end_by_both_is_no_timeout():
    for terminal, truncated in ((True, True), (False, True), (True, False)):
        results = np.ones(2), 0.5, terminal, truncated, {}
        env = SimpleNamespace(step=lambda action, results=results: results)
        data = make_dataset.make_columns(2, Delayed)
        _, reward, over = make_dataset.do_step(env, np.zeros(2), np.zeros(1), data, 1)
        assert reward == 0.5 and over
        assert data["terminals"].tolist() == [False, terminal]
        assert data["timeouts"].tolist() == [False, not terminal]
        assert data["next_observations"].tolist() == [[0, 0], [1, 1]]


def test_the_last_episodes_return():
    env = wpc.make_envs("hopper", 1).envs[0]
    args = make_dataset.Args("hopper", 200, Path("unused"))
    data = make_dataset.make_columns(200, env)
    returns = [x for _, x in make_dataset.collect(args, env, data)]
    end, *_ = data["terminals"].nonzero()[0]
    assert np.isnan(returns[: end + 1]).all()
    assert returns[end + 1] == pytest.approx(data["rewards"][: end + 1].sum())


def test_actions_reach_the_bounds():
    zeros = np.zeros((256, 256)), np.zeros(256)
    w, b = np.zeros((1, 256)), np.full(1, 100.0)
    policy = [(np.zeros((256, 3)), zeros[1]), zeros, (w, b), (w, -b)]
    data = rows_of("Pendulum-v1", 300, 0, policy)
    assert (data["actions"] == 2).all() and data["timeouts"].nonzero()[0] == 199
    policy = [*policy[:3], (w, b)]
    mean, std = make_dataset.distribution(policy, np.zeros(3))
    assert mean == 100 and std == pytest.approx(np.exp(2))  # as D4RL's SAC


def test_the_file_is_cut_off_at_its_last_step(tmp_path, capsys):
    path = tmp_path / "random data.hdf5"
    data = collect(path, 100, random=True)
    assert {len(column) for column in data.values()} == {100}
    assert data["timeouts"].nonzero()[0].tolist() == [99] and not data["terminals"][99]
    output = capsys.readouterr().out
    ends = data["terminals"].nonzero()[0]
    returns = [x.sum() for x in np.split(data["rewards"].astype(float), ends + 1)]
    score = 100 * (np.mean(returns) + 20.272305) / (3234.3 + 20.272305)
    expected = f"100 transitions in {len(returns)} episodes, return "
    expected += f"{np.mean(returns):.1f} +- {np.std(returns):.1f}, largest "
    expected += f"{np.max(returns):.1f}; D4RL's score {score:.1f}"
    assert expected in output
    names = "observations actions rewards next_observations terminals timeouts"
    content = b"".join(data[name].tobytes() for name in names.split())
    assert f"arrays: {hashlib.sha256(content).hexdigest()}\n" in output
    run_printed_command(output, tmp_path / "run")


@pytest.mark.parametrize(
    "options, sentence",
    [
        ({"steps": 0}, "must be >= 1"),
        ({"policy": Path("policy.npz"), "random": True}, "exclude each other"),
    ],
)
def test_options_of_make_dataset_that_can_not_be(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        make_dataset.Args(**{"env": "hopper", "steps": 9, "out": Path("x")} | options)


class Delayed(gym.Env):
    """Episodes of two steps; the first action is paid for by the second step."""

    observation_space, action_space = Box(-2, 2, (2,)), Box(-2, 2, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.first = None
        return np.array([self.np_random.normal(), 0]), {}

    def step(self, action):
        if self.first is None:
            self.first = action[0]
            return np.array([self.first, 1]), 0.0, False, False, {}
        return np.array([9, 9]), -((self.first - 1.5) ** 2), True, False, {}


def learn(steps, seed=0, random_steps=80):
    """What SAC meets in this environment, and each step's last return."""
    args = make_dataset.Args("Delayed", steps, Path("unused"), seed)
    args.random_steps = random_steps
    data = make_dataset.make_columns(steps, Delayed)
    returns = [last for _, last in make_dataset.learn(args, Delayed(), data)]
    return data, returns


def test_sac_learns(monkeypatch):
    """To begin with 1.5, which pays best, where uniform actions average 0."""
    for name, fast in (("LEARNING_RATE", 3e-3), ("TAU", 0.05), ("BATCH_SIZE", 64)):
        monkeypatch.setattr(make_dataset, name, fast)
    data, returns = learn(400)
    space = Box(-2, 2, (1,), seed=0)
    assert data["actions"][:80].tolist() == [space.sample() for _ in range(80)]
    assert data["actions"][80] != space.sample()
    assert data["actions"][::2][-50:].mean() == pytest.approx(1.5, abs=0.4)
    assert returns[-1] == data["rewards"][-1]


def test_the_seed_is_that_of_states_and_actions():
    ours, same, other = (learn(12, seed, random_steps=8)[0] for seed in (0, 0, 1))
    assert all(np.array_equal(ours[key], same[key]) for key in ours)
    assert (ours["actions"] != other["actions"]).all()
    assert (ours["observations"][::2] != other["observations"][::2]).any()


def test_what_sac_met_is_written(tmp_path):
    path = tmp_path / "made.hdf5"
    args = make_dataset.Args("Pendulum-v1", 250, path, random_steps=240)
    make_dataset.main(args)
    data = read(path)
    assert data["timeouts"].nonzero()[0].tolist() == [199, 249]
    assert np.array_equal(data["observations"][1:200], data["next_observations"][:199])
    assert not np.array_equal(data["observations"][200], data["next_observations"][199])
    assert 1 < np.abs(data["actions"]).max() <= 2
    env = gym.make("Pendulum-v1").unwrapped
    env.reset()
    for i in range(250):  # with the actions that were taken, random or SAC's
        cos, sin, velocity = data["observations"][i].astype(float)
        env.state = np.array([np.arctan2(sin, cos), velocity])
        state, reward, *_ = env.step(data["actions"][i])
        assert data["next_observations"][i] == pytest.approx(state, abs=1e-4)
        assert data["rewards"][i] == pytest.approx(reward, abs=1e-4)


class Stop:
    """An environment in which Ctrl-C is pressed at a step, or that fails there."""

    def __init__(self, env, step, error=KeyboardInterrupt):
        self.env, self.steps_left, self.error = env, step, error

    def __getattr__(self, name):
        return getattr(self.env, name)

    def step(self, action):
        if self.steps_left == 0:
            raise self.error
        self.steps_left -= 1
        return self.env.step(action)


def test_ctrl_c_writes_what_sac_met(tmp_path, capsys, monkeypatch):
    path = tmp_path / "made.hdf5"
    args = make_dataset.Args("Pendulum-v1", 1000, path, random_steps=20)
    make_envs = wpc.make_envs

    def stop(*arguments):
        def make_stopping(name, count):
            env = make_envs(name, count).envs[0]
            return SimpleNamespace(envs=[Stop(env, *arguments)])

        monkeypatch.setattr(wpc, "make_envs", make_stopping)

    stop(30)
    make_dataset.main(args)
    data = read(path)
    assert {len(column) for column in data.values()} == {30}
    assert data["timeouts"][-1] and np.abs(data["observations"]).min() > 0
    assert "30 transitions in 1 episodes" in capsys.readouterr().out

    stop(31, ValueError)
    with pytest.raises(ValueError):
        make_dataset.main(args)
    assert len(read(path)["rewards"]) == 31

    path.unlink()
    stop(0)
    assert refusal_of(make_dataset.main, args) == "nothing was collected"
    assert not path.exists()


INTERRUPTED = """
import os, signal, sys
sys.path.insert(0, "tests/tools")
import make_dataset
collect = make_dataset.collect
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where it is ignored
def stopped(*arguments):
    for i, progress in enumerate(collect(*arguments)):
        yield progress
        if i == 299:
            os.kill(os.getpid(), signal.SIGNAL)
make_dataset.collect = stopped
make_dataset.main(make_dataset.Args("hopper", 100000, sys.argv[1], random=True))
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_writes_what_was_collected(tmp_path, name):
    path = tmp_path / "made.hdf5"
    line = INTERRUPTED.replace(
        "sys.argv[1]", f"__import__('pathlib').Path({str(path)!r})"
    ).replace("SIGNAL", name)
    process = run(sys.executable, "-c", line, cwd=ROOT)
    assert process.returncode == 0 and process.stderr == "", process.stderr
    data = read(path)
    assert all(len(column) == 300 for column in data.values())
    assert np.array_equal(data["actions"], rows_of("hopper", 300)["actions"])


NO_POLICY = [
    ("missing.hdf5", "No such file or directory"),
    ("no policy.hdf5", "no policy as D4RL's files record it"),
    ("no policy.npz", "no policy as D4RL's files record it"),
    ("no file.npz", "no policy as D4RL's files record it"),
    ("policy.npz", "for 11 states and 3 actions, and the environment has 17 and 6"),
]


@pytest.mark.parametrize("name, sentence", NO_POLICY)
def test_policies_that_do_not_fit(tmp_path, policy, name, sentence):
    np.savez(tmp_path / "no policy.npz", a=1)
    (tmp_path / "no file.npz").write_bytes(b"nonsense")
    with h5py.File(tmp_path / "no policy.hdf5", "w") as file:
        file["observations"] = 1
    out = tmp_path / "made.hdf5"
    args = make_dataset.Args("walker2d", 10, out, policy=tmp_path / name)
    assert sentence in refusal_of(make_dataset.main, args)
    assert not out.exists()


@pytest.fixture
def full_disk(monkeypatch):
    """The first file that is written fills the disk."""
    fsync, calls = os.fsync, []

    def fill(file):
        calls.append(file)
        if len(calls) == 1:
            raise OSError(28, "No space left on device")
        fsync(file)

    monkeypatch.setattr(os, "fsync", fill)


def test_a_full_disk_loses_nothing_that_was_collected(
    tmp_path, tmp_path_factory, full_disk, monkeypatch, capsys
):
    other = str(tmp_path_factory.mktemp("elsewhere"))
    monkeypatch.setattr(make_dataset.tempfile, "tempdir", other)
    out = tmp_path / "data.hdf5"
    make_dataset.main(make_dataset.Args("hopper", 50, out, random=True))
    printed = capsys.readouterr().out
    assert f"{out} can't be written: [Errno 28] No space left on device" in printed
    assert not list(tmp_path.iterdir())
    (elsewhere,) = re.findall(r"--dataset (.*)", printed)
    assert Path(elsewhere).parent.parent == Path(other)
    assert len(read(Path(elsewhere))["rewards"]) == 50


def test_a_full_disk_ends_from_minari_in_a_sentence(tmp_path, full_disk):
    dataset, out = str(MINARI / "hopper-v0"), tmp_path / "data.hdf5"
    args = from_minari.Args(dataset, out, "ShortHopper-v0")
    sentence = refusal_of(from_minari.main, args)
    assert "data.hdf5 can't be written: [Errno 28]" in sentence
    assert not list(tmp_path.iterdir())


def test_environments_that_the_scripts_can_not_use(tmp_path):
    args = make_dataset.Args("CartPole-v1", 10, tmp_path / "made.hdf5")
    sentence = refusal_of(make_dataset.main, args)
    assert "one-dimensional Boxes of states" in sentence
    line = [sys.executable, ROOT / "tests/tools/make_dataset.py", "--random"]
    line += ["--steps", 2, "--out", tmp_path / "made.hdf5", "--env", "nope-v0"]
    assert_one_sentence(run(*line), "Environment `nope` doesn't exist")


def test_out_is_tried_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(wpc, "make_envs", None)
    monkeypatch.setattr(from_minari, "open_dataset", None)
    out = tmp_path / "nofolder/made.hdf5"
    args = make_dataset.Args("hopper", 10, out, random=True)
    assert "--out can't be written: [Errno 2]" in refusal_of(make_dataset.main, args)
    args = from_minari.Args("mujoco/hopper/medium-v0", out)
    assert "--out can't be written: [Errno 2]" in refusal_of(from_minari.main, args)

    (tmp_path / "there.hdf5").write_text("kept")
    make_dataset.try_to_write(tmp_path / "there.hdf5")
    make_dataset.try_to_write(tmp_path / "new.hdf5")
    assert [x.name for x in tmp_path.iterdir()] == ["there.hdf5"]
    assert (tmp_path / "there.hdf5").read_text() == "kept"


# from_minari.py

PENDULUM = "gymnasium.envs.classic_control.pendulum:PendulumEnv"
HOPPER = "gymnasium.envs.mujoco.hopper_v5:HopperEnv"
gym.register("ShortHopper-v0", HOPPER, max_episode_steps=25)
gym.register("EndlessPendulum-v0", PENDULUM)
gym.register("ShortPendulum-v0", PENDULUM, max_episode_steps=20)
gym.register("LightPendulum-v0", PENDULUM, max_episode_steps=200, kwargs={"g": 2.0})
gym.register("OwnPendulum-v0", lambda: gym.make("Pendulum-v1"), max_episode_steps=200)


def convert(dataset, out, env=None):
    from_minari.main(from_minari.Args(str(dataset), out, env))
    return read(out)


def buffer(i, steps, is_terminal=False, **options):
    """An episode of Pendulum's shapes and random numbers."""
    rng = np.random.default_rng(i)
    ends = [False] * (steps - 1) + [True]
    arrays = {
        "observations": rng.normal(size=(steps + 1, 3)).astype(np.float32),
        "actions": rng.uniform(-2, 2, (steps, 1)).astype(np.float32),
        "rewards": list(rng.uniform(1, 2, steps)),
        "terminations": ends if is_terminal else [False] * steps,
        "truncations": [False] * steps if is_terminal else ends,
        "infos": {},
    }
    return EpisodeBuffer(id=i, **(arrays | options))


@pytest.fixture
def make(tmp_path, monkeypatch):
    """Makes a Minari dataset of episodes, and returns its name."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))

    def make(*episodes, **options):
        episodes = list(episodes)
        options = {
            "observation_space": Box(-np.inf, np.inf, (3,)),
            "action_space": Box(-2, 2, (1,)),
            "env": "Pendulum-v1",
        } | options
        with warnings.catch_warnings(action="ignore"):  # of what is left out
            minari.create_dataset_from_buffers("test/made-v0", episodes, **options)
        return "test/made-v0"

    return make


def assert_nothing_is_lost(path, dataset, state_dim, action_dim):
    """The scripts make Minari's transitions of the file, and know its episodes."""
    arrays = wpc.read_dataset(path, state_dim, action_dim, 2.0)
    static = wpc_with("static")
    data, mean, std, _ = static.prepare_dataset(arrays, static.Args())
    for key in ("observations", "next_observations"):
        data[key] = data[key] * std + mean
    keys = ("observations", "actions", "rewards", "next_observations", "terminals")
    ours = np.column_stack([data[key] for key in (*keys, "better_half")])

    episodes = list(dataset.iterate_episodes())
    returns = [np.float32(x.rewards).sum() for x in episodes]
    expected = []
    for x, episode_return in zip(episodes, returns, strict=True):
        states, next_states = x.observations[:-1], x.observations[1:]
        columns = [states, x.actions, x.rewards, next_states, x.terminations]
        columns.append(np.full(len(x.actions), episode_return >= np.median(returns)))
        expected.append(np.column_stack(columns))
    expected = np.concatenate(expected)
    # The file may have the episodes in another order; no two actions are the same.
    ours, expected = (x[x[:, state_dim].argsort()] for x in (ours, expected))
    assert ours == pytest.approx(expected, abs=1e-5)


STORED = [
    ("hopper-v0", "ShortHopper-v0", 11, 3),
    ("pendulum-v0", "ShortPendulum-v0", 3, 1),
]


@pytest.mark.parametrize("name, env, state_dim, action_dim", STORED)
def test_no_transition_of_minaris_is_lost(tmp_path, name, env, state_dim, action_dim):
    convert(MINARI / name, tmp_path / "data.hdf5", env)
    dataset = minari.MinariDataset(MINARI / name / "data")
    assert_nothing_is_lost(tmp_path / "data.hdf5", dataset, state_dim, action_dim)


def test_the_stored_episodes_end_in_both_ways():
    dataset = minari.MinariDataset(MINARI / "hopper-v0/data")
    ends = {bool(e.terminations[-1]) for e in dataset.iterate_episodes()}
    assert ends == {True, False}


@pytest.mark.parametrize("ends", [[0, 0, 0], [0, 1, 0], [0, 1, 1], [1, 0, 1, 1]])
def test_no_transition_is_lost_however_episodes_end(tmp_path, make, ends):
    buffers = [buffer(i, 3 + i, bool(end)) for i, end in enumerate(ends)]
    name = make(*buffers)
    data = convert(name, tmp_path / "data.hdf5")
    assert_nothing_is_lost(tmp_path / "data.hdf5", minari.load_dataset(name), 3, 1)
    steps = sum(len(x.rewards) for x in buffers)
    assert len(data["rewards"]) == steps + ends.count(0)  # a row for each cut-off
    assert data["timeouts"].sum() == ends.count(0)


def test_no_transition_is_lost_if_all_episodes_are_terminal(tmp_path, make):
    # As the scripts drop the last row, there must be one that belongs to no episode.
    name = make(*(buffer(i, 3 + i, True) for i in range(3)))
    convert(name, tmp_path / "data.hdf5")
    args = wpc.Args()
    arrays = wpc.read_dataset(tmp_path / "data.hdf5", 3, 1, 2.0)
    data, *_ = wpc.prepare_dataset(arrays, args)
    rewards = np.concatenate([buffer(i, 3 + i).rewards for i in range(3)])
    assert data["rewards"].ravel().tolist() == np.float32(rewards).tolist()
    assert data["terminals"].sum() == 3


def test_an_end_of_both_kinds_is_terminal(tmp_path, make):
    both = [False, False, True]
    name = make(buffer(0, 3), buffer(1, 3, terminations=both, truncations=both))
    data = convert(name, tmp_path / "data.hdf5")
    assert data["terminals"].tolist() == [False, False, True, *[False] * 4]
    assert data["timeouts"].tolist() == [*[False] * 6, True]
    assert np.array_equal(data["observations"][3:], buffer(0, 3).observations)


def test_from_minari_prints_the_command_that_trains(tmp_path, capsys):
    path = tmp_path / "hopper data.hdf5"
    convert(MINARI / "hopper-v0/data", path, "ShortHopper-v0")  # the inner folder, too
    output = capsys.readouterr().out
    assert "190 transitions in 8 episodes of ShortHopper-v0" in output
    assert "Minari's scores 0 and 100 are returns of 1.0 and 100.0" in output
    run_printed_command(output, tmp_path / "run")


def made(**options):
    return gym.make("Pendulum-v1", **options)


GOAL = Dict(observation=Box(-1, 1, (3,)), desired_goal=Box(-1, 1, (2,)))
GOALS = {
    "observation": np.zeros((4, 3), np.float32),
    "desired_goal": np.zeros((4, 2), np.float32),
}
MADE = {  # options of the dataset, --env, and the sentence or None where it goes well
    "plain": ({}, None, None),
    "same by name": ({}, "Pendulum-v1", None),
    "arguments": ({"env": made(g=2.0)}, None, "arguments {'g': 2.0}, not {}"),
    "arguments, plain": ({"env": made(g=2.0)}, "Pendulum-v1", "arguments {'g': 2.0}"),
    "arguments, given": ({"env": made(g=2.0)}, "LightPendulum-v0", None),
    "other arguments": ({"env": made(g=3.0)}, "LightPendulum-v0", "not {'g': 2.0}"),
    "picture": ({"env": made(render_mode="rgb_array")}, None, None),
    "limit": ({"env": made(max_episode_steps=20)}, None, "time limit 20, not 200"),
    "limit, given": ({"env": made(max_episode_steps=20)}, "ShortPendulum-v0", None),
    "wrapper": (
        {"env": gym.wrappers.ClipReward(made(), -1.0, 1.0)},
        None,
        "wrappers [['ClipReward', {'min_reward': -1.0, 'max_reward': 1.0}]], not []",
    ),
    "wrapper, given": (
        {"env": gym.wrappers.ClipReward(made(), -1.0, 1.0)},
        "OwnPendulum-v0",
        None,
    ),
    "evaluation": ({"eval_env": made(g=2.0)}, None, "arguments {'g': 2.0}, not {}"),
    "evaluation, given": ({"eval_env": made(g=2.0)}, "LightPendulum-v0", None),
    "evaluation, plain": ({"env": made(g=2.0), "eval_env": made()}, None, None),
    "no limit at all": (
        {"env": gym.make("EndlessPendulum-v0")},
        None,
        "and a time limit",
    ),
    "no limit": ({"env": made(max_episode_steps=-1)}, "Pendulum-v1", None),
    "not recorded": ({"env": None}, None, "records no environment: name it with --env"),
    "not recorded, given": ({"env": None}, "Pendulum-v1", None),
    "no such environment": ({}, "Nonsense-v0", "Nonsense-v0 can't be made (NameNot"),
    "other states": ({}, "MountainCarContinuous-v0", "states (3,), not (2,)"),
    "other actions": ({}, "CartPole-v1", "actions [[-2.0], [2.0]], not Discrete(2)"),
    "other bounds": (
        {"action_space": Box(-1, 1, (1,)), "actions": np.zeros((3, 1), np.float32)},
        None,
        "actions [[-1.0], [1.0]], not [[-2.0], [2.0]]",
    ),
    "discrete": (
        {"action_space": Discrete(2), "actions": np.array([0, 1, 0])},
        None,
        "actions in Discrete(2), and the policy's are continuous",
    ),
    "dict": (
        {"observation_space": GOAL, "observations": GOALS},
        None,
        "not in a Box of one axis: make a dataset of them flattened",
    ),
    "short": (
        {"observations": np.zeros((3, 3), np.float32)},
        None,
        "episode 0 has 3 actions and 3 observations, not 4",
    ),
}


@pytest.mark.parametrize("options, env, sentence", MADE.values(), ids=MADE)
def test_the_environment_must_be_the_recorded_one(
    tmp_path, make, capsys, options, env, sentence
):
    arrays = {k: options[k] for k in ("observations", "actions") if k in options}
    options = {k: x for k, x in options.items() if k not in arrays}
    name, out = make(buffer(0, 3, **arrays), **options), tmp_path / "data.hdf5"
    args = from_minari.Args(name, out, env)
    if sentence is None:
        from_minari.main(args)
        command = f"{sys.orig_argv[0]} wpc.py --env {env or 'Pendulum-v1'}"
        command += f" --dataset {out}"
        assert capsys.readouterr().out.endswith(f"to train: {command}\n")
    else:
        assert sentence in refusal_of(from_minari.main, args)
        assert not out.exists()


def test_an_empty_dataset(tmp_path, make):
    name = make(buffer(0, 3))
    file = tmp_path / "minari/test/made-v0/data/metadata.json"
    text = file.read_text().replace('"total_steps": 3', '"total_steps": 0')
    file.write_text(text)
    args = from_minari.Args(name, tmp_path / "data.hdf5")
    assert refusal_of(from_minari.main, args) == "test/made-v0 is empty"


@pytest.mark.parametrize("name", ["observations", "rewards"])
def test_minaris_numbers_must_be_finite(tmp_path, make, name):
    broken = {"observations": np.zeros((4, 3), np.float32), "rewards": [0.0] * 3}
    broken[name][-1] = broken[name][-1] * np.nan
    name_of_set, out = make(buffer(0, 3, **broken)), tmp_path / "data.hdf5"
    args = from_minari.Args(name_of_set, out, "Pendulum-v1")
    sentence = refusal_of(from_minari.main, args)
    assert (
        sentence == f"test/made-v0 has {name} that are not finite, which can't be used"
    )
    assert not out.exists()


def test_a_dataset_is_downloaded(monkeypatch):
    monkeypatch.setattr(minari, "load_dataset", lambda name, download: (name, download))
    name = "mujoco/hopper/medium-v0"
    assert from_minari.open_dataset(name) == (name, True)


@pytest.mark.parametrize("name", [str(ROOT / "tests"), "nonsense"])
def test_what_is_no_dataset_of_minaris(tmp_path, name):
    args = from_minari.Args(name, tmp_path / "data.hdf5")
    sentence = refusal_of(from_minari.main, args)
    assert "can't be opened or downloaded by Minari" in sentence


# from_minari.py: the MuJoCo of the data, other packages, actions beyond the bounds


def in_the_gymnasium(steps, era=None, **options):
    """An episode of random actions in Hopper-v5, or in that of an era."""
    env = gym.make(f"eras:Hopper-before-{era}-v5" if era else "Hopper-v5")
    env.action_space.seed(0)
    states, rows = [env.reset(seed=0)[0]], []
    for _ in range(steps):
        action = env.action_space.sample()
        state, reward, *_ = env.step(action)
        states.append(state)
        rows.append((action, reward))
    actions, rewards = zip(*rows, strict=True)
    arrays = {"observations": np.array(states), "actions": np.array(actions)}
    return buffer(0, steps, rewards=list(rewards), **arrays, **options)


def shapes(state_dim, action_dim):
    return {
        "observations": np.zeros((4, state_dim)),
        "actions": np.zeros((3, action_dim)),
    }


@pytest.fixture
def make_robot(make):
    """Makes a Minari dataset of one episode of a robot, and returns its name."""

    def make_robot(episode, requirements=None, env="Hopper-v5"):
        spaces = gym.make(env)
        return make(
            episode,
            env=spaces.spec.id,
            requirements=requirements,
            observation_space=spaces.observation_space,
            action_space=spaces.action_space,
        )

    return make_robot


def output_of(capsys, name, out, **options):
    """What from_minari.py prints: lines on the MuJoCo of the data, and --env."""
    from_minari.main(from_minari.Args(name, out, **options))
    _, *lines, command = capsys.readouterr().out.splitlines()
    (env,) = re.findall(r"--env (\S+)", command)
    assert env.startswith("eras:") == ("PYTHONPATH=tests/tools " in command)
    return lines, env


OLD = "eras:Hopper-before-3.5-v5"
ASKS = "test/made-v0 requires mujoco{}, and Hopper-v5 moves otherwise on the"
REQUIREMENTS = {  # of the set, beginnings of the printed lines, and --env
    "before": (["mujoco==3.2.3"], [ASKS.format("==3.2.3")], OLD),
    "patch": (["mujoco==3.4.*"], [ASKS.format("==3.4.*")], OLD),
    "compatible": (["mujoco~=3.2.0"], [ASKS.format("~=3.2.0")], OLD),
    "range": (["mujoco>=3.1,<3.2"], [ASKS.format("<3.2,>=3.1")], OLD),
    "range in an era": (["mujoco>=3.5.1,<3.8"], [], "Hopper-v5"),
    "below": (["mujoco>2.9,<=3.4"], [ASKS.format("<=3.4,>2.9")], OLD),
    "twice": (["mujoco>=3.1", "mujoco<3.2"], [ASKS.format("<3.2,>=3.1")], OLD),
    "text": ("mujoco==3.2.3", [ASKS.format("==3.2.3")], OLD),
    "met": (["gymnasium>=1.0.0", f"mujoco=={mujoco.__version__}"], [], "Hopper-v5"),
    "newer": (["mujoco==3.17.0"], [], "Hopper-v5"),
    "too old": (
        ["mujoco==2.1.0"],
        ["Hopper-v5 moves otherwise on the installed mujoco"],
        "Hopper-v5",
    ),
    "other package": (
        ["gymnasium==0.29.1", "mujoco==3.4.0"],
        [
            "test/made-v0 requires gymnasium==0.29.1, and 1.",
            ASKS.format("==3.4.0"),
        ],
        OLD,
    ),
    "malformed": (
        ["numpy is needed", "mujoco==3.4.0"],
        ["test/made-v0 requires numpy is needed, which pip", ASKS.format("==3.4.0")],
        OLD,
    ),
    "not installed": (
        ["gymnasium-nonsense>=1.2", "mujoco==3.4.0"],
        [
            "test/made-v0 requires gymnasium-nonsense>=1.2: pip install "
            '"gymnasium-nonsense>=1.2"',
            ASKS.format("==3.4.0"),
        ],
        OLD,
    ),
}


@pytest.mark.parametrize(
    "requirements, lines, env", REQUIREMENTS.values(), ids=REQUIREMENTS
)
def test_the_environment_is_that_of_the_required_mujoco(
    tmp_path, make_robot, capsys, monkeypatch, requirements, lines, env
):
    monkeypatch.setattr(from_minari, "which_physics", None)  # not asked
    name = make_robot(in_the_gymnasium(3), requirements)
    printed, chosen = output_of(capsys, name, tmp_path / "data.hdf5")
    assert chosen == env
    assert len(printed) == len(lines)
    for line, expected in zip(printed, lines, strict=True):
        assert line.startswith(expected)


@pytest.mark.parametrize("requirements", [["mujoco==3.2.3"], ["mujoco>=2.3"], None])
def test_a_robot_that_did_not_move_gets_no_warning(
    tmp_path, make_robot, capsys, requirements
):
    name = make_robot(buffer(0, 3, **shapes(17, 6)), requirements, "Walker2d-v5")
    assert output_of(capsys, name, tmp_path / "data.hdf5") == ([], "Walker2d-v5")


OPEN = [None, [], ["mujoco"], ["mujoco>=3.1.0"], ["mujoco<3.6,>=3.2"], ["mujoco=3.2"]]


@pytest.mark.parametrize("requirements", OPEN)
@pytest.mark.parametrize("era", ["3.5", None])
def test_where_requirements_leave_it_open_the_rows_decide(
    tmp_path, make_robot, capsys, requirements, era
):
    name = make_robot(in_the_gymnasium(60, era), requirements)
    printed, env = output_of(capsys, name, tmp_path / "data.hdf5")
    if requirements == ["mujoco=3.2"]:
        assert "requires mujoco=3.2, which pip would not und" in printed.pop(0)
    if era:
        (sentence,) = printed
        assert env == OLD and sentence.endswith(f"--env {OLD}")
    else:
        assert (printed, env) == ([], "Hopper-v5")


def test_what_is_not_known_is_said(tmp_path, make_robot, capsys):
    name = make_robot(buffer(0, 3, **shapes(11, 3)))
    (sentence,), env = output_of(capsys, name, tmp_path / "data.hdf5")
    assert sentence.startswith("The file is") and "0% of the next states" in sentence
    assert env == "Hopper-v5"


def test_an_environment_that_eras_does_not_know(tmp_path, make, capsys):
    name = make(buffer(0, 3), requirements=["mujoco>=3.1,<3.2"])
    (sentence,), env = output_of(capsys, name, tmp_path / "data.hdf5")
    assert "know whether Pendulum-v1 moves" in sentence
    assert sentence.endswith("mujoco==3.1.0") and env == "Pendulum-v1"


def test_states_that_can_not_be_set(tmp_path, make_robot, capsys):
    name = make_robot(buffer(0, 3, **shapes(23, 7)), None, "Pusher-v5")
    (sentence,), env = output_of(capsys, name, tmp_path / "data.hdf5")
    assert sentence.startswith("nothing is known of the MuJoCo of test/made-v0: Pusher")
    assert env == "Pusher-v5"


def test_positions_and_velocities_are_kept_where_each_row_has_them(tmp_path, make):
    infos = {"qpos": np.arange(8.0).reshape(4, 2), "qvel": np.zeros((4, 2))}
    short = infos | {"qvel": np.zeros((3, 2))}
    name = make(buffer(0, 3, infos=short), buffer(1, 3, True, infos=infos))
    data = tmp_path / "data.hdf5"
    from_minari.main(from_minari.Args(name, data))
    with h5py.File(data) as file:
        assert list(file["infos"]) == ["qpos"]  # of qvel a row is missing
        assert file["infos/qpos"][:, 0].tolist() == [0, 2, 4, 0, 2, 4, 6]
        assert len(file["rewards"]) == 7


def test_an_era_chosen_with_env(tmp_path, make_robot, capsys):
    name = make_robot(in_the_gymnasium(3), ["mujoco==3.2.3"])
    out = tmp_path / "data.hdf5"
    assert output_of(capsys, name, out, env=OLD) == ([], OLD)


def test_the_command_of_an_era_trains(tmp_path, make_robot, capsys):
    name = make_robot(in_the_gymnasium(60), ["mujoco==3.2.3"])
    from_minari.main(from_minari.Args(name, tmp_path / "my data.hdf5"))
    command = capsys.readouterr().out.splitlines()[-1].removeprefix("to train: ")
    command = f"{command} {shlex.join(map(str, SHORT))} --run-dir {tmp_path / 'run'}"
    process = run("bash", "-c", command, cwd=ROOT)
    assert process.returncode == 0, process.stderr
    assert (tmp_path / "run/checkpoint.pt").exists()


MODULE = """
import gymnasium as gym
from gymnasium.envs.classic_control.pendulum import PendulumEnv

class Env(PendulumEnv):
    pass

gym.register("Own-v0", "own_module:Env", max_episode_steps=50)
"""


def test_an_environment_of_another_package_needs_no_env(
    tmp_path, make, capsys, monkeypatch
):
    (tmp_path / "own_module.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    gym.make("own_module:Own-v0")
    name = make(buffer(0, 3), env="Own-v0")
    monkeypatch.delitem(gym.registry, "Own-v0")  # as where it was not imported
    monkeypatch.delitem(sys.modules, "own_module")
    printed, env = output_of(capsys, name, tmp_path / "data.hdf5")
    assert (printed, env) == ([], "own_module:Own-v0")

    monkeypatch.delitem(gym.registry, "Own-v0")
    monkeypatch.delitem(sys.modules, "own_module")
    (tmp_path / "own_module.py").unlink()
    args = from_minari.Args(name, tmp_path / "data.hdf5")
    sentence = refusal_of(from_minari.main, args)
    assert "own_module:Own-v0 can't be made (ModuleNotFoundError: No mod" in sentence
    assert "install what it needs" in sentence


@pytest.mark.skipif(
    not importlib.util.find_spec("gymnasium_robotics"),
    reason="gymnasium-robotics, which requirements.txt leaves out, is not installed",
)
def test_the_hand_of_gymnasium_robotics(tmp_path, make_robot, capsys):
    episode, env = buffer(0, 3, **shapes(45, 24)), "AdroitHandPen-v1"
    name = make_robot(episode, ["mujoco==3.2.3"], f"gymnasium_robotics:{env}")
    printed, env = output_of(capsys, name, tmp_path / "data.hdf5")
    assert env == "eras:AdroitHandPen-before-3.3-v1"
    assert len(printed) == 1 and "requires mujoco==3.2.3, and gymnasium_" in printed[0]


gym.register("WidePendulum-v0", "test_tools:WidePendulum", max_episode_steps=200)


class WidePendulum(gym.ActionWrapper):
    """Clips actions of up to 4 to Pendulum's."""

    def __init__(self):
        super().__init__(gym.make("Pendulum-v1"))
        self.action_space = Box(-4, 4, (1,))

    def action(self, action):
        return action.clip(-2, 2)


BEYOND = np.float32([[-3.5], [2.0], [2.5]])


def test_actions_beyond_the_bounds(tmp_path, make, capsys):
    out = tmp_path / "data.hdf5"
    args = from_minari.Args(make(buffer(0, 3, actions=BEYOND)), out)
    assert refusal_of(from_minari.main, args) == (
        "2 actions are beyond the bounds of Pendulum-v1, -2 and 2, and the largest is "
        "3.5: add --clip, or name with --env an environment that clips"
    )
    assert not out.exists()

    from_minari.main(from_minari.Args(args.dataset, out, clip=True))
    assert "the largest is 3.5: clipped" in capsys.readouterr().out
    assert read(out)["actions"].ravel().tolist() == [-2, 2, 2, 0]
    wpc.read_dataset(out, 3, 1, 2.0)

    # An environment that clips may take more than the recorded one.
    from_minari.main(from_minari.Args(args.dataset, out, "WidePendulum-v0"))
    printed = capsys.readouterr().out
    assert "WidePendulum-v0 is taken to clip actions to [[-2.0], [2.0]]" in printed
    assert read(out)["actions"].ravel().tolist() == [-3.5, 2, 2.5, 0]
    wpc.read_dataset(out, 3, 1, 4.0)


@pytest.mark.parametrize("largest", [2.0, 2.002])
def test_actions_that_the_scripts_take_are_not_clipped(tmp_path, make, capsys, largest):
    actions = np.float32([[-largest], [0], [largest]])
    name = make(buffer(0, 3, actions=actions))
    for clip in (False, True):
        args = from_minari.Args(name, tmp_path / "data.hdf5", clip=clip)
        from_minari.main(args)
        assert len(capsys.readouterr().out.splitlines()) == 2
        assert np.array_equal(read(args.out)["actions"][:3], actions)


# play.py


def save_run(folder, env, state_dim, action_dim, max_action=1.0):
    """A run folder with what play.py reads, and its policy."""
    torch.manual_seed(0)
    actor = wpc.Actor(state_dim, action_dim, max_action)
    mean, std = torch.randn(state_dim), 1 + torch.rand(state_dim)
    checkpoint = {
        "args": asdict(wpc.Args(env=env, dataset="data.hdf5")),
        "agent": {"actor": actor.state_dict()},
        "mean": mean,
        "std": std,
        "max_action": max_action,
        "evaluations": [{"step": 0}, {"step": 5_000}],
    }
    torch.save(checkpoint, folder / "checkpoint.pt")
    return actor, mean, std


def test_films_are_in_d4rls_physics():
    """As far as it can be seen without a picture."""
    filmed = play.make_env("hopper").unwrapped.model
    evaluated = wpc.make_envs("hopper", 1).envs[0].unwrapped.model
    for name in ("body_mass", "body_inertia", "geom_margin"):
        assert np.array_equal(getattr(filmed, name), getattr(evaluated, name))


@pytest.fixture
def hopper_run(tmp_path, monkeypatch):
    """A run folder, its policy, mean and std, where Hopper can be filmed."""
    monkeypatch.setenv("MUJOCO_GL", "egl")
    try:
        env = gym.make("Hopper-v5", render_mode="rgb_array")
        env.reset()
        env.render()
    except Exception as error:
        pytest.skip(f"EGL does not work here ({error})")
    env.close()
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.delenv("DISPLAY", raising=False)
    return tmp_path, *save_run(tmp_path, "hopper", 11, 3)


def test_the_film_is_of_the_run(hopper_run, capsys):
    folder, actor, mean, std = hopper_run
    play.main(play.Args([folder], folder / "policy.gif", seed=5, size=60))
    env = wpc.make_envs("hopper", 1).envs[0]
    state, _ = env.reset(seed=5)
    episode_return, steps, over = 0.0, 0, False
    while not over:
        with torch.no_grad():
            action = actor((torch.tensor(state).float() - mean) / std).numpy()
        state, reward, terminated, truncated, _ = env.step(action)
        episode_return += reward
        steps, over = steps + 1, terminated or truncated
    score = 100 * (episode_return + 20.272305) / (3234.3 + 20.272305)
    expected = f"{steps} steps, return {episode_return:.0f}; D4RL's score {score:.1f}"
    assert expected in capsys.readouterr().out
    with Image.open(folder / "policy.gif") as film:
        assert film.size == (60, 60) and film.n_frames == 1 - (-steps // 5)  # 125 fps
        assert film.info["duration"] == 40 and "loop" in film.info


def test_what_stands_in_the_picture(hopper_run, monkeypatch):
    """Also where --frames ends the film before the episode does."""
    folder, texts = hopper_run[0], []

    def picture(env, size, text, dimmed=False):
        start = f"{folder.name}\n5,000 training steps, seed 0\n"
        texts.append((text.removeprefix(start), dimmed))

    monkeypatch.setattr(play, "picture", picture)
    args = play.Args([folder], folder / "policy.gif", seed=5)
    images, fps = play.film(folder, args)
    assert fps == 25 and len(images) == len(texts)
    assert texts[0] == ("step 0, return 0", False)
    assert re.fullmatch(r"ended: \d+ steps, return \d+", texts[-1][0])
    assert [dimmed for _, dimmed in texts] == [False] * (len(texts) - 1) + [True]
    texts.clear()
    args.frames = 2
    assert len(play.film(folder, args)[0]) == 2
    assert texts[-1][0].startswith("step 5, ")


def test_shorter_films_wait_for_the_longest(tmp_path):
    """Side by side in the given order; the last frame stays for three seconds."""
    grey = [Image.new("RGB", (8, 8), (x, x, x)) for x in (0, 50, 100, 150, 200)]
    play.write(tmp_path / "x.gif", [grey[:2], grey[2:]], fps=20)
    with Image.open(tmp_path / "x.gif") as film:
        shown = []
        for i in range(film.n_frames):
            film.seek(i)
            picture = film.convert("L")
            shown.append((picture.getpixel((1, 1)), picture.getpixel((15, 7))))
            assert film.info["duration"] == (3000 if i == 2 else 50)
    assert film.size == (16, 8) and shown == [(0, 100), (50, 150), (50, 200)]


def test_a_picture_has_its_text_and_is_dimmed():
    env = SimpleNamespace(render=lambda: np.full((9, 9, 3), 100, np.uint8))
    bright, dim = play.picture(env, 180, "text"), play.picture(env, 180, "text", True)
    for image, level in ((bright, 100), (dim, 50)):
        pixels = np.asarray(image)
        assert pixels.shape == (180, 180, 3) and (pixels[90:] == level).all()
        assert pixels[:30].max() > 230


def test_runs_of_environments_of_another_speed(tmp_path, monkeypatch):
    fps = iter((10, 20))
    monkeypatch.setattr(play, "film", lambda *_: ([], next(fps)))
    args = play.Args([tmp_path, tmp_path], tmp_path / "x.gif")
    assert "the same render_fps" in refusal_of(play.main, args)


def test_the_camera_follows_the_robot(hopper_run):
    args = play.Args([hopper_run[0]], Path("policy.gif"), seed=5)
    env, observation = play.start(args, "hopper")
    assert np.array_equal(observation, gym.make("Hopper-v5").reset(seed=5)[0])
    env.unwrapped.data.qpos[0] += 20
    env.step(np.zeros(3))
    red, _, blue = np.moveaxis(env.render().astype(int), -1, 0)
    env.close()
    assert (red > blue + 40).sum() > 500  # it is brown, and nothing else is


def test_a_missing_graphics_library(tmp_path):
    save_run(tmp_path, "hopper", 11, 3)
    line = [ROOT / "tests/tools/play.py", tmp_path, "--out", tmp_path / "policy.gif"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUJOCO_GL", "osmesa")
        patch.setenv("PYOPENGL_PLATFORM", "egl")  # which contradicts that
        process = run(sys.executable, *line)
    assert_one_sentence(process, "MuJoCo needs EGL or OSMesa (on Debian, apt install")


def test_a_full_disk_while_a_film_is_written(tmp_path, monkeypatch):
    def save(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(play, "film", lambda *_: ([Image.new("RGB", (8, 8))], 30))
    monkeypatch.setattr(Image.Image, "save", save)
    args = play.Args([tmp_path], tmp_path / "policy.gif")
    sentence = refusal_of(play.main, args)
    assert "policy.gif can't be written: [Errno 28]" in sentence


gym.register("Unfilmed-v0", PENDULUM, max_episode_steps=9, kwargs={"unknown": 1})


def test_films_that_can_not_be_made(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    save_run(tmp_path, "Unfilmed-v0", 3, 1)
    for out, sentence in (
        ("nofolder/policy.gif", "--out can't be written: [Errno 2]"),
        ("policy.gif", "Unfilmed-v0 can't be filmed ("),
    ):
        refusal = refusal_of(play.main, play.Args([tmp_path], tmp_path / out))
        assert sentence in refusal and "MuJoCo" not in refusal
        assert [x.name for x in tmp_path.iterdir()] == ["checkpoint.pt"]
    for wrong, sentence in (
        ({"out": Path("policy.mp4")}, "policy.mp4 must end in .gif"),
        ({"run_dirs": []}, "name a run"),
        ({"fps": 0}, "must be >= 1"),
    ):
        with pytest.raises(ValueError, match=sentence):
            play.Args(**{"run_dirs": [tmp_path], "out": Path("x.gif")} | wrong)


def test_films_of_what_is_no_run(tmp_path):
    args, sentences = play.Args([tmp_path], tmp_path / "policy.gif"), []
    sentences.append(refusal_of(play.main, args))
    (tmp_path / "checkpoint.pt").write_bytes(b"nonsense")
    sentences.append(refusal_of(play.main, args))
    torch.save({"step": 1}, tmp_path / "checkpoint.pt")
    sentences.append(refusal_of(play.main, args))
    reasons = [re.search(r"can't be read \((\w+): ", x).group(1) for x in sentences]
    assert reasons == ["FileNotFoundError", "UnpicklingError", "KeyError"]


# check_steps.py

PEER = """
import copy
import sys

import torch

sys.path.insert(0, {root!r})
import {script} as script


class TD3_BC:
    def __init__(self, *dims):
        self.agent = script.Agent(*dims, script.Args(device="cpu", **{options}))
        vars(self).update(vars(self.agent))
        if hasattr(self, "value"):
            self.vnet = self.value
        self.steps = 0

    def train(self, replay_buffer, batch_size=256):
        self.steps += 1
        names = "observations", "actions", "next_observations", "rewards", "terminals"
        batch = dict(zip(names, replay_buffer.sample(batch_size)))
        batch["terminals"] = 1 - batch["terminals"]
        for name in ("actor_target", "critic_target"):
            setattr(self.agent, name, getattr(self, name))
        if {v_before}:
            value, old = self.value, copy.deepcopy(self.value)
            self.agent.value = lambda s: (value if torch.is_grad_enabled() else old)(s)
        self.agent.update(batch, self.steps)
        if {moved!r}:
            next(getattr(self, {moved!r}).parameters()).data += 1e-3
"""


@pytest.fixture
def float64():
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("name", ["td3_bc", "wpc"])
def test_steps_are_compared_with_another_file_s(tmp_path, capsys, float64, name):
    """With a file that does the same, with one that takes V from before its update, and
    with some that do something else."""

    def differences(options, v_before=False, moved=""):
        text = PEER.format(
            root=str(ROOT), script=name, options=options, v_before=v_before, moved=moved
        )
        (tmp_path / "peer.py").write_text(text)
        check_steps.main(check_steps.Args([tmp_path / "peer.py"], steps=4))
        lines = capsys.readouterr().out.splitlines()
        assert lines[0].startswith(f"{name}.py and {tmp_path}/peer.py: ")
        return [float(line.split(": ")[1]) for line in lines]

    same, *v_before = differences({})
    assert same == 0
    assert len(v_before) == (name == "wpc")
    assert min(v_before + differences({"discount": 0.98})) > 1e-6
    networks = ["actor", "critic", "actor_target", "critic_target"]
    if name == "wpc":
        v_after, v_before = differences({}, v_before=True)
        assert v_after > 1e-6 and v_before == 0
        networks.append("value")
    for network in networks:
        assert min(differences({}, moved=network)) > 5e-4
    assert torch.get_default_dtype() == torch.float64


def test_what_is_no_file_of_td3_bc(tmp_path, float64):
    for path, sentence in (
        (tmp_path / "no.py", "is no file"),
        (ROOT / "wpc.py", "TD3_BC"),
    ):
        assert sentence in refusal_of(check_steps.main, check_steps.Args([path]))


TEST_SET = ROOT / "tests/data/minari/test/pendulum-v0"


@pytest.mark.parametrize(
    "tool", ["check_physics", "from_minari", "make_dataset", "join"]
)
def test_what_the_scripts_refuse_is_a_tools_sentence_too(monkeypatch, tmp_path, tool):
    def refuse(*_, **__):
        raise wpc.UserError("a sentence")

    monkeypatch.setattr(wpc, "make_envs", refuse)
    monkeypatch.setattr(wpc, "read_dataset", refuse)
    line = {
        "check_physics": [DATASET, "--env", "halfcheetah"],
        "from_minari": [TEST_SET, "--env", "ShortPendulum-v0", "--out", tmp_path / "x"],
        "make_dataset": ["--env", "hopper", "--steps", 9, "--out", tmp_path / "x"],
        "join": [DATASET, "--out", tmp_path / "x"],
    }[tool]
    monkeypatch.setattr(sys, "argv", [tool, *map(str, line)])
    with pytest.raises(SystemExit, match="a sentence"):
        runpy.run_path(str(ROOT / f"tests/tools/{tool}.py"), run_name="__main__")
