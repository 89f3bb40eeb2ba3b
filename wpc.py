# SPDX-License-Identifier: MIT
"""wPC: weighted policy constraints for offline reinforcement learning, in one file.

The policy maximises Q, and a constraint draws it to the dataset's actions:

    pi = argmax E[lambda * Q(s, pi(s)) - w(s, a) * (pi(s) - a)^2]         (eq. 6)
    w(s, a) = 1 if Q(s, a) > V(s), so a is better than average, else 0    (eq. 7)

Equations and Algorithm 1 are those of Peng, Han, Liu and Zhou, "Weighted Policy
Constraints for Offline Reinforcement Learning", AAAI 2023.

    python wpc.py --env hopper-medium-v2 --alpha 2.5
    python wpc.py --env halfcheetah --dataset tests/data/halfcheetah_replay.hdf5
"""

import json
import os
import re
import sys
from copy import deepcopy
from csv import DictWriter
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from hashlib import sha256
from io import BytesIO, StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from urllib.request import urlopen

import gymnasium as gym
import h5py
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from torch.utils.tensorboard import SummaryWriter

os.environ.pop("MUJOCO_GL", None)  # names a drawing library, which may be missing
import mujoco

SCRIPT = Path(globals().get("__file__", os.devnull))  # in a notebook: an empty file


class UserError(Exception):
    """A failure that main() prints as one sentence. Wrong Args raise ValueError."""


@dataclass
class Args:
    # Experiment
    env: str = "hopper-medium-v2"
    """D4RL task; with --dataset also D4RL's robot (hopper, ...) or a Gymnasium id"""
    dataset: str = ""
    """HDF5 file in D4RL's format; by default the task's, downloaded on first use"""
    seed: int = 0
    """seed of the networks, batches, noise and evaluation episodes"""
    max_timesteps: int = 1_000_000
    """number of training steps"""
    eval_freq: int = 5_000
    """number of steps between evaluations; each logs and saves a checkpoint"""
    eval_episodes: int = 10
    """number of episodes in an evaluation"""
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    """where to train: cpu, cuda, cuda:1, ...; by default on a GPU if there is one"""
    run_dir: str = ""
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
    """number of steps between updates of the policy and the target networks"""
    actor_lr: float = 3e-4
    """learning rate of the actor"""
    critic_lr: float = 3e-4
    """learning rate of the critics"""
    value_lr: float = 3e-4
    """learning rate of the value network"""

    # Policy constraint
    alpha: float | None = None
    """weight of Q; by default 0.1 if --env names medium-expert, otherwise 2.5"""

    def __post_init__(self):
        if self.alpha is None:
            self.alpha = 0.1 if "medium-expert" in self.env else 2.5
        if not self.run_dir:
            name = f"{Path(self.dataset or self.env).stem}__{SCRIPT.stem}__{self.seed}"
            self.run_dir = f"runs/{name}__{datetime.now():%Y-%m-%d_%H-%M-%S.%f}"
        counts = self.eval_freq, self.eval_episodes, self.batch_size, self.policy_freq
        if min(counts) < 1 or not (0 <= self.discount <= 1 and 0 <= self.tau <= 1):
            raise ValueError(
                "eval_freq, eval_episodes, batch_size and policy_freq must be at least "
                "1, discount and tau from 0 to 1"
            )
        try:
            torch.zeros(1, device=self.device)
        except Exception as error:  # of several types
            raise ValueError(f"no --device {self.device} here; cpu works") from error


# --- Networks -------------------------------------------------------------------------


