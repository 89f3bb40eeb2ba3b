# SPDX-License-Identifier: MIT
"""The paper's Figure 1 in small: half of the dataset's actions are good, half are bad.

Behaviour cloning ends between the two. TD3+BC gets some way to the good ones, as far as
its constraint lets it. wPC imitates the good ones alone, and gets there.
"""

import torch
from conftest import td3_bc, wpc


def reward(s, a):
    """Largest where a = 0.3 s + 0.4; negative, and so is Q, but not lambda."""
    return 10 * (-1 - (a - 0.3 * s - 0.4).abs())


def make_dataset():
    torch.manual_seed(0)
    s = 2 * torch.rand(2000, 1) - 1
    is_good = torch.arange(2000)[:, None] % 2 == 0
    center = 0.3 * s + torch.where(is_good, 0.4, -0.4)
    a = (center + 0.1 * torch.randn(2000, 1)).clamp(-1, 1)
    return {
        "observations": s,
        "actions": a,
        "rewards": reward(s, a),
        "next_observations": s,
        "terminals": torch.ones(2000, 1),  # an episode is a step long
    }


def mean_reward(script, alpha, **options):
    """The policy's mean reward after 600 steps of training."""
    dataset = make_dataset()
    args = script.Args(
        device="cpu", alpha=alpha, actor_lr=3e-3, critic_lr=3e-3, **options
    )
    agent = script.Agent(1, 1, 1.0, args)
    for step in range(1, 601):
        agent.update(script.sample_batch(dataset, 64), step)
    s = torch.linspace(-1, 1, 101)[:, None]
    with torch.no_grad():
        return reward(s, agent.actor(s)).mean().item()


def test_q_helps_and_the_weight_helps():
    cloning = mean_reward(td3_bc, alpha=0.0)
    td3_bc_reward = mean_reward(td3_bc, alpha=0.4)
    wpc_reward = mean_reward(wpc, alpha=0.4, value_lr=3e-3)
    assert cloning < -13
    assert cloning + 0.5 < td3_bc_reward < -12  # Q helps
    assert wpc_reward > -10.5  # the weight helps; -10 is the best there is
