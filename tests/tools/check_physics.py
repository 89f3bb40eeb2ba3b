# SPDX-License-Identifier: MIT
"""Which simulator is a file's data of? Repeats its transitions in each that we know.

    python tests/tools/check_physics.py ~/.d4rl/datasets/hopper_medium-v2.hdf5
    python tests/tools/check_physics.py ant.hdf5 --env Ant-v5

Each row's state is set and its action done: in D4RL's physics (for its three robots),
as before each release of MuJoCo that changed a default (see eras.py), and as installed.
The state is that of infos/qpos and infos/qvel, where the file has them, and else the
observation's, which may lack the root's x and y: nothing depends on these. Rows with a
timeout are passed over, and those with a velocity that the observation clips at 10.
"""

import re
import sys
from dataclasses import dataclass
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
    """Gymnasium id, or halfcheetah, hopper, walker2d; by default that of the name"""
    rows: int = 2_000
    """number of rows, taken evenly from the whole file"""


def read_columns(path):
    """The file's columns, {name: array}, as `which_physics` takes them."""
    names = ["observations", "actions", "rewards", "terminals", "timeouts"]
    with h5py.File(path) as file:
        names += [name for name in ("next_observations", *INFOS) if name in file]
        return {name: file[name][:] for name in names}


def left_out(env):
    """How many entries of qpos an observation lacks, which goes on with the others and
    with qvel. Raises UserError if it is made otherwise."""
    env.reset(seed=0)
    observation, *_ = env.step(env.action_space.sample())
    data = env.unwrapped.data
    state = np.append(data.qpos, data.qvel.clip(-10, 10))
    for count in range(3):
        part = observation[: len(state) - count]
        if part.shape == state[count:].shape and np.allclose(part, state[count:]):
            return count
    raise wpc.UserError(
        f"{env.spec.id}'s states can't be set: its observations don't begin with qpos "
        f"and qvel, and the file has no {' and '.join(INFOS)}"
    )


def read_rows(columns, env, count):
    """Evenly spaced rows of the columns, `count` or all, and how many of them are passed
    over. The former are states and next states (N, nq + nv), with NaN for what the file
    doesn't tell, actions (N, action_dim), rewards and terminals (N,)."""
    model, total = env.unwrapped.model, len(columns["rewards"])
    terminals, timeouts = (columns[x].ravel() > 0 for x in ("terminals", "timeouts"))
    if columns.keys() >= set(INFOS):
        states = np.hstack([columns[name] for name in INFOS])
        next_states = None
    else:
        lacks = left_out(env)
        unknown = np.full((total, lacks), np.nan)
        end = model.nq + model.nv - lacks
        states = np.hstack([unknown, columns["observations"][:, :end]])
        next_states = columns.get("next_observations")
        if next_states is not None:
            next_states = np.hstack([unknown, next_states[:, :end]])
    if next_states is None:
        next_states = np.roll(states, -1, axis=0)
        next_states[terminals | timeouts] = next_states[-1] = np.nan
    next_states[np.abs(next_states) == 10] = np.nan
    passed = (timeouts & ~terminals) | (np.abs(states[:, model.nq :]) == 10).any(axis=1)
    rows = np.linspace(0, total - 1, min(count, total)).astype(int)
    kept = rows[~passed[rows]]
    rewards = columns["rewards"].ravel()
    columns = states, next_states, columns["actions"], rewards, terminals
    return [column[kept] for column in columns], len(rows) - len(kept)


def repeat(env, states, next_states, actions, rewards, terminals):
    """Sets each state and does its action; arguments as `read_rows` returns them.

    Returns the largest error of each row's next state, that of its reward, the number
    of rows that terminate here or in the file alone, and the share of next states that
    are right to four digits.
    """
    env.reset(seed=0)
    env = env.unwrapped
    nq, data, reached, reward_errors, differ = env.model.nq, env.data, [], [], 0
    for i, state in enumerate(np.nan_to_num(np.float64(states))):
        data.qpos[:], data.qvel[:] = state[:nq], state[nq:]
        mujoco.mj_forward(env.model, data)
        _, reward, terminated, *_ = env.step(actions[i])
        reached.append(np.append(data.qpos, data.qvel))
        reward_errors.append(abs(reward - rewards[i]))
        differ += terminated != terminals[i]
    # fmax passes over NaN.
    errors = np.fmax.reduce(np.abs(np.array(reached) - next_states), axis=1)
    largest = np.fmax.reduce(np.abs(next_states), axis=1).clip(1)
    right = (errors <= 1e-4 * largest)[~np.isnan(errors)]
    return errors, reward_errors, differ, right.mean() if right.size else 0.0


