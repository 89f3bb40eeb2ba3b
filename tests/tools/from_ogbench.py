# SPDX-License-Identifier: MIT
"""Turns a single-task dataset of OGBench's into an HDF5 file, which the scripts read.

    python tests/tools/from_ogbench.py antmaze-large-navigate-singletask-v0 \\
        --out antmaze.hdf5

In OGBench's files `terminals` are the ends of trajectories, at which no task ends, and
the last action of each leads nowhere. Here such a row is a timeout, of which the
scripts make no transition. Terminal are the rows in which the task is solved, also in
the midst of a trajectory, as OGBench's `masks` have it: they stop the bootstrap there.

Papers report how many episodes succeed. In the mazes each step costs 1 until then, so
those succeed whose return is above minus the time limit.
"""

import importlib.util
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import mujoco
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
import eras
from make_dataset import print_command, reason, try_to_write, write_or_exit

RECORDED = "3.1.6"  # the data are of 2024, with this MuJoCo or one that moves alike


@dataclass
class Args:
    name: Annotated[str, tyro.conf.Positional]
    """single-task dataset, such as antmaze-large-navigate-singletask-task1-v0"""
    out: Path
    """HDF5 file to write"""
    dataset_path: Path | None = None
    """OGBench's .npz file; by default in ~/.ogbench/data, downloaded on first use"""


def parse(name):
    """The names of the file and of the environment."""
    if re.match("visual-|powderworld-", name):
        sys.exit(f"{name} has pictures or discrete actions: the scripts can't use it")
    parts = re.fullmatch(r"(.+)(-[a-z]+)-singletask(-task\d)?(-v\d)", name)
    if not parts:
        sys.exit(
            f"{name} is no single-task dataset of OGBench, so it has no rewards: name "
            "one such as antmaze-large-navigate-singletask-v0, or -singletask-task2-v0"
        )
    robot, kind, task, version = parts.groups(default="")
    return robot + kind + version, f"{robot}-singletask{task}{version}"


def load(args):
    """The environment's id, and OGBench's arrays with the rewards of its task."""
    file, env_id = parse(args.name)
    if not importlib.util.find_spec("ogbench"):
        sys.exit(
            "OGBench is not installed: pip install ogbench==1.2.2 "
            f"mujoco=={mujoco.__version__} (without which pip replaces MuJoCo)"
        )
    from ogbench.relabel_utils import relabel_dataset
    from ogbench.utils import download_datasets, load_dataset

    try:
        env = gym.make(env_id)
        if not (path := args.dataset_path):
            download_datasets([file])
            path = Path(f"~/.ogbench/data/{file}.npz").expanduser()
        data = load_dataset(path, compact_dataset=True, add_info=True)
        relabel_dataset(env_id, env, data)
    except Exception as error:  # of many types: no such name, no network, a bad file
        sys.exit(f"{args.name} can't be had from OGBench's files ({reason(error)})")
    return env_id, data


def convert(data):
    """The columns of the file, {key: array}, with T + 1 rows for T transitions."""
    ends = data["valids"] == 0
    states = data["observations"]
    columns = {
        "observations": states,
        "actions": data["actions"],
        "rewards": data["rewards"],
        "next_observations": np.where(ends[:, None], states, np.roll(states, -1, 0)),
        "terminals": (data["masks"] == 0) & ~ends,
        "timeouts": ends,
    }
    return columns | {f"infos/{k}": data[k] for k in ("qpos", "qvel") if k in data}


def main(args):
    try_to_write(args.out)
    env_id, data = load(args)
    columns = convert(data)
    write_or_exit(args.out, columns)
    ends, solved = columns["timeouts"].sum(), columns["terminals"].sum()
    print(
        f"{args.out}: {len(data['valids']) - ends:,} transitions in {ends:,} "
        f"trajectories; in {solved:,} the task is solved"
    )
    env = f"ogbench:{env_id}"
    try:
        env = eras.era_of(env, RECORDED)
    except eras.NotHere as error:
        print(error)
    print_command(env, args.out)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