class MLP(nn.Sequential):
    """Two hidden layers of 256 units with ReLU (Table 4)."""

    def __init__(self, input_dim, output_dim):
        layers = [nn.Linear(input_dim, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU()]
        super().__init__(*layers, nn.Linear(256, output_dim))

    def forward(self, *inputs):
        return super().forward(torch.cat(inputs, -1))


class Actor(MLP):
    """The policy pi(s): states (B, state_dim) to actions (B, action_dim)."""

    def __init__(self, state_dim, action_dim, max_action):
        super().__init__(state_dim, action_dim)
        self.max_action = max_action

    def forward(self, s):
        return self.max_action * torch.tanh(super().forward(s))


class Critic(nn.Module):
    """Q1(s, a) and Q2(s, a), each (B, 1)."""

    def __init__(self, state_dim, action_dim):
        super().__init__()
        self.q1 = MLP(state_dim + action_dim, 1)
        self.q2 = MLP(state_dim + action_dim, 1)

    def forward(self, s, a):
        return self.q1(s, a), self.q2(s, a)


class Value(MLP):
    """V(s): (B, 1)."""

    def __init__(self, state_dim):
        super().__init__(state_dim, 1)


# --- Algorithm 1 ----------------------------------------------------------------------

Adam = partial(torch.optim.Adam, fused=True)  # makes a step on a CPU 10% faster


class Agent:
    """Algorithm 1. A checkpoint holds the state_dict() of each attribute but `args`."""

    def __init__(self, state_dim, action_dim, max_action, args):
        self.args = args
        self.critic = Critic(state_dim, action_dim).to(args.device)
        self.critic_target = deepcopy(self.critic)
        self.critic_optimizer = Adam(self.critic.parameters(), args.critic_lr)

        self.actor = Actor(state_dim, action_dim, max_action).to(args.device)
        self.actor_target = deepcopy(self.actor)
        self.actor_optimizer = Adam(self.actor.parameters(), args.actor_lr)

        self.value = Value(state_dim).to(args.device)
        self.value_optimizer = Adam(self.value.parameters(), args.value_lr)

    def update(self, batch, step):
        """Does step `step` of Algorithm 1, counted from 1, and returns its metrics.

        `batch` has tensors (B, width); rewards and terminals have width 1.
        """
        args, max_action = self.args, self.actor.max_action
        s, a, r = batch["observations"], batch["actions"], batch["rewards"]
        s_next, done = batch["next_observations"], batch["terminals"]

        # Target: the smaller of the two target Q-values, at a noisy next action
        with torch.no_grad():
            noise = args.policy_noise * torch.randn_like(a)
            noise = max_action * noise.clamp(-args.noise_clip, args.noise_clip)
            a_next = (self.actor_target(s_next) + noise).clamp(-max_action, max_action)
            q1_next, q2_next = self.critic_target(s_next, a_next)
            y = r + args.discount * (1 - done) * torch.min(q1_next, q2_next)

        # Critics: Q1 and Q2 fit the target
        q1, q2 = self.critic(s, a)
        assert y.shape == q1.shape, "rewards and terminals must be (B, 1)"
        critic_loss = F.mse_loss(q1, y) + F.mse_loss(q2, y)
        self.critic_optimizer.zero_grad()
        critic_loss.backward()
        self.critic_optimizer.step()
        metrics = {"q": q1.mean(), "critic_loss": critic_loss}

        # Value: V(s) fits the same target, so it averages Q over the dataset's actions
        v = self.value(s)
        value_loss = F.mse_loss(v, y)
        self.value_optimizer.zero_grad()
        value_loss.backward()
        self.value_optimizer.step()
        metrics |= {"v": v.mean(), "value_loss": value_loss}

        if step % args.policy_freq == 0:
            # Weight: 1 where the dataset's action is better than average, else 0
            with torch.no_grad():
                advantage = self.critic.q1(s, a) - self.value(s)
                weight = (advantage > 0).float()  # eq. 7

            # Policy: maximise Q under the constraint
            pi = self.actor(s)
            q_pi = self.critic.q1(s, pi)
            # The paper divides by mean Q, which would minimise Q where it is negative.
            # Its authors' code has mean |Q|, and averages over action dimensions, too.
            lmbda = args.alpha / q_pi.abs().mean().detach()
            constraint = (weight * (pi - a) ** 2).mean()
            actor_loss = -lmbda * q_pi.mean() + constraint  # eq. 6, to be minimised
            self.actor_optimizer.zero_grad()
            actor_loss.backward()
            self.actor_optimizer.step()
            metrics |= {"lmbda": lmbda, "actor_loss": actor_loss}
            metrics["weight"] = weight.mean()

            # Targets: follow the critics and the actor
            soft_update(self.critic_target, self.critic, args.tau)
            soft_update(self.actor_target, self.actor, args.tau)

        return metrics


@torch.no_grad()
def soft_update(target, network, tau):
    """target <- (1 - tau) * target + tau * network"""
    for old, new in zip(target.parameters(), network.parameters(), strict=True):
        old.lerp_(new, tau)


# --- Evaluation -----------------------------------------------------------------------

D4RL_ROBOTS = {  # Gymnasium's name, and the returns that D4RL scores 0 and 100
    "halfcheetah": ("HalfCheetah-v4", -280.178953, 12135.0),
    "hopper": ("Hopper-v4", -20.272305, 3234.3),
    "walker2d": ("Walker2d-v4", 1.629008, 4592.3),
}
D4RL_TASK = re.compile(
    "(halfcheetah|hopper|walker2d)-"
    "(random|medium-replay|full-replay|medium-expert|medium|expert)(-v2)?"
)


def d4rl_robot(env):  # for hopper or hopper-medium-v2; None for Hopper-v4
    return D4RL_ROBOTS.get(D4RL_TASK.sub(r"\1", env))  # a task becomes its robot


def use_d4rl_physics(env):
    """Makes a -v4 robot move as in MuJoCo 2.0, with which D4RL was recorded.

    A capsule then had the mass and inertia of a cylinder: as thick, and half a radius
    longer at each end than the capsule's straight part.
    """
    model = env.unwrapped.model
    spec = mujoco.MjSpec.from_file(env.unwrapped.fullpath)
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE:
            capsule = model.geom(geom.name)
            geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
            geom.size = np.add(capsule.size, [0, capsule.size[0] / 2, 0])
            geom.pos = capsule.pos
            geom.quat = capsule.quat
            geom.fromto = [np.nan] * 6  # if set, it would override size, pos and quat
    cylinders = spec.compile()  # only for its masses: contacts stay the capsules'
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        getattr(model, name)[:] = getattr(cylinders, name)
    # Since 3.5.0 (3005000 here) the margins of two geoms in contact are added; before,
    # the larger counted. Of D4RL's robots only Hopper has any, all equal: halve them.
    if mujoco.mj_version() >= 3005000:
        model.geom_margin /= 2
    mujoco.mj_setConst(model, env.unwrapped.data)  # recompute what masses determine
    return env


def make_envs(env, num_envs):
    """`num_envs` environments for a task, robot or Gymnasium id, stepped together."""
    robot = d4rl_robot(env)
    name = gym.spec(robot[0]) if robot else env  # a spec: no warning that v4 is old
    wrappers = [use_d4rl_physics] if robot else None
    envs = gym.make_vec(name, num_envs, vectorization_mode="sync", wrappers=wrappers)
    states, actions = envs.single_observation_space, envs.single_action_space
    if not (
        type(states) is type(actions) is gym.spaces.Box
        and len(states.shape) == len(actions.shape) == 1
        and np.ptp([-actions.low, actions.high]) == 0  # bounds are -x and x, with one x
        and envs.spec.max_episode_steps
    ):
        raise UserError(
            f"--env {env} needs one-dimensional Boxes of states (has {states}) and of "
            f"actions from -x to x (has {actions}), and a time limit"
        )
    return envs


@torch.no_grad()
def evaluate(envs, actor, mean, std, args):
    """Plays an episode in each of `envs`; returns mean, deviation and D4RL's score."""
    # Always the same start states: environment i gets this + i. Runs lie 1000 apart.
    observations, _ = envs.reset(seed=1000 * (args.seed + 100))  # 100 as in TD3+BC
    returns = np.zeros(envs.num_envs)
    running = returns == 0  # all of them
    while running.any():
        states = torch.as_tensor(observations).to(mean)  # as float32, on its device
        actions = actor((states - mean) / std).cpu().numpy()
        observations, rewards, terminated, truncated, _ = envs.step(actions)
        returns += rewards * running  # what follows the first episode does not count
        running &= ~(terminated | truncated)
    row = {"mean_return": returns.mean().item(), "std_return": returns.std().item()}
    if robot := d4rl_robot(args.env):
        _, low, high = robot
        row["normalized_score"] = 100 * (row["mean_return"] - low) / (high - low)
    return row


# --- Dataset --------------------------------------------------------------------------

D4RL_SERVERS = (
    "http://rail.eecs.berkeley.edu/datasets/offline_rl/gym_mujoco_v2/",  # often down
    "https://huggingface.co/datasets/imone/D4RL/resolve/main/",  # a copy of its files
)


def download_dataset(task):
    """Path of a task's D4RL file, downloaded unless it is in d4rl's folder."""
    if not D4RL_TASK.fullmatch(task):
        raise UserError(f"without --dataset, --env must be {D4RL_TASK.pattern}")
    name = task.removesuffix("-v2").replace("-", "_") + "-v2.hdf5"
    folder = os.environ.get("D4RL_DATASET_DIR", "~/.d4rl/datasets")
    path = Path(os.path.expanduser(folder), name)
    for server in D4RL_SERVERS:
        if path.exists():  # already, or from the server before
            break
        try:
            print("downloading from", server)
            content = urlopen(server + name, timeout=60).read()
            h5py.File(BytesIO(content))  # raises if this isn't an HDF5 file
            write_file(path, content)
        except Exception as error:  # of many types: no network, no HDF5 file, ...
            print(error)
    if not path.exists():
        raise UserError(f"{path} is missing: give a --dataset, or set D4RL_DATASET_DIR")
    return path


def read_dataset(path, state_dim, action_dim, max_action):
    """Columns of a file in D4RL's format, {name: float32 (N, width)}, or UserError."""
    widths = {"observations": state_dim, "next_observations": state_dim}
    widths |= {"actions": action_dim, "rewards": 1, "terminals": 1, "timeouts": 1}
    arrays = {}
    try:
        with h5py.File(path) as file:
            for key in widths:
                if isinstance(file.get(key), h5py.Group):
                    raise TypeError(f"{key} is a group of {list(file[key])}")
                if key in file or key != "next_observations":  # the others are required
                    arrays[key] = np.c_[np.float32(file[key][:])]  # (N,) to (N, 1)
    except Exception as error:  # h5py raises nearly any type where a file is damaged
        raise UserError(
            f"{path} can't be read: {error}; D4RL's format has arrays of observations, "
            "actions, rewards, terminals and timeouts (1 where an episode was cut off)"
        ) from error
    for key, column in arrays.items():
        shape = len(arrays["rewards"]), widths[key]
        if column.shape != shape:
            raise UserError(
                f"{path}: {key} has shape {column.shape}, not {shape} as rewards and "
                "--env require; MATLAB reverses axes"
            )
        # Actions may exceed their bounds by rounding.
        good = np.abs(column) < (1.001 * max_action if key == "actions" else np.inf)
        if key in ("terminals", "timeouts"):
            good = np.isin(column, (0, 1))
        bad = np.flatnonzero(~good.all(1))
        if bad.size:
            raise UserError(
                f"{path}: {key} is wrong in {bad.size} row(s), first in row {bad[0]} "
                f"({column[~good][0]:g}): numbers must be finite, terminals and "
                f"timeouts 0 or 1, and actions within +-{max_action}"
            )
    return arrays


def prepare_dataset(arrays, args):
    """The transitions in `read_dataset`'s columns, {name: float32 tensor (N, width)}.

    Row i gives (o[i], a[i], r[i], o[i + 1], terminal[i]), or the file's own next state.
    The last row is left out, and rows with a timeout, unless they are terminal, too
    (d4rl drops these). Also returns the mean and std, (state_dim,), by which states are
    normalized, and the best discounted return from any row to its episode's end.
    """
    arrays = {"next_observations": np.roll(arrays["observations"], -1, 0)} | arrays
    terminals, timeouts = arrays["terminals"], arrays.pop("timeouts")
    keep = np.flatnonzero((terminals >= timeouts)[:-1])  # not timeouts alone
    if not keep.size:
        raise UserError("the dataset has 0 transitions: it needs rows with no timeout")
    best_return, return_to_go = -np.inf, 0.0
    for reward, ends in np.c_[arrays["rewards"], terminals + timeouts][::-1].tolist():
        return_to_go = reward + args.discount * return_to_go * (not ends)
        best_return = max(best_return, return_to_go)
    dataset = {k: torch.tensor(x[keep], device=args.device) for k, x in arrays.items()}
    states = dataset["observations"].double()  # a sum of float32 would lose digits
    mean = states.mean(0).float()
    std = states.std(0, correction=0).float() + 1e-3
    for name in ("observations", "next_observations"):
        dataset[name].sub_(mean).div_(std)
    return dataset, mean, std, best_return


def sample_batch(dataset, batch_size):
    """A batch of transitions, drawn uniformly and with replacement."""
    rewards = dataset["rewards"]
    indices = torch.randint(len(rewards), (batch_size,), device=rewards.device)
    return {name: column[indices] for name, column in dataset.items()}


# --- Training -------------------------------------------------------------------------

# What a result depends on: the versions of the packages, and of this file
VERSIONS = {x.__name__: x.__version__ for x in (torch, gym, mujoco, np)}
VERSIONS["script_sha256"] = sha256(SCRIPT.read_bytes()).hexdigest()


def write_file(path, content):
    """Writes `content` (bytes) whole or not at all, even if the power fails."""
    os.makedirs(path.parent, exist_ok=True)
    with TemporaryDirectory(dir=path.parent) as folder:  # one for each process
        with open(f"{folder}/part", "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file)
        os.replace(file.name, path)


def save(run_dir, checkpoint):
    """Writes checkpoint.pt and, from its contents, evaluations.csv and args.json."""
    content, table = BytesIO(), StringIO()
    # To memory first: on a full disk, torch.save raises RuntimeError, not OSError.
    torch.save(checkpoint, content)
    rows = checkpoint["evaluations"]
    # Not all rows have all columns: that of step 0 has no losses.
    writer = DictWriter(table, max(rows, key=len), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    args = json.dumps(checkpoint["args"] | VERSIONS, indent=2)
    write_file(run_dir / "checkpoint.pt", content.getvalue())
    write_file(run_dir / "evaluations.csv", table.getvalue().encode())
    write_file(run_dir / "args.json", args.encode())


def resume(path, agent, settings):
    """Loads a checkpoint of these `settings`, or raises UserError; returns its rows."""
    try:
        checkpoint = torch.load(path, "cpu")
        saved = checkpoint["args"]
    except Exception as error:  # of many types where a file is damaged
        raise UserError(f"{path} can't be read: choose another --run-dir") from error
    may_change = "dataset", "max_timesteps", "device", "run_dir"  # but not the data
    for name in saved | settings:
        if name not in may_change and settings.get(name) != saved.get(name):
            raise UserError(f"{path} has another {name}: choose another --run-dir")
    for name, state in checkpoint["agent"].items():
        getattr(agent, name).load_state_dict(state)
    torch.manual_seed(settings["seed"] + checkpoint["step"])  # GPU: draws new numbers
    torch.set_rng_state(checkpoint["rng_state"])  # CPU: exactly where it was
    return checkpoint["evaluations"]


def train(args):
    """Starts or continues the run in args.run_dir; returns its evaluations, as rows."""
    torch.set_flush_denormal(True)  # a CPU takes far longer for numbers below 1e-38
    file = args.dataset or download_dataset(args.env)
    envs = make_envs(args.env, args.eval_episodes)
    state_dim = envs.single_observation_space.shape[0]
    action_dim = envs.single_action_space.shape[0]
    max_action = float(envs.single_action_space.high[0])
    arrays = read_dataset(file, state_dim, action_dim, max_action)
    digest = sha256(b"".join(arrays.values())).hexdigest()
    settings = vars(args) | {"dataset_contents": digest}
    dataset, mean, std, best_return = prepare_dataset(arrays, args)
    print(
        f"{file} has {len(dataset['rewards']):,} transitions, "
        f"{dataset['terminals'].sum():,.0f} of them terminal; the largest action is "
        f"{dataset['actions'].abs().max():.4g} (bound {max_action}); alpha {args.alpha}"
    )

    torch.manual_seed(args.seed)
    agent = Agent(state_dim, action_dim, max_action, args)
    # Seeded again so that wpc.py, td3_bc.py and wbc.py draw the same batches.
    torch.manual_seed(args.seed)

    path = Path(args.run_dir, "checkpoint.pt")
    start, rows = 0, []
    if path.exists():
        rows = resume(path, agent, settings)
        start = rows[-1]["step"] + 1
    if start > args.max_timesteps:
        print(f"{args.run_dir} is finished; raise --max-timesteps to train longer")

    writer = SummaryWriter(args.run_dir, purge_step=start)
    metrics = {}
    clock = perf_counter()
    for step in range(start, args.max_timesteps + 1):
        if step:  # at step 0 only evaluate, to find a broken environment early
            batch = sample_batch(dataset, args.batch_size)
            metrics |= agent.update(batch, step)  # lmbda etc. keep their last value
        if step % args.eval_freq == 0 or step == args.max_timesteps:
            scalars = {k: x.item() for k, x in metrics.items()}  # waits for the GPU
            speed = (step - start) / (perf_counter() - clock)
            row = {"step": step} | evaluate(envs, agent.actor, mean, std, args)
            row |= scalars | {"steps_per_second": speed}
            row["best_discounted_return"] = best_return
            if not np.isfinite(sum(row.values())):
                raise UserError(f"diverged by step {step}, which isn't saved: {row}")
            if path.exists() and torch.load(path, "cpu")["evaluations"] != rows:
                raise UserError(f"{args.run_dir} is used by another process too")
            rows.append(row)
            state = {k: x.state_dict() for k, x in vars(agent).items() if k != "args"}
            checkpoint = {"args": settings, "step": step, "agent": state}
            checkpoint |= {"mean": mean, "std": std, "max_action": max_action}
            checkpoint |= {"evaluations": rows, "rng_state": torch.get_rng_state()}
            for name, value in row.items():
                writer.add_scalar(name, value, step)
            writer.flush()
            save(path.parent, checkpoint)
            shown = {"mean_return", "normalized_score", "best_discounted_return", "q"}
            line = ", ".join(f"{k} {x:.1f}" for k, x in row.items() if k in shown)
            print(f"step {step:,}: {line}", flush=True)
            clock, start = perf_counter(), step  # of the steps to the next row
    writer.close()
    return rows


def main():
    args = tyro.cli(Args, description=__doc__)  # prints ValueErrors of Args
    print(f"to continue, add --run-dir {args.run_dir!r}")
    try:
        train(args)
    except (UserError, OSError, ImportError, gym.error.Error) as error:
        sys.exit(error)
    except KeyboardInterrupt:
        sys.exit("stopped")


if __name__ == "__main__":
    main()
