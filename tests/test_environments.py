# SPDX-License-Identifier: MIT
"""Environments of all kinds: D4RL's robots, Gymnasium's, and those of users."""

import gymnasium as gym
import numpy as np
import pytest
from conftest import (
    DATASET,
    command,
    d4rl_arrays,
    load,
    read_curves,
    read_rows,
    refusal,
    run_here,
    wpc,
    write_hdf5,
)
from gymnasium.spaces import Box, Dict, Discrete

SHORT = ["--max-timesteps", 4, "--eval-freq", 2, "--eval-episodes", 2]
SHORT += ["--batch-size", 32, "--device", "cpu"]


@pytest.fixture
def random_data(tmp_path):
    """A file of Pendulum-v1's shapes."""
    arrays = d4rl_arrays(100, 3, 1)
    arrays["actions"] *= 2
    return write_hdf5(tmp_path / "random data.hdf5", arrays)


# Names


def test_names_that_gymnasium_does_not_know():
    for env, sentence in (
        ("Nonsense-v0", "Environment `Nonsense` doesn't exist"),
        ("Hopper-v99", "Environment version `v99` for environment `Hopper` doesn't"),
    ):
        line = [*command("wpc")[:2], "--env", env, "--dataset", DATASET]
        assert sentence in refusal(wpc, *line)


def test_robots_and_tasks_move_in_d4rls_physics_and_other_names_do_not(script):
    def body_masses(env):
        (env,) = script.make_envs(env, 1).envs
        assert env.spec.max_episode_steps == 1000
        return env.unwrapped.model.body_mass.tolist()

    for robot, (env_id, *_) in script.D4RL_ROBOTS.items():
        old = body_masses(robot)
        stock = gym.make(env_id).unwrapped.model.body_mass.tolist()
        assert old == body_masses(f"{robot}-medium-replay-v2")
        assert old != stock and stock == body_masses(env_id)
    for env in ("Hopper-v5", "Ant-v5", "module:Hopper-v4", "module:hopper-v4"):
        assert script.d4rl_robot(env) is None


def test_no_warning_says_that_d4rls_robots_are_out_of_date(script, recwarn):
    for robot, (env_id, *_) in script.D4RL_ROBOTS.items():
        script.make_envs(robot, 1)
        assert not recwarn.list
        with pytest.warns(DeprecationWarning, match="out of date"):
            script.make_envs(env_id, 1)


# Spaces


class Line(gym.Env):
    """Episodes of 20 steps; the reward is the better, the smaller the action."""

    observation_space = Box(-np.inf, np.inf, (3,), np.float32)
    action_space = Box(-2, 2, (1,), np.float32)

    def __init__(self, states=None, actions=None):
        self.observation_space = states or self.observation_space
        self.action_space = actions or self.action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observation(), {}

    def observation(self):
        return self.np_random.standard_normal(3).astype(np.float32)

    def step(self, action):
        self.t += 1
        return self.observation(), -abs(float(action[0])), self.t == 20, False, {}


STATES = Box(-1, 1, (3,))
SPACES = {  # states, actions, and which of them does not fit, as the sentence shows it
    "Discrete": (STATES, Discrete(2), r"Discrete\(2\)"),
    "Goals": (Dict(x=STATES), STATES, r"Dict\('x'"),
    "Image": (Box(0, 255, (8, 8, 3)), STATES, r"Box\(0.0, 255.0, \(8, 8, 3\)"),
    "Grid": (STATES, Box(-1, 1, (2, 2)), r"Box\(-1.0, 1.0, \(2, 2\)"),
    "Skew": (STATES, Box(0, 1, (2,)), r"Box\(0.0, 1.0, \(2,\)"),
    "Uneven": (
        STATES,
        Box(np.float32([-1, -2]), np.float32([1, 2])),
        r"Box\(\[-1. -2.\], \[1. 2.\]",
    ),
    "Unbounded": (STATES, Box(-np.inf, np.inf, (2,)), r"Box\(-inf, inf"),
    "HalfBounded": (STATES, Box(-np.inf, 1, (2,)), r"Box\(-inf, 1.0"),
}
for name, (states, actions, _) in SPACES.items():
    arguments = {"states": states, "actions": actions}
    gym.register(f"{name}-v0", Line, max_episode_steps=30, kwargs=arguments)
gym.register("Endless-v0", Line)
gym.register("Line-v0", Line, max_episode_steps=30)


@pytest.mark.parametrize("name", SPACES)
def test_spaces_that_do_not_fit_are_refused(name):
    with pytest.raises(wpc.UserError, match=SPACES[name][2]) as stop:
        wpc.make_envs(f"{name}-v0", 2)
    sentence = str(stop.value)
    assert sentence.startswith(f"--env {name}-v0 ") and "\n" not in sentence
    assert "one-dimensional Boxes of states" in sentence


