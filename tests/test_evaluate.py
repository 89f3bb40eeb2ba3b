# SPDX-License-Identifier: MIT
"""Evaluation on an environment whose returns are known, and on the real ones."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import wpc

MEAN, STD = torch.zeros(3), torch.ones(3)


class Countdown(gym.Env):
    """An episode of 3 to 9 steps, drawn by the reset, that pays 1 + action a step; each later episode pays 1000 a step."""

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
        return np.array([self.left, 0, 0], np.float64), reward, over and not self.truncates, over and self.truncates, {}


def make_actor(obs_dim, action_dim):
    return wpc.make_networks(obs_dim, action_dim, wpc.Args(), "cpu")[0]["actor"]


def constant_actor(action):
    actor = make_actor(3, 1)
    with torch.no_grad():
        for p in actor.parameters():
            p.zero_()
        actor[4].bias += np.arctanh(action)
    return actor


def first_lengths(envs, seed):
    envs.reset(seed=np.random.SeedSequence(seed + 100).generate_state(envs.num_envs).tolist())
    return [env.unwrapped.length for env in envs.envs]


def test_only_each_first_episode_counts():
    envs = gym.vector.SyncVectorEnv([Countdown] * 16)
    returns = wpc.evaluate(envs, constant_actor(0.5), MEAN, STD, seed=0)
    lengths = first_lengths(envs, 0)
    assert min(lengths) < max(lengths)  # some go on to a second episode while others are in their first
    assert returns == pytest.approx(1.5 * np.array(lengths))


def test_the_actor_sees_normalized_observations():
    class Recorder(torch.nn.Module):
        seen = []

        def forward(self, s):
            self.seen.append(s)
            return torch.zeros(len(s), 1)

    envs = gym.vector.SyncVectorEnv([Countdown] * 2)
    wpc.evaluate(envs, Recorder(), torch.tensor([1.0, 2, 3]), torch.tensor([2.0, 4, 8]), seed=0)
    assert Recorder.seen[0][:, 0].tolist() == [(length - 1) / 2 for length in first_lengths(envs, 0)]
    assert Recorder.seen[0][:, 1:].tolist() == [[-2 / 4, -3 / 8]] * 2


@pytest.mark.parametrize("env", [robot[0] for robot in wpc.ROBOTS.values()])
def test_same_seed_same_returns_other_seed_other_states(env):
    gym.logger.min_level = gym.logger.ERROR
    envs = gym.make_vec(env, 3, vectorization_mode="sync")
    obs_dim, action_dim = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    actor, mean, std = make_actor(obs_dim, action_dim), torch.zeros(obs_dim), torch.ones(obs_dim)
    first, again, other = (wpc.evaluate(envs, actor, mean, std, seed) for seed in (0, 0, 1))
    assert first.tolist() == again.tolist()
    assert not set(first) & set(other) and len({*first, *other}) == 6


def test_ten_seeds_share_no_initial_state():
    states = np.concatenate([np.random.SeedSequence(seed + 100).generate_state(10) for seed in range(10)])
    assert len(set(states.tolist())) == 100


def test_scores_are_d4rls():
    """Published normalisation constants, by hand: an expert's return is 100, a random policy's 0."""
    assert wpc.ROBOTS["hopper"] == ("Hopper-v4", -20.272305, 3234.3)
    assert wpc.ROBOTS["halfcheetah"] == ("HalfCheetah-v4", -280.178953, 12135.0)
    assert wpc.ROBOTS["walker2d"] == ("Walker2d-v4", 1.629008, 4592.3)
