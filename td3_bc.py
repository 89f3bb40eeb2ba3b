# SPDX-License-Identifier: MIT
"""TD3+BC (Fujimoto and Gu, NeurIPS 2021), in one file.

The policy maximises Q and stays close to the dataset's actions:

    pi = argmax E[lambda * Q(s, pi(s)) - (pi(s) - a)^2]    (eq. 4)

Equations and Algorithm 1 are those of Peng, Han, Liu and Zhou, "Weighted Policy
Constraints for Offline Reinforcement Learning", AAAI 2023 (below: the paper).

    python td3_bc.py --env hopper-medium-v2
    python td3_bc.py --env halfcheetah --dataset tests/data/halfcheetah_replay.hdf5
"""

import contextlib
import copy
import csv
import fcntl
import hashlib
import io
import json
import math
import os
import pickle
import platform
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
import zipfile
import zlib
from dataclasses import asdict, dataclass
from http.client import HTTPException
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import gymnasium as gym
import h5py
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm


@dataclass
class Args:
    # Experiment
    env: str | None = None
    """D4RL task, such as hopper-medium-v2; with --dataset, also halfcheetah, hopper,
    walker2d or a Gymnasium environment, by default the one that the file names"""
    dataset: str | None = None
    """HDF5 file in D4RL's format; by default the task's, downloaded on first use"""
    seed: int = 0
    """seed of the networks, batches, noise and evaluation episodes"""
    max_timesteps: int = 1_000_000
    """number of training steps"""
    eval_freq: int = 5_000
    """evaluate and save a checkpoint every this many steps"""
    eval_episodes: int = 10
    """number of episodes in an evaluation"""
    log_freq: int = 1_000
    """log the losses to TensorBoard every this many steps"""
    device: Literal["cpu", "cuda"] = "cuda" if torch.cuda.is_available() else "cpu"
    """where to train; by default on a GPU if there is one"""
    compile: bool = False
    """compile the update, which makes a step faster, but takes a minute at first"""
    run_dir: str | None = None
    """folder to start the run in, or to continue it; by default a new one in runs/"""

    # TD3
    batch_size: int = 256
    """number of transitions in a batch"""
    discount: float = 0.99
    """discount factor gamma"""
    tau: float = 0.005
    """rate at which the target networks follow the networks"""
    policy_noise: float = 0.2
    """standard deviation of the noise on the target action, relative to max_action"""
    noise_clip: float = 0.5
    """largest noise on the target action, relative to max_action"""
    policy_freq: int = 2
    """update the policy and the target networks every this many steps"""
    actor_lr: float = 3e-4
    """learning rate of the actor"""
    critic_lr: float = 3e-4
    """learning rate of the critics"""
    normalize: bool = True
    """normalize the states to mean 0 and standard deviation 1 over the dataset"""

    # Policy constraint
    alpha: float = 2.5
    """weight of Q against the constraint"""


# --------------------------------------------------------------------------------------
# Networks
# --------------------------------------------------------------------------------------


def mlp(input_dim, output_dim):
    """Two hidden layers of 256 units with ReLU (Table 4)."""
    return nn.Sequential(
        nn.Linear(input_dim, 256),
        nn.ReLU(inplace=True),
        nn.Linear(256, 256),
        nn.ReLU(inplace=True),
        nn.Linear(256, output_dim),
    )


class Actor(nn.Module):
    """The policy pi(s): states (B, state_dim) to actions (B, action_dim)."""

    def __init__(self, state_dim, action_dim, max_action):
        super().__init__()
        self.net = mlp(state_dim, action_dim)
        self.max_action = max_action

    def forward(self, s):
        return self.max_action * torch.tanh(self.net(s))


class Critic(nn.Module):
    """Q1(s, a) and Q2(s, a), each (B, 1)."""

    def __init__(self, state_dim, action_dim):
        super().__init__()
        self.q1_net = mlp(state_dim + action_dim, 1)
        self.q2_net = mlp(state_dim + action_dim, 1)

    def forward(self, s, a):
        sa = torch.cat([s, a], dim=1)
        return self.q1_net(sa), self.q2_net(sa)

    def q1(self, s, a):
        return self.q1_net(torch.cat([s, a], dim=1))


# --------------------------------------------------------------------------------------
# Algorithm 1
# --------------------------------------------------------------------------------------