def test_an_environment_without_a_time_limit_is_refused():
    """Its episodes may never end, and then an evaluation wouldn't, either."""
    with pytest.raises(wpc.UserError, match=r"--env Endless-v0 .* a time limit"):
        wpc.make_envs("Endless-v0", 2)


# Environments that break


class RewardArray(Line):
    def step(self, action):
        state, reward, *ends = super().step(action)
        return state, np.array([reward, reward]), *ends


class OldReset(Line):
    def reset(self):  # without seed and options, as in Gym before 0.26
        return super().reset()


class NeedsOptions(Line):
    def reset(self, *, seed=None, options=None):
        self.goal = options["goal"]
        return super().reset(seed=seed)


class OnlyOne(Line):
    made = False

    def __init__(self):
        if OnlyOne.made:
            raise RuntimeError("the simulator is already in use")
        OnlyOne.made = True


class Crashes(Line):
    def step(self, action):
        if self.t == 5:
            raise ValueError("simulator unstable")
        return super().step(action)


BROKEN = {
    RewardArray: (ValueError, "setting an array element with a sequence"),
    OldReset: (TypeError, "unexpected keyword argument 'seed'"),
    NeedsOptions: (TypeError, "'NoneType' object is not subscriptable"),
    OnlyOne: (RuntimeError, "the simulator is already in use"),
    Crashes: (ValueError, "simulator unstable"),
}
for entry_point in BROKEN:
    gym.register(f"{entry_point.__name__}-v0", entry_point, max_episode_steps=30)


@pytest.mark.parametrize("broken", BROKEN)
def test_environments_that_break_do_so_before_the_first_step(
    monkeypatch, random_data, tmp_path, broken
):
    """With their own error and traceback."""
    monkeypatch.setattr(wpc.Agent, "update", None)
    error, sentence = BROKEN[broken]
    line = [*command("wpc")[:2], "--env", f"{broken.__name__}-v0", *SHORT]
    line += ["--dataset", random_data, "--run-dir", tmp_path / "run"]
    with pytest.raises(error, match=sentence):
        run_here(wpc, *line)
    assert not (tmp_path / "run/checkpoint.pt").exists()


class NotANumber(Line):
    def observation(self):
        return np.full(3, np.nan, np.float32)


gym.register("NotANumber-v0", NotANumber, max_episode_steps=30)


def test_states_that_are_not_finite_stop_the_run(random_data, tmp_path):
    line = [*command("wpc")[:2], "--env", "NotANumber-v0", *SHORT]
    line += ["--dataset", random_data, "--run-dir", tmp_path / "run"]
    assert "diverged by step 0, " in refusal(wpc, *line)
    assert not (tmp_path / "run/checkpoint.pt").exists()


# Runs


def test_a_run_on_another_environment(random_data, tmp_path):
    """Its actions go from -2 to 2, and it has no score of D4RL's."""
    line = [*command("wpc")[:2], "--env", "Line-v0", "--dataset", random_data, *SHORT]
    run_here(wpc, *line, "--run-dir", tmp_path / "run")
    rows = read_rows(tmp_path / "run")
    assert [row["step"] for row in rows] == ["0", "2", "4"]
    columns = ["step", "mean_return", "std_return", "q"]
    assert list(rows[0])[:4] == columns and "normalized_score" not in rows[0]
    curve = read_curves(tmp_path / "run")["mean_return"]
    assert [step for step, _ in curve] == [0, 2, 4]

    checkpoint = load(tmp_path / "run")
    actor = wpc.Actor(3, 1, checkpoint["max_action"])
    assert checkpoint["max_action"] == 2
    actor.load_state_dict(checkpoint["agent"]["actor"])
    envs, args = wpc.make_envs("Line-v0", 2), wpc.Args(env="Line-v0", dataset="none")
    again = wpc.evaluate(envs, actor, checkpoint["mean"], checkpoint["std"], args)
    assert again["mean_return"] == pytest.approx(float(rows[-1]["mean_return"]))
    assert again["std_return"] == pytest.approx(float(rows[-1]["std_return"]))


def test_an_environment_of_the_users_own(monkeypatch, random_data, tmp_path, capsys):
    program = "import gymnasium\ngymnasium.register('Mine-v3', 'gymnasium.envs."
    program += "classic_control.pendulum:PendulumEnv', max_episode_steps=7)\n"
    (tmp_path / "my_envs.py").write_text(program)
    monkeypatch.syspath_prepend(tmp_path)
    line = [*command("wpc")[:2], "--env", "my_envs:Mine-v3", "--dataset", random_data]
    run_here(wpc, *line, *SHORT, "--run-dir", tmp_path / "run")
    assert "step 4: mean_return -" in capsys.readouterr().out
