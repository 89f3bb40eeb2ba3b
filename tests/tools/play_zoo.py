# SPDX-License-Identifier: MIT
"""Plays a published agent of rl-baselines3-zoo in D4RL's physics and in the stock one.

    git clone https://github.com/DLR-RM/rl-trained-agents
    python tests/tools/play_zoo.py rl-trained-agents/tqc/Hopper-v3_1/Hopper-v3.zip

Its agents for Hopper-v3, Walker2d-v3 and HalfCheetah-v3 (SAC and TQC) were trained and
scored in the simulator that D4RL was recorded with, so their published returns are what
`evaluate` should find. In the zip lies the policy, a network of the size of `Actor`.
"""

import io
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
import wpc

LAYERS = "actor.latent_pi.0", "actor.latent_pi.2", "actor.mu"


@dataclass
class Args:
    files: Annotated[list[Path], tyro.conf.Positional]
    """zip files, named <Robot>-v3.zip"""
    episodes: int = 20
    """number of episodes in each physics"""


def read_actor(path):
    """The zip's deterministic policy as an `Actor`: the tanh of the mean action."""
    with zipfile.ZipFile(path) as file:
        policy = io.BytesIO(file.read("policy.pth"))
    policy = torch.load(policy, map_location="cpu", weights_only=True)
    tensors = [policy[f"{layer}.{x}"] for layer in LAYERS for x in ("weight", "bias")]
    actor = wpc.Actor(tensors[0].shape[1], len(tensors[-1]), max_action=1.0)
    names = actor.state_dict().keys()
    actor.load_state_dict(dict(zip(names, tensors, strict=True)))
    return actor


def main(args: Args):
    print("| agent | D4RL's physics | stock -v4 |")
    print("|---|---|---|")
    for path in args.files:
        robot = path.stem.split("-")[0].lower()
        if robot not in wpc.D4RL_ROBOTS:
            sys.exit(f"{path} must be named after one of {', '.join(wpc.D4RL_ROBOTS)}")
        try:
            actor = read_actor(path)
        except (OSError, KeyError, zipfile.BadZipFile) as error:
            sys.exit(f"{path}: {error}")
        cells = [f"{path.parent.parent.name} {path.stem}"]
        for env in (robot, wpc.D4RL_ROBOTS[robot][0]):
            envs = wpc.make_envs(env, args.episodes)
            run = wpc.Args(env=env, dataset="none")  # for its seed
            row = wpc.evaluate(envs, actor, torch.zeros(1), torch.ones(1), run)
            cells.append(f"{row['mean_return']:.0f} +- {row['std_return']:.0f}")
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except wpc.UserError as error:
        sys.exit(str(error))