class Agent(nn.Module):
    """The networks with their optimizers, and the update of Algorithm 1."""

    def __init__(self, state_dim, action_dim, max_action, args):
        super().__init__()
        self.args = args

        self.critic = Critic(state_dim, action_dim)
        self.critic_target = copy.deepcopy(self.critic).requires_grad_(False)
        self.critic_optimizer = adam(self.critic, args.critic_lr)

        self.actor = Actor(state_dim, action_dim, max_action)
        self.actor_target = copy.deepcopy(self.actor).requires_grad_(False)
        self.actor_optimizer = adam(self.actor, args.actor_lr)

        self.optimizers = [self.critic_optimizer, self.actor_optimizer]

    def update(self, batch, step):
        """Does step `step` (1, 2, ...) of Algorithm 1 and returns its metrics by name.

        `batch` holds tensors (B, width) under the names that `load_dataset` gives them.
        """
        args, max_action = self.args, self.actor.max_action
        s, a, r = batch["observations"], batch["actions"], batch["rewards"]
        s_next, done = batch["next_observations"], batch["terminals"]

        # Target: the smaller of the two target Q-values, at a noisy next action
        with torch.no_grad():
            noise = args.policy_noise * torch.randn_like(a)
            noise = max_action * noise.clamp(-args.noise_clip, args.noise_clip)
            a_next = self.actor_target(s_next) + noise
            a_next = a_next.clamp(-max_action, max_action)
            q1_next, q2_next = self.critic_target(s_next, a_next)
            y = r + args.discount * (1 - done) * torch.min(q1_next, q2_next)

        # Critics: Q1 and Q2 fit the target
        q1, q2 = self.critic(s, a)
        critic_loss = F.mse_loss(q1, y) + F.mse_loss(q2, y)
        self.critic_optimizer.zero_grad()
        critic_loss.backward()
        self.critic_optimizer.step()
        metrics = {"q": q1.mean(), "critic_loss": critic_loss}

        if step % args.policy_freq == 0:
            # Policy: maximise Q, and stay close to the dataset's actions
            pi = self.actor(s)
            q = self.critic.q1(s, pi)
            lmbda = args.alpha / q.abs().mean().detach()
            constraint = ((pi - a) ** 2).mean()
            actor_loss = -lmbda * q.mean() + constraint  # eq. 4
            self.actor_optimizer.zero_grad()
            # With inputs, as this loss is to leave no gradient on the critics
            actor_loss.backward(inputs=list(self.actor.parameters()))
            self.actor_optimizer.step()
            metrics |= {"lmbda": lmbda, "actor_loss": actor_loss}

            # Targets: follow the critics and the actor
            soft_update(self.critic_target, self.critic, args.tau)
            soft_update(self.actor_target, self.actor, args.tau)

        return {name: metric.detach() for name, metric in metrics.items()}


def adam(network, learning_rate):
    # Fused, as it makes a training step on a CPU a tenth faster.
    return torch.optim.Adam(network.parameters(), lr=learning_rate, fused=True)


@torch.no_grad()
def soft_update(target, network, tau):
    """target <- (1 - tau) * target + tau * network"""
    parameters = zip(target.parameters(), network.parameters(), strict=True)
    for target_parameter, parameter in parameters:
        target_parameter.lerp_(parameter, tau)


# --------------------------------------------------------------------------------------
# Evaluation
# --------------------------------------------------------------------------------------

D4RL_ROBOTS = {  # -v4 is the closest to the -v2 with mujoco-py that D4RL evaluates on
    "halfcheetah": "HalfCheetah-v4",
    "hopper": "Hopper-v4",
    "walker2d": "Walker2d-v4",
}
D4RL_RETURNS = {  # which D4RL scores 0, a random policy's, and 100, an expert's
    "HalfCheetah-v4": (-280.178953, 12135.0),
    "Hopper-v4": (-20.272305, 3234.3),
    "Walker2d-v4": (1.629008, 4592.3),
}


def gymnasium_id(env):
    """Gymnasium's name for a robot or a task of D4RL; any other name is one already."""
    robot = env.split("-")[0] if env in D4RL_SHA256 else env
    return D4RL_ROBOTS.get(robot, env)


