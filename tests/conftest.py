# SPDX-License-Identifier: MIT
"""What tests share: the scripts as modules, small datasets, and runs in processes."""

import csv
import functools
import os
import shutil
import subprocess
import sys
import time
import types
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

ROOT = Path(__file__).parents[1]
DATASET = ROOT / "tests/data/halfcheetah_replay.hdf5"
sys.path[:0] = [str(ROOT), str(ROOT / "tests/tools")]  # they are no packages
torch.set_num_threads(1)  # enough for networks this small, whatever else runs
torch.set_flush_denormal(True)  # as the scripts do

import weights  # noqa: E402

import td3_bc  # noqa: E402
import wbc  # noqa: E402
import wpc  # noqa: E402

SCRIPTS = {"wpc": wpc, "td3_bc": td3_bc, "wbc": wbc}


@pytest.fixture(params=SCRIPTS)
def script(request):
    return SCRIPTS[request.param]


@functools.cache
def wpc_with(weight):
    """wpc.py with another of the paper's weights, as a module."""
    module = types.ModuleType(f"wpc_{weight}")
    sys.modules[module.__name__] = module  # where dataclasses look it up
    exec(weights.with_weight(weight), vars(module))
    return module


def d4rl_arrays(rows, state_dim=17, action_dim=6, seed=0):
    """Random data in D4RL's layout: every tenth row ends an episode, by turns as a
    terminal and as a timeout."""
    rng = np.random.default_rng(seed)
    end = np.arange(rows) % 10 == 9
    is_terminal = np.arange(rows) // 10 % 2 == 0
    return {
        "observations": rng.normal(size=(rows, state_dim)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (rows, action_dim)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "terminals": end & is_terminal,
        "timeouts": end & ~is_terminal,
    }


def write_hdf5(path, arrays):
    with h5py.File(path, "w") as file:
        for key, value in arrays.items():
            file[key] = value
    return path


def command(script, *arguments):
    """A short run on the dataset that ships; later arguments override these."""
    line = [sys.executable, ROOT / f"{script}.py", "--env", "halfcheetah"]
    line += ["--dataset", DATASET, "--device", "cpu", "--max-timesteps", 60]
    line += ["--eval-freq", 30, "--eval-episodes", 2, *arguments]
    return [str(x) for x in line]


def environment():
    variables = os.environ | {"OMP_NUM_THREADS": "1"}  # runs agree to the last bit
    variables.pop("PYTHONUNBUFFERED", None)  # which few users set
    return variables


def run(*line, **options):
    """The finished process of a command line."""
    line = [str(x) for x in line]
    return subprocess.run(
        line, capture_output=True, text=True, env=environment(), timeout=600, **options
    )


def start(*line, **options):
    """The running process of a command line."""
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [str(x) for x in line],
        stdout=pipe,
        stderr=pipe,
        text=True,
        env=environment(),
        **options,
    )


def wait_until(condition, process):
    """Waits for a condition while a process runs."""
    end = time.time() + 600
    while not condition():
        assert process.poll() is None and time.time() < end, process.communicate()
        time.sleep(0.01)


def assert_one_sentence(process, sentence, code=1):
    """The process ended with this in one line on stderr, and nothing else there."""
    assert sentence in process.stderr, process.stderr
    assert "Traceback" not in process.stderr and process.stderr.count("\n") == 1
    assert process.returncode == code


def run_here(script, *line):
    """Runs a command line in this process, which saves the seconds of a start."""
    time.sleep(1 - time.time() % 1)  # TensorBoard's files are in order by the second
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(x) for x in line[1:]])
        script.main()


def refusal(script, *line):
    """The sentence with which a script refuses a command line."""
    with pytest.raises(SystemExit) as stop:
        run_here(script, *line)
    sentence = str(stop.value.code)
    assert type(stop.value.code) is not int and "\n" not in sentence
    return sentence


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def read_rows(run_dir):
    """The rows of evaluations.csv, without the speed, which never repeats."""
    rows = list(csv.DictReader((run_dir / "evaluations.csv").open()))
    for row in rows:
        row.pop("steps_per_second", None)
    return rows


def read_curves(run_dir):
    """TensorBoard's scalars but the speed: {tag: [(step, value), ...]}."""
    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0}).Reload()
    tags = [tag for tag in events.Tags()["scalars"] if tag != "steps_per_second"]
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in tags}


def load(run_dir):
    return torch.load(run_dir / "checkpoint.pt", weights_only=True)


def networks(agent):
    """An agent's networks, without its optimizers: {name: module}."""
    return {k: x for k, x in vars(agent).items() if isinstance(x, torch.nn.Module)}


def as_bits(value):
    """A checkpoint with its tensors as bytes, which compare to the last bit, and
    without what differs between equal runs: their paths and their speed."""
    if isinstance(value, dict):
        left_out = {"steps_per_second", "run_dir", "dataset"}
        return {key: as_bits(v) for key, v in value.items() if key not in left_out}
    if isinstance(value, list | tuple):
        return [as_bits(v) for v in value]
    if isinstance(value, torch.Tensor):
        return value.numpy().tobytes()
    return value


def result(run_dir):
    """All that a run leaves, in a form that compares to the last bit."""
    return as_bits(load(run_dir)), read_rows(run_dir), read_curves(run_dir)


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """The folder of a run of wpc.py that nothing disturbed."""
    run_dir = tmp_path_factory.mktemp("finished") / "run"
    process = run(*command("wpc", "--run-dir", run_dir))
    assert process.returncode == 0 and process.stderr == "", process.stderr
    return run_dir


@pytest.fixture
def run_dir(finished, tmp_path):
    """A copy of that folder."""
    return shutil.copytree(finished, tmp_path / "run")
