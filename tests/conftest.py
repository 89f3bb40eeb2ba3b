# SPDX-License-Identifier: MIT
"""What the tests share: the three scripts as modules, a writer of small D4RL-format files, and runs as subprocesses."""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

ROOT = Path(__file__).parents[1]
DATASET = ROOT / "tests/data/halfcheetah_replay.hdf5"
sys.path.insert(0, str(ROOT))  # the scripts are no package
torch.set_num_threads(1)  # enough for networks this small, whatever else runs

import td3_bc  # noqa: E402
import wbc  # noqa: E402
import wpc  # noqa: E402

SCRIPTS = {"wpc": wpc, "td3_bc": td3_bc, "wbc": wbc}


@pytest.fixture(params=SCRIPTS)
def script(request):
    return SCRIPTS[request.param]


def d4rl_arrays(rows, obs_dim=17, action_dim=6, seed=0):
    """A dataset in D4RL's layout: random numbers, an episode's end every 10 rows, by turns terminal and timeout."""
    rng = np.random.default_rng(seed)
    end = np.arange(rows) % 10 == 9
    return {
        "observations": rng.normal(size=(rows, obs_dim)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (rows, action_dim)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "terminals": end & (np.arange(rows) // 10 % 2 == 0),
        "timeouts": end & (np.arange(rows) // 10 % 2 == 1),
    }


def write_hdf5(path, arrays):
    with h5py.File(path, "w") as file:
        for key, value in arrays.items():
            file[key] = value
    return path


def command(script, *arguments):
    """The command line of a short run on the shipped dataset; later arguments override these."""
    short = "--env halfcheetah --max-timesteps 300 --eval-freq 100 --eval-episodes 2 --log-freq 50 --device cpu".split()
    return [sys.executable, str(ROOT / f"{script}.py"), *short, "--dataset", str(DATASET), *map(str, arguments)]


def run(*line, **options):
    """The finished process of a command line, single-threaded, so that two runs agree to the last bit."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(line, capture_output=True, text=True, env=environment, timeout=300, **options)