def make_envs(env, num_envs):
    """`num_envs` environments for a task, robot or Gymnasium name, stepped together.

    Exits with a sentence if there is none, or if our networks don't fit its spaces.
    """
    warnings.filterwarnings("ignore", message=".*out of date")  # -v4 is what we want
    try:
        envs = gym.make_vec(gymnasium_id(env), num_envs, vectorization_mode="sync")
    except (gym.error.Error, ImportError) as error:
        reason = str(error).split("\n")[0]
        sys.exit(f"--env {env} can't be made: {reason}")
    states, actions = envs.single_observation_space, envs.single_action_space
    for space in (states, actions):
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            sys.exit(
                f"--env {env} has the states {states} and the actions {actions}: both "
                "must be a Box of one axis"
            )
    largest = actions.high[0]
    alike = (actions.high == largest).all() and (actions.low == -largest).all()
    if not alike or np.isinf(largest):
        sys.exit(
            f"--env {env} has the actions {actions}: all must go from -x to x with the "
            "same x, which Gymnasium's RescaleAction can bring about"
        )
    return envs


def normalized_score(returns, env):
    """D4RL's score of these returns: 0 for a random policy's, 100 for an expert's."""
    random_return, expert_return = D4RL_RETURNS[gymnasium_id(env)]
    return 100 * (returns - random_return) / (expert_return - random_return)


@torch.no_grad()
def evaluate(envs, actor, mean, std, seed):
    """Plays an episode in each of `envs` at once; returns their returns (num_envs,).

    `mean` and `std`, tensors (state_dim,), normalize the observations as in training.
    """
    # Environment i gets this plus i as its seed, so no two seeds share an episode.
    observations, _ = envs.reset(seed=1000 * (seed + 100))
    returns = np.zeros(envs.num_envs)
    running = np.ones(envs.num_envs, dtype=bool)
    while running.any():
        states = torch.as_tensor(observations, dtype=torch.float32, device=mean.device)
        actions = actor((states - mean) / std).cpu().numpy()
        observations, rewards, terminated, truncated, _ = envs.step(actions)
        returns += rewards * running  # what follows the first episode does not count
        running &= ~(terminated | truncated)
    return returns


# --------------------------------------------------------------------------------------
# Dataset
# --------------------------------------------------------------------------------------

D4RL_SERVERS = (
    "http://rail.eecs.berkeley.edu/datasets/offline_rl/gym_mujoco_v2/",  # often down
    "https://huggingface.co/datasets/imone/D4RL/resolve/main/",  # a copy of its files
)
D4RL_SHA256 = {  # the first digits for each task's file
    "halfcheetah-random-v2": "25407aef85b5d16c",
    "halfcheetah-medium-v2": "41324e8487a9556d",
    "halfcheetah-medium-replay-v2": "48d494a4770c11f4",
    "halfcheetah-full-replay-v2": "27fdf7ea86e5a2cb",
    "halfcheetah-medium-expert-v2": "015db75dae5bbe8e",
    "halfcheetah-expert-v2": "d9fe53bb994eb1e2",
    "hopper-random-v2": "63103ef7059db4c0",
    "hopper-medium-v2": "5bdf1bc4a713c829",
    "hopper-medium-replay-v2": "e121c5f7c9857a30",
    "hopper-full-replay-v2": "56baf95963c51c1e",
    "hopper-medium-expert-v2": "9d51ad87f8c905be",
    "hopper-expert-v2": "01aa219a5f8eea5e",
    "walker2d-random-v2": "4e863bb6090cf4a4",
    "walker2d-medium-v2": "cf00f43add04c17f",
    "walker2d-medium-replay-v2": "e75de96a4f77acf7",
    "walker2d-full-replay-v2": "f2720f9d27b2acef",
    "walker2d-medium-expert-v2": "6b8d7f868c45bbae",
    "walker2d-expert-v2": "2985dc3d436a8baa",
}


def download_dataset(task):
    """The path of D4RL's file for `task`, downloaded if d4rl's folder has none.

    Exits with a sentence if no server has it.
    """
    folder = os.environ.get("D4RL_DATASET_DIR") or Path.home() / ".d4rl/datasets"
    name = task.removesuffix("-v2").replace("-", "_") + "-v2.hdf5"
    path = Path(folder, name).absolute()
    if path.exists():
        return path
    problems = []
    socket.setdefaulttimeout(30)  # seconds that a server may be silent
    for server in D4RL_SERVERS:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(server + name, path, D4RL_SHA256[task])
            return path
        except (OSError, HTTPException, RuntimeError) as error:  # RuntimeError: SHA-256
            problems.append(f"{server}: {error}")
    sys.exit(
        f"{path} could not be downloaded ({'; '.join(problems)}): put D4RL's file "
        "there, or name one with --dataset (the project comes with "
        "--env halfcheetah --dataset tests/data/halfcheetah_replay.hdf5)"
    )


