# SPDX-License-Identifier: MIT
"""Made the files in tests/data/eras, with the MuJoCo that most of Minari's sets have:

pip install gymnasium-robotics==1.4.2 "gymnasium[mujoco]==1.4.0" mujoco==3.2.3 h5py
python tests/data/eras/make.py
"""

from pathlib import Path

import gymnasium as gym
import h5py
import mujoco
import numpy as np


def record(env_id, rows, dtype, infos):
    """Columns of random actions in D4RL's format, {name: array}: episodes of 100 steps
    at most, with qpos and qvel if `infos`."""
    env = gym.make(env_id, max_episode_steps=100)
    env.action_space.seed(0)
    data, taken, over = env.unwrapped.data, [], True
    names = ["observations", "actions", "rewards", "terminals", "timeouts"]
    names += ["infos/qpos", "infos/qvel"] * infos
    for _ in range(rows):
        if over:
            state, _ = env.reset(seed=len(taken))
        before = [data.qpos.copy(), data.qvel.copy()] * infos
        action = env.action_space.sample()
        next_state, reward, terminal, truncated, _ = env.step(action)
        over = terminal or truncated
        taken.append([state, action, reward, terminal, over and not terminal, *before])
        state = next_state
    columns = [np.array(column) for column in zip(*taken, strict=True)]
    columns = [x if x.dtype == bool else x.astype(dtype) for x in columns]
    return dict(zip(names, columns, strict=True))


def write(path, columns):
    with h5py.File(path, "w") as file:
        for name, column in columns.items():
            file.create_dataset(name, data=column, compression="gzip", shuffle=True)


if __name__ == "__main__":
    import gymnasium_robotics  # noqa: F401, registers the hand

    for name, *how in (
        ("Hopper-v5", 300, "f8", False),
        ("Ant-v5", 200, "f4", False),
        ("AdroitHandPen-v1", 60, "f8", True),
    ):
        path = Path(__file__).with_name(f"{name}_{mujoco.__version__}.hdf5")
        write(path, record(name, *how))
