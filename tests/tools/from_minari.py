# SPDX-License-Identifier: MIT
"""Turns a Minari dataset into an HDF5 file in D4RL's format, which the scripts read.

    python tests/tools/from_minari.py mujoco/hopper/medium-v0 --out hopper.hdf5
    python wpc.py --dataset hopper.hdf5

In Minari, an episode of T steps has T + 1 observations; in D4RL's format it has T, and
so the last step of an episode that was cut off is lost. Here the last observation gets
a row of its own, without action and reward, and marked as a timeout. The scripts, like
D4RL's own reader, then make a transition of each of the T steps, and none of that row.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import h5py
import minari
import numpy as np
import tyro


@dataclass
class Args:
    dataset: Annotated[str, tyro.conf.Positional]
    """name of a Minari dataset, downloaded on first use, or the folder of one"""
    out: Path
    """HDF5 file to write"""


def open_dataset(name):
    """Minari's dataset; exits with a sentence if there is none of that name."""
    folder = Path(name)
    if (folder / "data").is_dir():
        folder = folder / "data"
    try:
        if folder.is_dir():
            return minari.MinariDataset(folder)
        return minari.load_dataset(name, download=True)
    except Exception as error:  # from Minari, Hugging Face's client, or the network
        reason = f"{type(error).__name__}: {error}".split("\n")[0]
        sys.exit(f"{name} can't be opened or downloaded by Minari ({reason})")


def check_spaces(dataset):
    for name in ("observation_space", "action_space"):
        space = getattr(dataset, name)
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            sys.exit(
                f"{dataset.id} has the {name} {space}: it must be a Box of one axis"
            )


def d4rl_rows(episode):
    """The T + 1 rows of an episode with T actions, as {key: array}."""
    no_action = np.zeros_like(episode.actions[:1])
    return {
        "observations": episode.observations,
        "actions": np.concatenate([episode.actions, no_action]),
        "rewards": np.append(episode.rewards, 0),
        "terminals": np.append(episode.terminations, False),
        "timeouts": np.append(np.zeros(len(episode.actions), dtype=bool), True),
    }


def main(args: Args):
    dataset = open_dataset(args.dataset)
    check_spaces(dataset)
    episodes = [d4rl_rows(episode) for episode in dataset.iterate_episodes()]
    attributes = {"source": f"Minari's {dataset.id}"}
    if dataset.env_spec is not None:
        attributes["env_id"] = dataset.env_spec.id
    for name in ("ref_min_score", "ref_max_score"):
        if dataset.storage.metadata.get(name) is not None:
            attributes[name] = dataset.storage.metadata[name]
    with h5py.File(args.out, "w") as file:
        file.attrs.update(attributes)
        for key in episodes[0]:
            column = np.concatenate([rows[key] for rows in episodes])
            file.create_dataset(key, data=column, compression="gzip", shuffle=True)
    print(
        f"{args.out}: {dataset.total_steps:,} transitions in {len(episodes):,} episodes"
        f" of {attributes.get('env_id', 'an environment that Minari does not name')}"
    )


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