@contextlib.contextmanager
def exit_if_damaged(path):
    """Exits with a sentence where an HDF5 file can't be read."""
    try:
        yield
    except (KeyError, OSError, RuntimeError, TypeError, ValueError) as error:
        sys.exit(
            f"{path} is no HDF5 file in D4RL's format, or is damaged ({error}); if it "
            "is a download of D4RL's, delete it to download it again"
        )


def read_env_id(path):
    """The Gymnasium environment that a dataset was collected on, None if it is silent.

    It is the file's attribute "env_id", which D4RL's files don't have.
    """
    with exit_if_damaged(path), h5py.File(path) as file:
        return file.attrs.get("env_id")


def read_hdf5(path, widths):
    """Arrays of an HDF5 file, float32 (N, width), for the widths given by name.

    Exits with a sentence if one is missing, of another shape or not finite.
    """
    arrays = {}
    with exit_if_damaged(path), h5py.File(path) as file:
        for key, width in widths.items():
            if key not in file:
                sys.exit(f"{path} has no '{key}'")
            array = file[key][:]
            if array.ndim == 1:
                array = array[:, None]
            shape = (len(file["observations"]), width)
            if array.shape != shape:
                sys.exit(f"{path}: '{key}' has shape {array.shape}, not {shape}")
            with np.errstate(over="ignore"):  # beyond float32, numbers are infinite
                arrays[key] = array.astype(np.float32)
            if not np.isfinite(arrays[key]).all():
                sys.exit(f"{path}: '{key}' holds NaN or infinite numbers")
    return arrays


def load_dataset(path, state_dim, action_dim, args):
    """The transitions of an HDF5 file in D4RL's format, as in d4rl.qlearning_dataset.

    Row i gives the transition (o[i], a[i], r[i], o[i + 1], terminal[i]). The last row
    gives none, nor does one with a timeout: its o[i + 1] is in the next episode.

    Returns the transitions by name, float32 tensors (N, width), and the discounted
    return of each episode (episodes,).
    """
    widths = {"observations": state_dim, "actions": action_dim}
    widths |= {"rewards": 1, "terminals": 1, "timeouts": 1}
    arrays = read_hdf5(path, widths)
    timeouts = arrays.pop("timeouts")[:, 0] != 0
    keep = np.flatnonzero(~timeouts[:-1])
    if len(keep) < args.batch_size:
        sys.exit(
            f"{path} has {len(keep)} transitions, too few for --batch-size "
            f"{args.batch_size}"
        )
    transitions = {key: array[keep] for key, array in arrays.items()}
    transitions["next_observations"] = arrays["observations"][keep + 1]

    ends = arrays["terminals"][:, 0] != 0
    ends[:-1] &= ~timeouts[1:]  # such a row may follow, with the last observation
    ends |= timeouts
    rewards = arrays["rewards"][:, 0].astype(np.float64)
    episodes = np.split(rewards, np.flatnonzero(ends[:-1]) + 1)
    discounted_returns = np.array(
        [episode @ args.discount ** np.arange(len(episode)) for episode in episodes]
    )
    dataset = {name: torch.from_numpy(array) for name, array in transitions.items()}
    return dataset, discounted_returns


def normalize_states(transitions):
    """Normalizes the states in place; returns their mean and std, each (state_dim,)."""
    states = transitions["observations"].double()
    mean = states.mean(dim=0).float()
    std = states.std(dim=0, correction=0).float() + 1e-3
    transitions["observations"].sub_(mean).div_(std)
    transitions["next_observations"].sub_(mean).div_(std)
    return mean, std


def sample_batch(dataset, batch_size):
    """A batch of transitions, drawn uniformly and with replacement."""
    rewards = dataset["rewards"]
    indices = torch.randint(len(rewards), (batch_size,), device=rewards.device)
    return {name: column[indices] for name, column in dataset.items()}


# --------------------------------------------------------------------------------------
# Run folder
# --------------------------------------------------------------------------------------

SCRIPT = Path(__file__).stem


