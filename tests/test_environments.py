# SPDX-License-Identifier: MIT
"""Any Gymnasium environment beside D4RL's robots, and Minari's datasets.

tests/data/minari holds datasets that Minari's own DataCollector made (see
tests/tools/make_minari_data.py): some episodes of Hopper-v5 end and some are cut off,
all of Pendulum-v1's are cut off, and CartPole-v1's actions are discrete.
"""

import json
import sys

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
import torch
from conftest import (
    DATASET,
    ROOT,
    assert_one_sentence,
    command,
    d4rl_arrays,
    load,
    read_curves,
    read_rows,
    refusal,
    run,
    run_here,
    wpc,
    write_hdf5,
)

MINARI = ROOT / "tests/data/minari/test"
SHORT = ["--max-timesteps", 4, "--eval-freq", 2, "--eval-episodes", 2, "--log-freq", 1]
SHORT += ["--batch-size", 32, "--device", "cpu"]


def convert(dataset, out):
    """The process of from_minari.py."""
    program = ROOT / "tests/tools/from_minari.py"
    return run(sys.executable, program, dataset, "--out", out)


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    """Pendulum-v1's Minari dataset as an HDF5 file."""
    path = tmp_path_factory.mktemp("minari") / "pendulum.hdf5"
    process = convert(MINARI / "pendulum-v0", path)
    assert process.returncode == 0, process.stderr
    return path


class Spaces(gym.Env):
    """An environment of these spaces."""

    def __init__(self, states, actions):
        self.observation_space, self.action_space = states, actions


LINE = gym.spaces.Box(-1, 1, (3,))
SPACES = {
    "Discrete": (LINE, gym.spaces.Discrete(2), "must be a Box of one axis"),
    "Dict": (gym.spaces.Dict(x=LINE), LINE, "must be a Box of one axis"),
    "Image": (gym.spaces.Box(0, 255, (8, 8, 3)), LINE, "must be a Box of one axis"),
    "Skew": (LINE, gym.spaces.Box(0, 1, (2,)), "all must go from -x to x"),
    "Uneven": (
        LINE,
        gym.spaces.Box(np.float32([-1, -2]), np.float32([1, 2])),
        "same x",
    ),
    "Unbounded": (LINE, gym.spaces.Box(-np.inf, np.inf, (2,)), "all must go from -x"),
}
for name, (states, actions, _) in SPACES.items():
    arguments = {"states": states, "actions": actions}
    gym.register(f"{name}-v0", Spaces, max_episode_steps=5, kwargs=arguments)


@pytest.mark.parametrize("name", SPACES)
def test_spaces_that_do_not_fit_are_refused(name):
    line = [*command("wpc")[:2], "--env", f"{name}-v0", "--dataset", DATASET]
    sentence = refusal(wpc, *line)
    assert sentence.startswith(f"--env {name}-v0 has ") and SPACES[name][2] in sentence


NAMES = [
    ("Nonsense-v0", "--env Nonsense-v0 can't be made: Environment `Nonsense` doesn't"),
    ("Hopper-v99", "--env Hopper-v99 can't be made: "),
    ("hopper-medium-v0", "--env hopper-medium-v0 can't be made: "),
    ("no_such_module:Pendulum-v1", "can't be made: No module named 'no_such_module'"),
]


@pytest.mark.parametrize("env, sentence", NAMES)
def test_names_that_gymnasium_does_not_know(env, sentence):
    line = [*command("wpc")[:2], "--env", env, "--dataset", DATASET]
    assert sentence in refusal(wpc, *line)


def test_names_of_robots_and_tasks():
    for robot, env_id in wpc.D4RL_ROBOTS.items():
        for env in (robot, f"{robot}-medium-replay-v2", env_id):
            assert wpc.gymnasium_id(env) == env_id
    for env in ("Hopper-v5", "Ant-v5", "hopper-medium-v0", "module:Hopper-v4"):
        assert wpc.gymnasium_id(env) == env


def test_a_run_on_another_environment(pendulum, tmp_path):
    """The file names it; its actions go from -2 to 2, and it has no score of D4RL's."""
    line = [*command("wpc")[:2], "--dataset", pendulum, *SHORT]
    run_here(wpc, *line, "--run-dir", tmp_path)
    assert json.loads((tmp_path / "args.json").read_text())["env"] == "Pendulum-v1"
    rows = read_rows(tmp_path)
    columns = ["step", "mean_return", "std_over_episodes", "returns"]
    assert list(rows[-1])[:4] == columns and "normalized_score" not in rows[-1]
    returns = np.array([float(x) for x in rows[-1]["returns"].split()])
    assert float(rows[-1]["mean_return"]) == pytest.approx(returns.mean(), abs=0.01)
    assert float(rows[-1]["std_over_episodes"]) == pytest.approx(
        returns.std(), abs=0.01
    )
    assert [step for step, _ in read_curves(tmp_path)["eval/mean_return"]] == [2, 4]

    checkpoint = load(tmp_path)
    agent = wpc.Agent(3, 1, 2.0, wpc.Args())
    agent.load_state_dict(checkpoint["networks"])
    envs = wpc.make_envs("Pendulum-v1", 2)
    mean, std = checkpoint["mean"], checkpoint["std"]
    assert wpc.evaluate(envs, agent.actor, mean, std, 0) == pytest.approx(
        returns, abs=0.01
    )


