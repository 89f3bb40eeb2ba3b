# SPDX-License-Identifier: MIT
"""Which MuJoCo is a file's data of? Repeats its transitions as each that we know moves.

    python tests/tools/check_physics.py ~/.d4rl/datasets/hopper_medium-v2.hdf5
    python tests/tools/check_physics.py ant.hdf5 --env Ant-v5

Each row's state is set and its action done: in D4RL's physics (only its three robots),
as before each release that changed a default (see eras.py), and as installed. A state
is taken from infos/qpos and infos/qvel, where the file has them, or else from the
observation, which may lack the root's x and y: nothing depends on these. Rows with a
timeout are passed over, and those with a velocity that the observation clips at 10.
Ant's and Humanoid's rewards are of positions one substep old, so they differ a little.
"""

import re
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import h5py
import mujoco
import numpy as np
import tyro
from packaging.version import Version

sys.path.insert(0, str(Path(__file__).parents[2]))
import eras

import wpc

INFOS = ("infos/qpos", "infos/qvel")


@dataclass
class Args:
    file: Annotated[Path, tyro.conf.Positional]
    """HDF5 file in D4RL's format, of a MuJoCo environment"""
    env: str | None = None
    """Gymnasium id, or halfcheetah, hopper, walker2d, which the file's name may tell"""
    rows: int = 2_000
    """number of rows, taken evenly from the whole file"""


def read_columns(path):
    """The file's columns, {name: array}, as `which_physics` takes them."""
    names = ["observations", "actions", "rewards", "terminals", "timeouts"]
    with h5py.File(path) as file:
        names += [name for name in ("next_observations", *INFOS) if name in file]
        return {name: file[name][:] for name in names}


def state_size(env):
    """How many numbers, first in an observation, are the end of qpos, and all qvel."""
    observation, _ = env.reset(seed=0)
    state = np.append(env.unwrapped.data.qpos, env.unwrapped.data.qvel)
    for lacks in range(3):
        part = observation[: len(state) - lacks]
        if part.shape == state[lacks:].shape and np.allclose(part, state[lacks:]):
            return part.size
    raise wpc.UserError(
        f"{env.spec.id}'s states can't be set: its observations don't begin with qpos "
        f"and qvel, and the file has no {' and '.join(INFOS)}"
    )


def read_rows(columns, env, count):
    """Evenly spaced rows of the columns, `count` or all, for `repeat`, and how many are
    passed over. A state is the end of qpos, and qvel; what isn't known of it, NaN."""
    terminals, timeouts = (columns[x].ravel() > 0 for x in ("terminals", "timeouts"))
    if columns.keys() >= set(INFOS):
        states, next_states = np.hstack([columns[name] for name in INFOS]), None
    else:
        states = columns["observations"][:, : state_size(env)]
        next_states = columns.get("next_observations")
    if next_states is None:
        next_states = np.roll(states, -1, axis=0)
        next_states[terminals | timeouts] = next_states[-1] = np.nan
    next_states = next_states[:, : states.shape[1]].astype(float)
    next_states[np.abs(next_states) == 10] = np.nan
    clipped = np.abs(states[:, -env.unwrapped.model.nv :]) == 10
    passed_over = clipped.any(axis=1) | (timeouts & ~terminals)
    rows = np.linspace(0, len(states) - 1, min(count, len(states))).astype(int)
    kept = rows[~passed_over[rows]]
    if not np.isfinite(next_states[kept]).any():
        raise wpc.UserError("the file has no transition that can be compared")
    actions, rewards = columns["actions"], columns["rewards"].ravel()
    arrays = states, next_states, actions, rewards, terminals
    return [array[kept] for array in arrays], len(rows) - len(kept)


def repeat(env, states, next_states, actions, rewards, terminals):
    """Sets each state and does its action; arguments as `read_rows` returns them.

    Returns the largest error of each row's next state, that of its reward, the number
    of rows that terminate here or in the file alone, and the share of next states that
    are right to four digits.
    """
    env.reset(seed=0)
    env = env.unwrapped
    nq, size, data = env.model.nq, states.shape[1], env.data
    lacking = np.zeros(nq + env.model.nv - size)
    reached, reward_errors, differ = [], [], 0
    for i, state in enumerate(states):
        data.qpos[:], data.qvel[:] = np.split(np.append(lacking, state), [nq])
        mujoco.mj_forward(env.model, data)
        _, reward, terminated, *_ = env.step(actions[i])
        reached.append(np.append(data.qpos, data.qvel)[-size:])
        reward_errors.append(abs(reward - rewards[i]))
        differ += terminated != terminals[i]
    errors = np.fmax.reduce(np.abs(reached - next_states), axis=1)  # ignores NaN
    largest = np.fmax.reduce(np.abs(next_states), axis=1)
    right = (errors <= 1e-4 * largest)[np.isfinite(errors)]
    return errors, reward_errors, differ, right.sum() / max(right.size, 1)


