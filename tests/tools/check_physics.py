# SPDX-License-Identifier: MIT
"""Do the robots move as in a file of D4RL's? Repeats its transitions, and compares.

    python tests/tools/check_physics.py ~/.d4rl/datasets/hopper_medium-v2.hdf5

Each row's state is set and its action done, in D4RL's physics (`use_d4rl_physics`) and
in Gymnasium's stock environment. The observation gives the state: it lacks the root's
x, on which nothing depends. Hopper's and Walker2d's observations clip velocities at 10,
so rows that have one there are passed over.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import h5py
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
import wpc


@dataclass
class Args:
    file: Annotated[Path, tyro.conf.Positional]
    """HDF5 file of halfcheetah, hopper or walker2d in D4RL's format"""
    env: str | None = None
    """the robot; by default what the file's name begins with"""
    rows: int = 2_000
    """number of rows, taken evenly from the whole file"""


def read_rows(path, count):
    """Evenly spaced rows of the file, `count` or all: states and next states
    (N, state_dim), NaN where the file tells no next state, actions (N, action_dim),
    rewards and terminals (N,)."""
    with h5py.File(path) as file:
        states, actions = file["observations"][:], file["actions"][:]
        rewards, terminals = (file[key][:].ravel() for key in ("rewards", "terminals"))
        if "next_observations" in file:
            next_states = file["next_observations"][:]
        else:
            next_states = np.roll(states, -1, axis=0)
            next_states[(terminals > 0) | (file["timeouts"][:].ravel() > 0)] = np.nan
            next_states[-1] = np.nan
    rows = np.linspace(0, len(states) - 1, min(count, len(states))).astype(int)
    columns = states, next_states, actions, rewards, terminals
    return [column[rows] for column in columns]


def repeat(env, states, next_states, actions, rewards, terminals):
    """Sets each state and does its action; arguments as `read_rows` returns them.

    Returns the error of each row's next state, the largest over its dimensions, that of
    its reward, and the number of rows that terminate here or in the file alone.
    """
    env = env.unwrapped
    first_velocity = env.model.nq - 1
    state_errors, reward_errors, differ = [], [], 0
    for i, state in enumerate(np.float64(states)):
        env.set_state(np.append(0, state[:first_velocity]), state[first_velocity:])
        next_state, reward, terminated, _, _ = env.step(actions[i])
        state_errors.append(np.abs(next_state - next_states[i]).max())
        reward_errors.append(abs(reward - rewards[i]))
        differ += terminated != bool(terminals[i])
    return state_errors, reward_errors, differ


def main(args: Args):
    robot = args.env or args.file.stem.split("_")[0]
    if robot not in wpc.D4RL_ROBOTS:
        sys.exit(f"--env must be one of {', '.join(wpc.D4RL_ROBOTS)}, and is {robot}")
    stock, *_ = wpc.D4RL_ROBOTS[robot]
    try:
        states, *others = read_rows(args.file, args.rows)
    except (OSError, KeyError) as error:
        sys.exit(f"{args.file}: {error}")
    if wpc.make_envs(stock, 1).single_observation_space.shape != states.shape[1:]:
        sys.exit(f"{args.file} has observations {states.shape}: it isn't {robot}'s")
    clipped = np.zeros(len(states), dtype=bool)
    if robot != "halfcheetah":
        clipped = (np.abs(states) >= 10).any(axis=1)
    rows = [column[~clipped] for column in (states, *others)]

    count = clipped.sum()
    print(
        f"{args.file.name}: {len(clipped) - count} rows compared, {count} passed over; "
        "median (largest) error:"
    )
    print()
    print("| physics | next observation | reward | terminations that differ |")
    print("|---|---|---|---|")
    for name, env in (("D4RL's physics", robot), (f"stock {stock}", stock)):
        env = wpc.make_envs(env, 1).envs[0]
        *errors, differ = repeat(env, *rows)
        cells = [f"{np.nanmedian(x):.2g} ({np.nanmax(x):.2g})" for x in errors]
        print(f"| {name} | {' | '.join(cells)} | {differ} |")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except wpc.UserError as error:
        sys.exit(str(error))
