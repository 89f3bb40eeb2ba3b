# SPDX-License-Identifier: MIT
"""Evaluation on an environment whose returns are known, and on the real ones."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import wpc

MEAN, STD = torch.zeros(3), torch.ones(3)


class Countdown(gym.Env):
    """Episodes of 3 to 9 steps: the first pays 1 + action a step, later ones 1000."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,))
    action_space = gym.spaces.Box(-1, 1, (1,))
    episodes = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episodes = 1 if seed is not None else self.episodes + 1
        self.left = self.length = int(self.np_random.integers(3, 10))
        self.truncates = bool(self.np_random.integers(2))
        return np.array([self.length, 0, 0], np.float64), {}

    def step(self, action):
        self.left -= 1
        over = self.left == 0
        reward = 1 + float(action[0]) if self.episodes == 1 else 1000.0
        return (
            np.array([self.left, 0, 0], np.float64),
            reward,
            over and not self.truncates,
            over and self.truncates,
            {},
        )


def constant_actor(action):
    actor = wpc.Actor(3, 1, max_action=1.0)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.zero_()
        actor[4].bias += np.arctanh(action)
    return actor


def options(env="Countdown-v0", seed=0):
    return wpc.Args(env=env, dataset="none", seed=seed)


def first_lengths(envs, seed):
    envs.reset(seed=1000 * (seed + 100))
    return [env.unwrapped.length for env in envs.envs]


def test_only_each_first_episode_counts(script):
    envs = gym.vector.SyncVectorEnv([Countdown] * 16)
    row = script.evaluate(envs, constant_actor(0.5), MEAN, STD, options())
    lengths = np.array(first_lengths(envs, 0))
    # some go on to a second episode while others are in their first, and first episodes
    # end in both ways
    assert lengths.min() < lengths.max()
    assert {env.unwrapped.truncates for env in envs.envs} == {True, False}
    assert row == {
        "mean_return": pytest.approx(1.5 * lengths.mean()),
        "std_return": pytest.approx(1.5 * lengths.std()),
    }


def test_the_actor_sees_normalized_observations():
    seen = []

    def actor(s):
        seen.append(s)
        return torch.zeros(len(s), 1)

    envs = gym.vector.SyncVectorEnv([Countdown] * 2)
    mean, std = torch.tensor([1.0, 2, 3]), torch.tensor([2.0, 4, 8])
    wpc.evaluate(envs, actor, mean, std, options())
    lengths = first_lengths(envs, 0)
    assert seen[0][:, 0].tolist() == [(length - 1) / 2 for length in lengths]
    assert seen[0][:, 1:].tolist() == [[-2 / 4, -3 / 8]] * 2
    assert seen[1][:, 0].tolist() == [(length - 2) / 2 for length in lengths]


@pytest.mark.parametrize("robot", wpc.D4RL_ROBOTS)
def test_a_seed_fixes_the_episodes_and_no_two_share_one(robot):
    envs = wpc.make_envs(robot, 3)
    state_dim = envs.single_observation_space.shape[0]
    action_dim = envs.single_action_space.shape[0]
    torch.manual_seed(0)
    actor = wpc.Actor(state_dim, action_dim, max_action=1.0)
    mean, std = torch.zeros(state_dim), torch.ones(state_dim)
    first, again, other = (
        wpc.evaluate(envs, actor, mean, std, options(seed=seed)) for seed in (0, 0, 1)
    )
    assert first == again and first["mean_return"] != other["mean_return"]
    assert first["std_return"] > 0  # nor do two environments of an evaluation
    # The environments of seed s are seeded with 1000 (s + 100) to 1000 (s + 100) + 2
    states = {
        seed: envs.reset(seed=1000 * (seed + 100))[0].tolist() for seed in range(3)
    }
    assert len({tuple(state) for s in states.values() for state in s}) == 9


def test_normalized_scores_are_d4rls(script):
    """By the published constants, for every dataset of a robot, and no other name."""
    returns = {
        "hopper": (-20.272305, 3234.3),
        "halfcheetah": (-280.178953, 12135.0),
        "walker2d": (1.629008, 4592.3),
    }
    envs = gym.vector.SyncVectorEnv([Countdown] * 4)
    for robot, (low, high) in returns.items():
        for env in (robot, f"{robot}-medium-replay-v2"):
            row = script.evaluate(envs, constant_actor(0.5), MEAN, STD, options(env))
            score = 100 * (row["mean_return"] - low) / (high - low)
            assert row["normalized_score"] == pytest.approx(score, rel=1e-9)
    for env in ("Hopper-v4", "hopper_medium", "ant", "my:hopper-v2"):
        row = script.evaluate(envs, constant_actor(0.5), MEAN, STD, options(env))
        assert "normalized_score" not in row
