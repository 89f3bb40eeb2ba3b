# SPDX-License-Identifier: MIT
"""Are the training steps those of the authors' code? Does both, and compares.

    python tests/tools/check_steps.py TD3_BC/TD3_BC.py wPC/TD3_wBC.py

The files are those of github.com/sfujim/TD3_BC and github.com/qsa-fox/wPC, which you
download yourself. With the same networks, batches and noise, in float64, the parameters
after all steps should differ by rounding only. wpc.py departs from its authors' code in
one place: they weight actions by V as it was before the step's update, Algorithm 1 by V
after it. Both are tried.
"""

import copy
import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import torch
import torch.nn as nn
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
import td3_bc
import wpc

DIMS = 11, 3, 1.0  # state_dim, action_dim, max_action


@dataclass
class Args:
    files: Annotated[list[Path], tyro.conf.Positional]
    """files with a class TD3_BC as TD3_BC.py has it; wPC's has `vnet`, too"""
    steps: int = 300
    """number of training steps"""


class ValueBeforeUpdate(nn.Module):
    """Without gradient, V(s) as last computed with it: before the step's update."""

    def __init__(self, value):
        super().__init__()
        self.value = value

    def forward(self, s):
        if torch.is_grad_enabled():
            self.v = self.value(s)
        return self.v


def copy_parameters(source, target):
    """Between networks whose layers stand in the same order."""
    for old, new in zip(target.parameters(), source.parameters(), strict=True):
        old.data.copy_(new)


def random_batch(device):
    """Of TD3_BC.py's replay buffer: states, actions, next states, rewards, not done."""
    state_dim, action_dim, max_action = DIMS
    s, s_next = torch.randn(2, 256, state_dim)
    a = max_action * (2 * torch.rand(256, action_dim) - 1)
    r, not_done = torch.randn(256, 1), (torch.rand(256, 1) > 0.1).double()
    return [x.to(device) for x in (s, a, s_next, r, not_done)]


def largest_difference(peer, script, steps, v_before=False):
    """Of all parameters after so many steps of a script and of a file's TD3_BC."""
    torch.manual_seed(0)
    device = str(getattr(peer, "device", "cpu"))
    ours, theirs = script.Agent(*DIMS, script.Args(device=device)), peer.TD3_BC(*DIMS)
    copy_parameters(ours.actor, theirs.actor)
    copy_parameters(ours.critic, theirs.critic)
    theirs.actor_target = copy.deepcopy(theirs.actor)
    theirs.critic_target = copy.deepcopy(theirs.critic)
    if script is wpc:
        copy_parameters(ours.value, theirs.vnet)
    if v_before:
        ours.value = ValueBeforeUpdate(ours.value)
    buffer = SimpleNamespace()
    for step in range(1, steps + 1):
        torch.manual_seed(step)
        s, a, s_next, r, not_done = batch = random_batch(device)
        buffer.sample = lambda _, batch=batch: batch
        torch.manual_seed(step)
        theirs.train(buffer)
        torch.manual_seed(step)
        batch = {"observations": s, "actions": a, "next_observations": s_next}
        ours.update(batch | {"rewards": r, "terminals": 1 - not_done}, step)
    names = ("critic", "actor", "critic_target", "actor_target")
    pairs = [(getattr(ours, name), getattr(theirs, name)) for name in names]
    if script is wpc:
        pairs.append((ours.value, theirs.vnet))
    return max(
        (x - y).abs().max().item()
        for our, their in pairs
        for x, y in zip(our.parameters(), their.parameters(), strict=True)
    )


def load(path, name):
    """The file as a module. Exits with a sentence if it has not what is named."""
    if not path.is_file():
        sys.exit(f"{path} is no file")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    peer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(peer)
    if not hasattr(peer, name):
        sys.exit(f"{path} has no {name}")
    return peer


def main(args: Args):
    torch.set_default_dtype(torch.float64)
    for path in args.files:
        peer = load(path, "TD3_BC")
        is_wpc = hasattr(peer.TD3_BC(*DIMS), "vnet")
        script = wpc if is_wpc else td3_bc
        difference = largest_difference(peer, script, args.steps)
        print(f"{script.__name__}.py and {path}: {difference:.1e}", flush=True)
        if is_wpc:
            difference = largest_difference(peer, wpc, args.steps, v_before=True)
            print(f"the same, with V before its update: {difference:.1e}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