def try_physics(columns, env_id, count):
    """(name, id for --env or None, what `repeat` returns) of each physics, and how many
    rows are passed over. Raises UserError if the file isn't the environment's."""
    env_id = re.sub(r"eras:|-before-[\d.]+", "", env_id)
    stock, *_ = wpc.d4rl_robot(env_id) or (env_id,)
    robot, env = stock.split("-")[0].lower(), wpc.make_envs(stock, 1).envs[0]
    if not isinstance(getattr(env.unwrapped, "model", None), mujoco.MjModel):
        raise wpc.UserError(f"{env_id} is none of MuJoCo's environments")
    shape = columns["observations"].shape
    if env.observation_space.shape != shape[1:]:
        raise wpc.UserError(f"the file has observations {shape}: it isn't {env_id}'s")
    rows, passed_over = read_rows(columns, env, count)
    physics = []
    if robot in wpc.D4RL_ROBOTS:
        d4rl = wpc.make_envs(robot, 1).envs[0]
        physics.append(("D4RL's, MuJoCo 2.0", robot, *repeat(d4rl, *rows)))
    for since, era in pairwise(("2.1.2", *eras.ERAS)):
        if Version(era) <= eras.INSTALLED:
            try:
                name = eras.era_of(stock, since)
            except eras.NotHere:
                name = None
            old = eras.use_era(wpc.make_envs(stock, 1).envs[0], era)
            physics.append((f"mujoco>={since},<{era}", name, *repeat(old, *rows)))
    physics.append((f"mujoco=={eras.INSTALLED}", stock, *repeat(env, *rows)))
    return physics, passed_over


def conclude(physics):
    """The id of the physics that repeats the file, or None, and a sentence on it."""
    best = max(share for *_, share in physics)
    names, ids = zip(*(x[:2] for x in physics if x[-1] == best), strict=True)
    which, right = " or ".join(names), f"{100 * best:.4g}% of the next states are right"
    if best < 0.99:
        return None, (
            "The file is of none of these, or its states are more than qpos and qvel: "
            f"in {which}, the nearest, {right}"
        )
    alike = ", which are alike here" if len(ids) > 1 else ""
    advice = f"--env {ids[-1]}" if ids[-1] else "register it with eras.use_era"
    return ids[-1], f"The file is of {which}{alike} ({right}): {advice}"


def which_physics(columns, env_id, rows=500):
    """Which MuJoCo data are of: the id for --env that moves as it, None if none does or
    if that has no id, and a sentence for the user.

    `columns` are a D4RL file's, {name: array (N, ...)}; next_observations, infos/qpos
    and infos/qvel may be among them. `env_id` is the environment as installed. Raises
    UserError with a sentence if its states can't be set.
    """
    return conclude(try_physics(columns, env_id, rows)[0])


def main(args: Args):
    robot = args.file.stem.split("_")[0]
    if not args.env and robot not in wpc.D4RL_ROBOTS:
        sys.exit(f"{args.file} names no environment: add one, as in --env Ant-v5")
    try:
        columns = read_columns(args.file)
    except (OSError, KeyError) as error:
        sys.exit(f"{args.file}: {error}")
    physics, passed_over = try_physics(columns, args.env or robot, args.rows)
    print(
        f"{args.file.name}: {len(physics[0][2])} rows compared, {passed_over} passed "
        "over; median (largest) error:"
    )
    print("\n| physics | next state | reward | terminations that differ |")
    print("|---|---|---|---|")
    for name, _, *errors, differ, _ in physics:
        cells = [f"{np.nanmedian(x):.2g} ({np.nanmax(x):.2g})" for x in errors]
        print(f"| {name} | {' | '.join(cells)} | {differ} |")
    print(f"\n{conclude(physics)[1]}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except (wpc.UserError, gym.error.Error, ImportError) as error:
        sys.exit(str(error))