def list_physics(env_id):
    """Those to try: [words, id for --env or None, environment]."""
    env_id = re.sub(r"eras:|-before-[\d.]+", "", env_id)
    stock, *_ = wpc.d4rl_robot(env_id) or (env_id,)
    robot, tried = stock.split("-")[0].lower(), []
    if robot in wpc.D4RL_ROBOTS:
        tried.append(["D4RL's physics", robot, wpc.make_envs(robot, 1).envs[0]])
    for era in eras.ERAS:
        if Version(era) <= eras.INSTALLED:
            env = eras.use_era(wpc.make_envs(stock, 1).envs[0], era)
            try:
                name = eras.era_of(stock, f"{era}.dev0")
            except eras.NotHere:
                name = None
            tried.append([f"mujoco before {era}", name, env])
    env = wpc.make_envs(stock, 1).envs[0]
    return [*tried, [f"mujoco {eras.INSTALLED}, installed", stock, env]]


def try_physics(columns, env_id, count):
    """A row [words, id, errors, reward errors, differ, share] of each physics, the last
    four as `repeat` returns them, and how many of the file's rows were repeated and
    passed over. Raises UserError if the file isn't the environment's."""
    physics = list_physics(env_id)
    *_, stock = physics[-1]
    if not isinstance(getattr(stock.unwrapped, "model", None), mujoco.MjModel):
        raise wpc.UserError(f"{env_id} is no environment of MuJoCo's")
    shape = columns["observations"].shape
    if stock.observation_space.shape != shape[1:]:
        raise wpc.UserError(f"the file has observations {shape}: it isn't {env_id}'s")
    rows, passed = read_rows(columns, stock, count)
    results = [[words, name, *repeat(env, *rows)] for words, name, env in physics]
    return results, len(rows[0]), passed


def conclude(results):
    """The id of the physics that the file is of, or None, and a sentence on it."""
    best = max(share for *_, share in results)
    words, names = zip(*((x[0], x[1]) for x in results if x[-1] == best), strict=True)
    right = f"{100 * best:.4g}% of its next states are right to four digits"
    if best < 0.99:
        return None, f"none of these reproduces the file; in {words[-1]}, {right}"
    alike = " or ".join(words) + (", which are alike here" if len(words) > 1 else "")
    return names[-1], f"the file is of {alike}: {right}; evaluate in --env {names[-1]}"


def which_physics(columns, env_id, rows=500):
    """Which physics data are of: the id for --env that evaluates in it, or None if it is
    none that we know, and a sentence that says so.

    `columns` are a D4RL file's, {name: array (N, ...)}; of next_observations,
    infos/qpos and infos/qvel what there is. `env_id` is the environment's plain id.
    Raises UserError with a sentence if its states can't be set.
    """
    results, *_ = try_physics(columns, env_id, rows)
    return conclude(results)


def main(args: Args):
    robot = args.file.stem.split("_")[0]
    env = args.env or (robot if robot in wpc.D4RL_ROBOTS else None)
    if not env:
        sys.exit(f"name the environment of {args.file} with --env, as in --env Ant-v5")
    try:
        columns = read_columns(args.file)
    except (OSError, KeyError) as error:
        sys.exit(f"{args.file}: {error}")
    results, compared, passed = try_physics(columns, env, args.rows)
    print(
        f"{args.file.name}: {compared} rows compared, {passed} passed over; "
        "median (largest) error:"
    )
    print()
    print("| physics | next state | reward | terminations that differ |")
    print("|---|---|---|---|")
    for words, _, *errors, differ, _ in results:
        cells = [f"{np.nanmedian(x):.2g} ({np.nanmax(x):.2g})" for x in errors]
        print(f"| {words} | {' | '.join(cells)} | {differ} |")
    print()
    print(conclude(results)[1])


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except (wpc.UserError, gym.error.Error) as error:
        sys.exit(str(error))