def write_file(path, content):
    """Writes `content` (bytes) whole or not at all, even if the power fails."""
    temporary = path.with_name(path.name + ".tmp")
    with open(temporary, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


@contextlib.contextmanager
def exit_if_unwritable():
    """Exits with a sentence where the run folder can't be written."""
    try:
        yield
    except OSError as error:
        sys.exit(
            f"the run folder can't be written ({error}): what was saved before is "
            "intact; free some space, or choose another --run-dir"
        )


@exit_if_unwritable()
def open_run_dir(args):
    """Makes and locks the run folder; returns its path and the lock, to be kept open.

    Exits with a sentence if it can't be written or another process trains in it.
    """
    dataset = Path(args.dataset).stem if args.dataset else args.env
    started = f"{time.strftime('%Y-%m-%d_%H-%M-%S')}_{os.getpid()}"
    name = f"{dataset}__{SCRIPT}__{args.seed}__{started}"
    run_dir = Path(args.run_dir or f"runs/{name}")
    run_dir.mkdir(parents=True, exist_ok=True)
    lock = open(run_dir / "lock", "a")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # until this process ends
    except BlockingIOError:
        sys.exit(f"{run_dir} is in use by another process")
    return run_dir, lock


def git_commit():
    """The commit of the repository that this script is in; None if there is none."""
    line = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    folder = Path(__file__).parent
    try:
        process = subprocess.run(line, cwd=folder, capture_output=True, text=True)
    except OSError:  # git is not installed
        return None
    return process.stdout.strip() or None


@exit_if_unwritable()
def record_start(run_dir, step, dataset_sha256, best_return):
    """Adds a line to provenance.jsonl: from `step` on, what makes the results."""
    start = {
        "step": step,
        "script_sha256": hashlib.sha256(Path(__file__).read_bytes()).hexdigest(),
        "commit": git_commit(),
        "dataset_sha256": dataset_sha256,
        "best_discounted_return": best_return,
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
    }
    for package in ("torch", "gymnasium", "mujoco", "numpy"):
        start[package] = version(package)
    with open(run_dir / "provenance.jsonl", "a") as file:
        file.write(json.dumps(start) + "\n")


class Logger:
    """TensorBoard's curves, and the rows of evaluations.csv."""

    @exit_if_unwritable()
    def __init__(self, run_dir, args, step, evaluations):
        """Writes the arguments; the curves are continued after `step`."""
        self.env = args.env
        self.evaluations = evaluations
        self.clock, self.clock_step = time.perf_counter(), step

        arguments = json.dumps(asdict(args), indent=2)
        write_file(run_dir / "args.json", arguments.encode())
        self.writer = SummaryWriter(run_dir, purge_step=step + 1)
        self.writer.add_text("args", f"<pre>{arguments}</pre>", step)

    @exit_if_unwritable()
    def add_scalars(self, prefix, scalars, step):
        for name, scalar in scalars.items():
            self.writer.add_scalar(f"{prefix}/{name}", scalar, step)
        self.writer.flush()

    def log_metrics(self, metrics, step):
        """Logs the metrics of this step, and the speed since the last time."""
        self.metrics = {name: metric.item() for name, metric in metrics.items()}
        seconds = time.perf_counter() - self.clock
        self.metrics["steps_per_second"] = (step - self.clock_step) / seconds
        self.clock, self.clock_step = time.perf_counter(), step
        self.add_scalars("train", self.metrics, step)

    def log_evaluation(self, returns, step):
        """Logs the episodes' returns, and adds them to the rows with the metrics."""
        name, scores = "mean_return", returns
        if gymnasium_id(self.env) in D4RL_RETURNS:
            name, scores = "normalized_score", normalized_score(returns, self.env)
        score = scores.mean().item()
        row = {
            "step": step,
            name: score,
            "std_over_episodes": scores.std().item(),
            "returns": " ".join(f"{x:.2f}" for x in returns),
        }
        self.evaluations.append(row | self.metrics)
        self.add_scalars("eval", {name: score}, step)
        tqdm.write(f"step {step:,}: {name.replace('_', ' ')} {score:.2f}")
        self.clock = time.perf_counter()  # leaves out the time of evaluation


@exit_if_unwritable()
def save(run_dir, checkpoint):
    """Writes checkpoint.pt and, from the evaluations in it, evaluations.csv."""
    table = io.StringIO()
    rows = checkpoint["evaluations"]
    columns = rows[-1].keys() if rows else ["step"]
    writer = csv.DictWriter(table, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    content = io.BytesIO()  # torch.save to a full disk would fail with a RuntimeError
    torch.save(checkpoint, content)
    write_file(run_dir / "evaluations.csv", table.getvalue().encode())
    write_file(run_dir / "checkpoint.pt", content.getvalue())


def load_checkpoint(run_dir):
    """The checkpoint of a run folder on the CPU; None if there is none yet.

    Runs no code that is in the file. Exits with a sentence if it can't be loaded.
    """
    path = Path(run_dir, "checkpoint.pt")
    if not path.exists():
        return None
    try:
        if zipfile.ZipFile(path).testzip():  # as torch.load checks no checksums
            sys.exit(f"{path} is damaged: a checksum in it is wrong")
        return torch.load(path, map_location="cpu", weights_only=True)
    except (
        EOFError,
        OSError,
        RuntimeError,
        ValueError,
        pickle.UnpicklingError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        reason = str(error).split("\n")[0]
        sys.exit(f"{path} can't be loaded ({type(error).__name__}: {reason})")


# --------------------------------------------------------------------------------------
# Arguments
# --------------------------------------------------------------------------------------

LIMITS = {
    "seed": (0, 1_000_000),
    "max_timesteps": (1, 1_000_000_000),
    "eval_freq": (1, 1_000_000_000),
    "eval_episodes": (1, 1_000),
    "log_freq": (1, 1_000_000_000),
    "batch_size": (1, 1_000_000_000),
    "discount": (0, 1),
    "tau": (0, 1),
    "policy_noise": (0, 1_000),
    "noise_clip": (0, 1_000),
    "policy_freq": (1, 1_000_000_000),
    "actor_lr": (0, 1_000_000),
    "critic_lr": (0, 1_000_000),
    "alpha": (0, 1_000_000),
}


def check_args(args):
    """Exits with a sentence if an argument is unknown, impossible or out of range."""
    if args.dataset is None and args.env not in D4RL_SHA256:
        tasks = ", ".join(D4RL_SHA256)
        sys.exit(
            f"--env is {args.env}: name a D4RL task ({tasks}), or a file with --dataset"
        )
    if args.dataset is not None and not Path(args.dataset).is_file():
        sys.exit(f"--dataset {args.dataset} is no file: name one in D4RL's HDF5 format")
    if args.device == "cuda" and not torch.cuda.is_available():
        sys.exit("--device cuda needs a GPU, and there is none: try --device cpu")
    if args.device == "cuda" and args.compile:
        sys.exit("--compile is for CPUs, and untried on a GPU: add --device cpu")
    for name, (low, high) in LIMITS.items():
        value = getattr(args, name)
        if value is not None and not low <= value <= high:
            flag = name.replace("_", "-")
            sys.exit(f"--{flag} is {value}, but must be from {low} to {high}")


CHANGEABLE = {"max_timesteps", "dataset", "device", "compile", "run_dir"}


def parse_args():
    """The arguments on the command line; a run that is continued keeps its own."""
    args = tyro.cli(Args, description=__doc__)
    path = Path(args.run_dir or "", "args.json")
    if args.run_dir and path.exists():
        try:
            saved = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            sys.exit(f"{path} can't be read ({error}): choose another --run-dir")
        if saved.keys() != asdict(args).keys():
            sys.exit(
                f"{path} is of another script, or another version of {SCRIPT}.py: "
                "continue the run with that, or choose another --run-dir"
            )
        args = tyro.cli(Args, default=Args(**saved), description=__doc__)
        for name in saved.keys() - CHANGEABLE:
            if getattr(args, name) != saved[name]:
                sys.exit(
                    f"the run in {args.run_dir} has {name} = {saved[name]}: "
                    "keep it, or choose another --run-dir"
                )
    check_args(args)
    if args.dataset:
        args.dataset = str(Path(args.dataset).absolute())
        env_id = read_env_id(args.dataset)
        args.env = args.env or env_id
        if args.env is None:
            sys.exit(f"{args.dataset} names no environment: add --env")
        if env_id and env_id != gymnasium_id(args.env):
            print(f"warning: {args.dataset} is from {env_id}, --env is {args.env}")
    return args


# --------------------------------------------------------------------------------------
# Compilation
# --------------------------------------------------------------------------------------


class TraceableAdam:
    """Stands in for a torch.optim.Adam, on its state, where torch.compile traces it."""

    def __init__(self, optimizer):
        group = optimizer.param_groups[0]
        self.parameters = group["params"]
        self.lr, self.betas, self.eps = group["lr"], group["betas"], group["eps"]
        self.states = [optimizer.state[parameter] for parameter in self.parameters]
        for parameter, state in zip(self.parameters, self.states, strict=True):
            if not state:  # as Adam begins
                state["step"] = torch.tensor(0.0)
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
        # Multiplied as in `step`, as beta**t differs by rounding, and in float64
        t = int(self.states[0]["step"])
        self.beta1_power, self.beta2_power = (
            torch.tensor(math.prod([beta] * t), dtype=torch.float64)
            for beta in self.betas
        )

    def zero_grad(self):
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self):
        beta1, beta2 = self.betas
        self.beta1_power *= beta1
        self.beta2_power *= beta2
        step_size = self.lr / (1 - self.beta1_power)
        bias_correction = 1 - self.beta2_power
        for parameter, state in zip(self.parameters, self.states, strict=True):
            m, v, gradient = state["exp_avg"], state["exp_avg_sq"], parameter.grad
            state["step"] += 1
            m.lerp_(gradient, 1 - beta1)
            v.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
            parameter -= step_size * m / ((v / bias_correction).sqrt() + self.eps)


def compile_update(agent):
    """`agent.update`, each step of it one graph; it draws the same random numbers."""
    torch._dynamo.config.trace_autograd_ops = True  # lets backward() into the graph
    for name, optimizer in list(vars(agent).items()):
        if isinstance(optimizer, torch.optim.Adam):
            setattr(agent, name, TraceableAdam(optimizer))
    options = {"cpp_wrapper": True, "fallback_random": True}
    update = torch.compile(agent.update, fullgraph=True, dynamic=False, options=options)
    # One graph for the steps that update the policy, one for all the others.
    policy_freq = agent.args.policy_freq
    return lambda batch, step: update(batch, 1 if step % policy_freq else policy_freq)


# --------------------------------------------------------------------------------------
# Training
# --------------------------------------------------------------------------------------


def check_finite(agent, metrics, step):
    """Exits if a metric or a parameter is NaN or infinite; nothing is overwritten."""
    tensors = [*metrics.values(), *agent.parameters()]
    if not all(tensor.isfinite().all() for tensor in tensors):
        sys.exit(
            f"diverged by step {step}: the losses or the networks are no longer "
            "finite; the last checkpoint is kept"
        )


def training_state(agent):
    """All that the next steps depend on, but the data."""
    return {
        "networks": agent.state_dict(),
        "optimizers": [optimizer.state_dict() for optimizer in agent.optimizers],
        "rng_state": torch.get_rng_state(),
        "cuda_rng_states": torch.cuda.get_rng_state_all(),
    }


def resume(agent, run_dir, dataset_sha256):
    """Puts the agent and the random numbers where the run folder's checkpoint has them.

    Returns its step, metrics and evaluations; step 0 if there is no checkpoint yet.
    Exits with a sentence if it can't be loaded, or is of another dataset.
    """
    checkpoint = load_checkpoint(run_dir)
    if checkpoint is None:
        return 0, {}, []
    if checkpoint["dataset_sha256"] != dataset_sha256:
        sys.exit(f"{run_dir} began with another dataset: name that one with --dataset")
    agent.load_state_dict(checkpoint["networks"])
    states = checkpoint["optimizers"]
    for optimizer, state in zip(agent.optimizers, states, strict=True):
        optimizer.load_state_dict(state)
    torch.set_rng_state(checkpoint["rng_state"])
    torch.cuda.set_rng_state_all(checkpoint["cuda_rng_states"])
    return checkpoint["step"], checkpoint["metrics"], checkpoint["evaluations"]


def q_runs_away(q, best_discounted_return):
    """Whether Q is well above what the dataset shows to be possible."""
    return q > 1.2 * abs(best_discounted_return)


def catch_stop_signals():
    """A list that SIGINT (Ctrl-C) and SIGTERM are added to, instead of stopping us."""
    stop_signals = []

    def request_stop(signal_number, frame):
        stop_signals.append(signal_number)
        signal.signal(signal_number, signal.SIG_DFL)  # a second one acts at once

    signal.signal(signal.SIGINT, request_stop)
    signal.signal(signal.SIGTERM, request_stop)
    return stop_signals


def train(args):
    """Trains from the start, or continues the run that is in the run folder."""
    envs = make_envs(args.env, args.eval_episodes)
    state_dim = envs.single_observation_space.shape[0]
    action_dim = envs.single_action_space.shape[0]
    max_action = float(envs.single_action_space.high[0])

    path = args.dataset or download_dataset(args.env)
    dataset, discounted_returns = load_dataset(path, state_dim, action_dim, args)
    best_return = discounted_returns.max()
    mean, std = torch.zeros(state_dim), torch.ones(state_dim)
    if args.normalize:
        mean, std = normalize_states(dataset)
    mean, std = mean.to(args.device), std.to(args.device)
    dataset = {name: column.to(args.device) for name, column in dataset.items()}

    torch.manual_seed(args.seed)
    agent = Agent(state_dim, action_dim, max_action, args).to(args.device)
    torch.manual_seed(args.seed)  # again: the batches depend on no network

    run_dir, _lock = open_run_dir(args)
    sha256 = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    step, metrics, evaluations = resume(agent, run_dir, sha256)

    def save_checkpoint():
        check_finite(agent, metrics, step)
        run = {"step": step, "metrics": metrics, "evaluations": evaluations}
        data = {"mean": mean, "std": std, "dataset_sha256": sha256}
        save(run_dir, training_state(agent) | run | data)

    num_transitions, num_episodes = len(dataset["rewards"]), len(discounted_returns)
    print(f"dataset  {path}")
    print(f"         {num_transitions:,} transitions in {num_episodes:,} episodes")
    print(f"run      {run_dir}, from step {step:,}, on {args.device}")
    update = agent.update
    if args.compile:
        print("compiling, which takes about a minute and pays from 20,000 steps on")
        update = compile_update(agent)
    record_start(run_dir, step, sha256, best_return)
    logger = Logger(run_dir, args, step, evaluations)
    stop_signals = catch_stop_signals()
    warned = False
    with tqdm(initial=step, total=args.max_timesteps, disable=None) as progress:
        while step < args.max_timesteps and not stop_signals:
            step += 1
            batch = sample_batch(dataset, args.batch_size)
            metrics |= update(batch, step)
            progress.update()

            eval_is_due = step % args.eval_freq == 0 or step == args.max_timesteps
            if eval_is_due or step % args.log_freq == 0:
                check_finite(agent, metrics, step)
                logger.log_metrics(metrics, step)
                if q_runs_away(metrics["q"], best_return) and not warned:
                    warned = True
                    tqdm.write(
                        f"step {step:,}: Q is over 1.2 times the dataset's best "
                        f"discounted return, {best_return:.0f}, and may be running "
                        "away: unless the policy does far better than the data, train "
                        "again with a smaller --alpha"
                    )
            if eval_is_due:
                returns = evaluate(envs, agent.actor, mean, std, args.seed)
                logger.log_evaluation(returns, step)
                save_checkpoint()

    if stop_signals:
        save_checkpoint()
        print(f"stopped at step {step:,}; to continue:")
        print(f"    python {SCRIPT}.py --run-dir {run_dir}")
        sys.exit(128 + stop_signals[0])
    print(f"finished at step {step:,}: see {run_dir}/evaluations.csv")


def hide_write_errors(failure):
    """Prints no traceback where TensorBoard's thread can't write; the logger tells."""
    if not issubclass(failure.exc_type, OSError):
        threading.__excepthook__(failure)


def main():
    sys.stdout.reconfigure(line_buffering=True)  # a log file is always up to date
    threading.excepthook = hide_write_errors
    torch.set_flush_denormal(True)  # a CPU takes far longer for numbers below 1e-38
    try:
        train(parse_args())
    except KeyboardInterrupt:
        sys.exit("interrupted before the first step")
    except (MemoryError, RuntimeError) as error:
        reason = str(error).split("\n")[0]
        # On a GPU PyTorch raises OutOfMemoryError, on a CPU only its text tells.
        memory_errors = (MemoryError, torch.OutOfMemoryError)
        if isinstance(error, memory_errors) or "can't allocate" in reason:
            sys.exit("out of memory: try a smaller --batch-size, or a smaller dataset")
        if isinstance(error, torch._dynamo.exc.BackendCompilerFailed):
            sys.exit(
                f"--compile failed ({reason}): it needs a C++ compiler; training works "
                "without --compile, too"
            )
        raise


if __name__ == "__main__":
    main()