def test_an_environment_of_the_users_own(pendulum, monkeypatch, tmp_path, capsys):
    program = "import gymnasium\ngymnasium.register('Mine-v3', 'gymnasium.envs."
    program += "classic_control.pendulum:PendulumEnv', max_episode_steps=7)\n"
    (tmp_path / "my_envs.py").write_text(program)
    monkeypatch.syspath_prepend(tmp_path)
    line = [*command("wpc")[:2], "--env", "my_envs:Mine-v3", "--dataset", pendulum]
    run_here(wpc, *line, *SHORT, "--run-dir", tmp_path / "run")
    output = capsys.readouterr().out
    assert "step 4: mean return -" in output
    warning = f"warning: {pendulum} is from Pendulum-v1, --env is my_envs:Mine-v3"
    assert output.startswith(warning)
    run_here(wpc, *command("wpc")[:2], "--run-dir", tmp_path / "run")  # continues
    assert "finished at step 4" in capsys.readouterr().out


def test_versions_that_disagree(tmp_path, capsys):
    path = write_hdf5(tmp_path / "hopper.hdf5", d4rl_arrays(100, 11, 3))
    for env_id, warns in (("Hopper-v5", True), ("Hopper-v4", False)):
        with h5py.File(path, "a") as file:
            file.attrs["env_id"] = env_id
        line = [*command("wpc")[:2], "--env", "hopper", "--dataset", path, *SHORT]
        run_here(wpc, *line, "--run-dir", tmp_path / env_id)
        output = capsys.readouterr().out
        assert output.startswith("warning: ") == warns
        assert "normalized score" in output


def test_neither_the_file_nor_the_user_names_an_environment():
    line = [*command("wpc")[:2], "--dataset", DATASET]
    assert refusal(wpc, *line).endswith("names no environment: add --env")
    assert "--env is None: name a D4RL task (half" in refusal(wpc, *command("wpc")[:2])


# Minari


def minari_transitions(name):
    """Every transition as Minari has it, and the rewards of each episode."""
    dataset = minari.MinariDataset(MINARI / name / "data")
    rows, episodes = [], []
    for episode in dataset.iterate_episodes():
        episodes.append(episode.rewards)
        for t in range(len(episode.actions)):
            row = (
                episode.observations[t],
                episode.actions[t],
                episode.rewards[t],
                episode.observations[t + 1],
                episode.terminations[t],
            )
            rows.append([np.float32(x) for x in row])
    return rows, episodes


SHAPES = [("hopper-v0", 11, 3), ("pendulum-v0", 3, 1)]


@pytest.mark.parametrize("name, state_dim, action_dim", SHAPES)
def test_no_transition_of_minaris_is_lost(tmp_path, name, state_dim, action_dim):
    path = tmp_path / "data.hdf5"
    assert convert(MINARI / name, path).returncode == 0
    args = wpc.Args(batch_size=1, weight="static")
    dataset, discounted_returns = wpc.load_dataset(path, state_dim, action_dim, args)
    rows, episodes = minari_transitions(name)
    keys = ("observations", "actions", "rewards", "next_observations", "terminals")
    for i, key in enumerate(keys):
        expected = np.array([row[i] for row in rows]).reshape(len(rows), -1)
        assert np.array_equal(dataset[key].numpy(), expected), key
    powers = [0.99 ** np.arange(len(rewards)) for rewards in episodes]
    expected = [p @ np.float32(r) for p, r in zip(powers, episodes, strict=True)]
    assert discounted_returns == pytest.approx(expected, rel=1e-6)
    totals = np.array([np.float32(rewards).sum() for rewards in episodes])
    half = np.repeat(totals >= np.median(totals), [len(r) for r in episodes])
    assert dataset["better_half"][:, 0].tolist() == half.tolist()


def test_the_stored_episodes_end_in_both_ways():
    dataset = minari.MinariDataset(MINARI / "hopper-v0/data")
    ends = {bool(e.terminations[-1]) for e in dataset.iterate_episodes()}
    assert ends == {True, False}


def test_the_file_says_where_it_is_from(pendulum, tmp_path):
    path = tmp_path / "hopper.hdf5"
    process = convert(MINARI / "hopper-v0/data", path)  # the inner folder will do
    assert " episodes of Hopper-v5" in process.stdout
    with h5py.File(path) as file:
        attributes = dict(file.attrs)
    assert attributes == {
        "env_id": "Hopper-v5",
        "source": "Minari's test/hopper-v0",
        "ref_min_score": 1.0,
        "ref_max_score": 100.0,
    }
    with h5py.File(pendulum) as file:
        assert file.attrs.keys() == {"env_id", "source"}


REFUSED = [
    (MINARI / "cartpole-v0", "action_space Discrete(2): it must be a Box of one axis"),
    (ROOT / "tests", "can't be opened or downloaded by Minari"),
    ("nonsense", "can't be opened or downloaded by Minari"),
]


@pytest.mark.parametrize("dataset, sentence", REFUSED)
def test_what_from_minari_refuses(tmp_path, dataset, sentence):
    process = convert(dataset, tmp_path / "data.hdf5")
    assert_one_sentence(process, sentence)
    assert not (tmp_path / "data.hdf5").exists()


# make_dataset.py


def test_make_dataset_names_the_environment(tmp_path, capsys):
    program, path = ROOT / "tests/tools/make_dataset.py", tmp_path / "made.hdf5"
    line = [sys.executable, program, "--out", path, "--steps", 250]
    line += ["--random-steps", 240]
    process = run(*line, "--env", "Pendulum-v1")
    assert process.returncode == 0, process.stderr
    assert wpc.read_env_id(path) == "Pendulum-v1"
    dataset, returns = wpc.load_dataset(path, 3, 1, wpc.Args(batch_size=1))
    assert len(dataset["rewards"]) == 248 and len(returns) == 2  # without two timeouts
    assert 1 < dataset["actions"].abs().max() <= 2
    assert torch.isfinite(dataset["observations"]).all()
    process = run(*line, "--env", "CartPole-v1")
    assert_one_sentence(process, "both must be a Box of one axis")
