# SPDX-License-Identifier: MIT
"""Makes a medium-replay dataset in D4RL's format: all that an online SAC agent
(Haarnoja et al., 2018) meets, from its first random steps to the policy that it ends
with. It works for every environment that the scripts can use, and names it in the file.
The dataset in tests/data/ was made by

    OMP_NUM_THREADS=1 python tests/tools/make_dataset.py --env HalfCheetah-v4 \\
        --steps 90000 --out tests/data/halfcheetah_replay.hdf5
"""

import copy
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from tqdm import trange

sys.path.insert(0, str(Path(__file__).parents[2]))
import wpc


@dataclass
class Args:
    out: Path
    """the HDF5 file to write"""
    env: str = "HalfCheetah-v4"
    """Gymnasium environment, or halfcheetah, hopper or walker2d"""
    steps: int = 90_000
    """environment steps, which is the number of transitions in the file"""
    random_steps: int = 5_000
    """steps of uniformly random actions before the agent acts and learns"""
    seed: int = 0
    """seed of the environment and of the agent"""
    discount: float = 0.99
    """discount factor gamma"""
    tau: float = 0.005
    """rate of the target critics"""
    lr: float = 3e-4
    """learning rate of actor, critics and temperature"""
    batch_size: int = 256
    """transitions an update"""


def mlp(inputs, outputs):
    return nn.Sequential(
        nn.Linear(inputs, 256),
        nn.ReLU(),
        nn.Linear(256, 256),
        nn.ReLU(),
        nn.Linear(256, outputs),
    )


def sample_action(actor, observation):
    """A tanh-Gaussian action in [-1, 1] and its log-probability (..., 1)."""
    mean, log_std = actor(observation).chunk(2, dim=-1)
    normal = torch.distributions.Normal(mean, log_std.clamp(-5, 2).exp())
    before_tanh = normal.rsample()
    log_prob = normal.log_prob(before_tanh) - 2 * (
        np.log(2) - before_tanh - F.softplus(-2 * before_tanh)
    )
    return torch.tanh(before_tanh), log_prob.sum(-1, keepdim=True)


def main(args: Args):
    wpc.make_envs(args.env, 1).close()  # exits if the scripts can't use it
    env_id = wpc.gymnasium_id(args.env)
    env = gym.make(env_id)
    env.action_space.seed(args.seed)
    torch.manual_seed(args.seed)
    obs_dim, action_dim = env.observation_space.shape[0], env.action_space.shape[0]
    max_action = float(env.action_space.high[0])
    data = {
        "observations": torch.zeros(args.steps, obs_dim),
        "actions": torch.zeros(args.steps, action_dim),
        "rewards": torch.zeros(args.steps),
        "terminals": torch.zeros(args.steps, dtype=torch.bool),
        "timeouts": torch.zeros(args.steps, dtype=torch.bool),
    }
    next_observations = torch.zeros(args.steps, obs_dim)

    actor = mlp(obs_dim, 2 * action_dim)
    critics = nn.ModuleList(mlp(obs_dim + action_dim, 1) for _ in range(2))
    targets = copy.deepcopy(critics)
    log_alpha = torch.zeros(1, requires_grad=True)
    actor_optimizer = torch.optim.Adam(actor.parameters(), args.lr, fused=True)
    critic_optimizer = torch.optim.Adam(critics.parameters(), args.lr, fused=True)
    alpha_optimizer = torch.optim.Adam([log_alpha], args.lr)

    observation, _ = env.reset(seed=args.seed)
    episode_return, progress = 0.0, trange(args.steps)
    for t in progress:
        if t < args.random_steps:
            action = env.action_space.sample()
        else:
            with torch.no_grad():
                action = (
                    max_action
                    * sample_action(
                        actor, torch.as_tensor(observation, dtype=torch.float32)
                    )[0].numpy()
                )
        next_observation, reward, terminated, truncated, _ = env.step(action)
        row = (
            observation,
            action,
            reward,
            terminated,
            truncated or t + 1 == args.steps,
        )
        for column, value in zip(data.values(), row, strict=True):
            column[t] = torch.as_tensor(value)
        next_observations[t] = torch.as_tensor(next_observation)
        observation, episode_return = next_observation, episode_return + reward
        if terminated or truncated:
            progress.set_postfix(episode_return=f"{episode_return:.0f}")
            observation, episode_return = env.reset()[0], 0.0
        if t < args.random_steps:
            continue

        i = torch.randint(t + 1, (args.batch_size,))
        o, a, r, done = (
            data["observations"][i],
            data["actions"][i] / max_action,
            data["rewards"][i],
            data["terminals"][i],
        )
        alpha = log_alpha.exp().detach()
        with torch.no_grad():
            next_a, log_prob = sample_action(actor, next_observations[i])
            next_oa = torch.cat([next_observations[i], next_a], 1)
            next_v = (
                torch.minimum(targets[0](next_oa), targets[1](next_oa))
                - alpha * log_prob
            )
            y = r[:, None] + args.discount * ~done[:, None] * next_v
        oa = torch.cat([o, a], 1)
        critic_loss = F.mse_loss(critics[0](oa), y) + F.mse_loss(critics[1](oa), y)
        critic_optimizer.zero_grad()
        critic_loss.backward()
        critic_optimizer.step()

        pi, log_prob = sample_action(actor, o)
        critics.requires_grad_(False)
        oa = torch.cat([o, pi], 1)
        actor_loss = (
            alpha * log_prob - torch.minimum(critics[0](oa), critics[1](oa))
        ).mean()
        actor_optimizer.zero_grad()
        actor_loss.backward()
        actor_optimizer.step()
        critics.requires_grad_(True)

        alpha_loss = -log_alpha.exp() * (log_prob.detach().mean() - action_dim)
        alpha_optimizer.zero_grad()
        alpha_loss.backward()
        alpha_optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(
                list(targets.parameters()), list(critics.parameters()), args.tau
            )

    with h5py.File(args.out, "w") as file:
        file.attrs["env_id"] = env_id
        for key, column in data.items():
            file.create_dataset(
                key,
                data=column.numpy(),
                compression="gzip",
                compression_opts=9,
                shuffle=True,
            )


if __name__ == "__main__":
    main(tyro.cli(Args))
