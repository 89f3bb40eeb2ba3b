# SPDX-License-Identifier: MIT
"""Made the Minari datasets in tests/data/minari, with Minari's own DataCollector:

    pip install "minari[create,hdf5]==0.5.4" "gymnasium[mujoco]==1.4.0" mujoco==3.15.0
    MINARI_DATASETS_PATH=$PWD/tests/data/minari python tests/data/minari/make.py

DataCollector needs JAX, which nothing else here does; hence the datasets are stored.
"""

import gymnasium as gym
import minari

REFERENCES = {"ref_min_score": 1.0, "ref_max_score": 100.0}


def collect(env_id, dataset_id, episodes, steps, **metadata):
    """Episodes of random actions, cut off after `steps` steps."""
    env = minari.DataCollector(gym.make(env_id, max_episode_steps=steps))
    env.action_space.seed(0)
    for seed in range(episodes):
        env.reset(seed=seed)
        over = False
        while not over:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
    env.create_dataset(dataset_id, algorithm_name="random actions", **metadata)
    env.close()


if __name__ == "__main__":
    # Some of Hopper's episodes end and some are cut off; all of Pendulum's are cut off.
    collect("Hopper-v5", "test/hopper-v0", episodes=8, steps=25, **REFERENCES)
    collect("Pendulum-v1", "test/pendulum-v0", episodes=2, steps=20)
