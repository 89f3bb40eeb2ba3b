# SPDX-License-Identifier: MIT
"""Makes a dataset in D4RL's format; D4RL's robots move in D4RL's physics.

With --policy, episodes of a stochastic policy, as in D4RL's medium and expert data, or
with --random of uniform actions.

    python tests/tools/make_dataset.py --env hopper --steps 1000000 \\
        --policy hopper_medium-v2.hdf5 --out hopper_medium.hdf5

With neither, all that an online SAC agent (Haarnoja et al., 2018) meets, from its first
random steps to the policy that it ends with, as in D4RL's medium-replay data.

    python tests/tools/make_dataset.py --env hopper --steps 402000 \\
        --out hopper_medium_replay.hdf5

tests/data/halfcheetah_replay.hdf5 is the beginning of such data: of 202,000 steps, the
first 1,000 of them random.
"""

import copy
import hashlib
import io
import itertools
import shlex
import signal
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import torch
import torch.nn.functional as F
import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[2]))
import wpc


@dataclass
class Args:
    env: str
    """halfcheetah, hopper or walker2d, or a Gymnasium id"""
    steps: int
    """number of transitions in the file"""
    out: Path
    """the HDF5 file to write"""
    seed: int = 0
    """seed of the environment and of the actions"""

    # Episodes of one policy
    policy: Path | None = None
    """D4RL file that records its policy, or an .npz of the same names (fc0.weight)"""
    random: bool = False
    """take uniform actions"""

    # SAC
    random_steps: int = 5_000
    """steps of uniform actions before the agent acts and learns"""

    def __post_init__(self):
        if self.steps < 1:
            raise ValueError("steps must be >= 1")
        if self.policy and self.random:
            raise ValueError("--policy and --random exclude each other")


def make_columns(steps, env):
    """The arrays to fill, by D4RL's names."""
    states = np.zeros((steps, *env.observation_space.shape), np.float32)
    return {
        "observations": states,
        "actions": np.zeros((steps, *env.action_space.shape), np.float32),
        "rewards": np.zeros(steps, np.float32),
        "next_observations": states.copy(),
        "terminals": np.zeros(steps, bool),
        "timeouts": np.zeros(steps, bool),
    }


def do_step(env, state, action, data, t):
    """Writes a step to row t; returns the next state, the reward, and if it is over."""
    next_state, reward, terminal, truncated, _ = env.step(action)
    row = (state, action, reward, next_state, terminal, truncated and not terminal)
    for column, value in zip(data.values(), row, strict=True):
        column[t] = value
    return next_state, reward, terminal or truncated


# --- Episodes of one policy -----------------------------------------------------------

LAYERS = ("fc0", "fc1", "last_fc", "last_fc_log_std")  # D4RL's names


def load_policy(path, state_dim, action_dim):
    """The (weight, bias) of each of LAYERS, float32 arrays.

    Exits with a sentence if the file has no such policy, or one of another size.
    """
    names = [(layer, part) for layer in LAYERS for part in ("weight", "bias")]
    try:
        if path.suffix == ".npz":
            with np.load(path) as file:
                arrays = [np.float32(file[".".join(name)]) for name in names]
        else:
            with h5py.File(path) as file:
                group = file["metadata/policy"]
                arrays = [np.float32(group["/".join(name)]) for name in names]
    except Exception as error:  # of as many types as there are kinds of files
        sys.exit(f"{path} has no policy as D4RL's files record it ({reason(error)})")
    widths = arrays[0].shape[1], len(arrays[-1])
    if widths != (state_dim, action_dim):
        sys.exit(
            f"{path} has a policy for {widths[0]} states and {widths[1]} actions, and "
            f"the environment has {state_dim} and {action_dim}"
        )
    return list(zip(arrays[::2], arrays[1::2], strict=True))


def distribution(policy, state):
    """Mean and standard deviation, each (action_dim,), of the action before tanh."""
    (w0, b0), (w1, b1), (w_mean, b_mean), (w_std, b_std) = policy
    hidden = np.maximum(w0 @ state + b0, 0)
    hidden = np.maximum(w1 @ hidden + b1, 0)
    return w_mean @ hidden + b_mean, np.exp(np.clip(w_std @ hidden + b_std, -20, 2))


def collect(args, env, data, policy=None):
    """Fills `data`; yields how many rows are filled and the last episode's return.

    Episode k depends on the seed and k alone. Without a policy, actions are uniform.
    """
    low, high = env.action_space.low, env.action_space.high
    episodes, over, episode_return = itertools.count(), True, np.nan
    for t in range(args.steps):
        if over:
            last_return, episode_return = episode_return, 0.0
            rng = np.random.default_rng([args.seed, next(episodes)])
            state, _ = env.reset(seed=int(rng.integers(2**31)))
        if policy:
            mean, std = distribution(policy, np.float32(state))
            action = high * np.tanh(mean + std * rng.standard_normal(len(std)))
        else:
            action = rng.uniform(low, high)
        state, reward, over = do_step(env, state, np.float32(action), data, t)
        episode_return += reward
        yield t + 1, last_return


# --- SAC ------------------------------------------------------------------------------

DISCOUNT, TAU, LEARNING_RATE, BATCH_SIZE = 0.99, 0.005, 3e-4, 256


def sample_action(actor, observation):
    """A tanh-Gaussian action in [-1, 1] and its log-probability (..., 1)."""
    mean, log_std = actor(observation).chunk(2, dim=-1)
    normal = torch.distributions.Normal(mean, log_std.clamp(-5, 2).exp())
    before_tanh = normal.rsample()
    log_prob = normal.log_prob(before_tanh) - 2 * (
        np.log(2) - before_tanh - F.softplus(-2 * before_tanh)
    )
    return torch.tanh(before_tanh), log_prob.sum(-1, keepdim=True)


def learn(args, env, data):
    """Fills `data`; yields how many rows are filled and the last episode's return."""
    env.action_space.seed(args.seed)
    torch.manual_seed(args.seed)
    state_dim, action_dim = env.observation_space.shape[0], env.action_space.shape[0]
    max_action = float(env.action_space.high[0])
    tensors = {key: torch.from_numpy(column) for key, column in data.items()}

    actor = wpc.MLP(state_dim, 2 * action_dim)
    critic = wpc.Critic(state_dim, action_dim)
    critic_target = copy.deepcopy(critic)
    log_alpha = torch.zeros(1, requires_grad=True)
    actor_optimizer = wpc.Adam(actor.parameters(), LEARNING_RATE)
    critic_optimizer = wpc.Adam(critic.parameters(), LEARNING_RATE)
    alpha_optimizer = torch.optim.Adam([log_alpha], LEARNING_RATE)

    state, _ = env.reset(seed=args.seed)
    last_return, episode_return = np.nan, 0.0
    for t in range(args.steps):
        if t < args.random_steps:
            action = env.action_space.sample()
        else:
            with torch.no_grad():
                action, _ = sample_action(actor, torch.from_numpy(np.float32(state)))
            action = max_action * action.numpy()
        state, reward, over = do_step(env, state, action, data, t)
        episode_return += reward
        if over:
            last_return, episode_return = episode_return, 0.0
            state, _ = env.reset()
        yield t + 1, last_return
        if t < args.random_steps:
            continue

        i = torch.randint(t + 1, (BATCH_SIZE,))
        s, s_next = tensors["observations"][i], tensors["next_observations"][i]
        a, r = tensors["actions"][i] / max_action, tensors["rewards"][i, None]
        running = ~tensors["terminals"][i, None]
        alpha = log_alpha.exp().detach()
        with torch.no_grad():
            a_next, log_prob = sample_action(actor, s_next)
            q_next = torch.minimum(*critic_target(s_next, a_next))
            y = r + DISCOUNT * running * (q_next - alpha * log_prob)
        q1, q2 = critic(s, a)
        critic_loss = F.mse_loss(q1, y) + F.mse_loss(q2, y)
        critic_optimizer.zero_grad()
        critic_loss.backward()
        critic_optimizer.step()

        pi, log_prob = sample_action(actor, s)
        actor_loss = (alpha * log_prob - torch.minimum(*critic(s, pi))).mean()
        actor_optimizer.zero_grad()
        actor_loss.backward()
        actor_optimizer.step()

        alpha_loss = -log_alpha.exp() * (log_prob.detach().mean() - action_dim)
        alpha_optimizer.zero_grad()
        alpha_loss.backward()
        alpha_optimizer.step()
        wpc.soft_update(critic_target, critic, TAU)


# --- The file -------------------------------------------------------------------------


def reason(error):
    return f"{type(error).__name__}: {error}".split("\n")[0]


def try_to_write(path):
    """Exits with the system's reason if `path` can't be written; changes nothing."""
    exists = path.exists()
    try:
        path.open("ab").close()
    except OSError as error:
        sys.exit(f"--out can't be written: {error}")
    if not exists:
        path.unlink()


def score(env, mean_return):
    """What D4RL scores a return, as the end of a line; nothing for other robots."""
    if not (robot := wpc.d4rl_robot(env)):
        return ""
    _, low, high = robot
    return f"; D4RL's score {100 * (mean_return - low) / (high - low):.1f}"


def describe(env, data):
    """A line on the episodes of the data, and their SHA-256."""
    ends = np.flatnonzero(data["terminals"] | data["timeouts"]) + 1
    rewards = np.split(data["rewards"].astype(float), ends)[: len(ends)]
    returns = [x.sum() for x in rewards]
    line = f"{len(ends):,} episodes, return {np.mean(returns):.1f} +- "
    line += f"{np.std(returns):.1f}, largest {np.max(returns):.1f}"
    line += score(env, np.mean(returns))
    digest = hashlib.sha256()
    for column in data.values():
        digest.update(column.tobytes())
    return f"{line}\nSHA-256 of the arrays: {digest.hexdigest()}"


def write_hdf5(path, columns):
    """Writes arrays by name to an HDF5 file, whole or not at all. Raises OSError."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:  # in memory, as HDF5 breaks on a full disk
        for key, column in columns.items():
            file.create_dataset(key, data=column, compression="gzip", shuffle=True)
    wpc.write_file(path, content.getvalue())


def write_or_exit(path, columns):
    """Writes arrays by name to an HDF5 file, or exits with the system's reason."""
    try:
        write_hdf5(path, columns)
    except OSError as error:
        sys.exit(f"--out {path} can't be written: {error}")


def print_command(env, out):
    """Prints the command that trains on the file, from the repository's folder."""
    command = [sys.orig_argv[0], "wpc.py", "--env", env, "--dataset", str(out)]
    path = "PYTHONPATH=tests/tools " if env.startswith("eras:") else ""
    print(f"to train: {path}{shlex.join(command)}")


def write(args, data):
    """Writes the file, and prints what is in it and the command that trains on it."""
    data["timeouts"][-1] = not data["terminals"][-1]  # the last episode is cut off
    out = args.out
    try:
        write_hdf5(out, data)
    except OSError as error:
        print(f"{out} can't be written: {error}")
        out = Path(tempfile.mkdtemp(), out.name)
        write_hdf5(out, data)
    rows = len(data["timeouts"])
    print(f"{out}: {rows:,} transitions in {describe(args.env, data)}")
    print_command(args.env, out)


def main(args):
    # What a cluster sends before a job's time is over acts as Ctrl-C does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try_to_write(args.out)
    env = wpc.make_envs(args.env, 1).envs[0]
    data = make_columns(args.steps, env)
    if args.policy:
        sizes = env.observation_space.shape[0], env.action_space.shape[0]
        fill = collect(args, env, data, load_policy(args.policy, *sizes))
    else:
        fill = collect(args, env, data) if args.random else learn(args, env, data)
    filled = 0
    try:
        with tqdm(total=args.steps, disable=None) as progress:
            for filled, episode_return in fill:
                progress.set_postfix_str(f"return {episode_return:.0f}", refresh=False)
                progress.update(filled - progress.n)
    except KeyboardInterrupt:
        print("stopped")
    finally:  # also where an environment fails
        if filled:
            write(args, {key: column[:filled] for key, column in data.items()})
    if not filled:
        sys.exit("nothing was collected")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except (wpc.UserError, ImportError, gym.error.Error) as error:
        sys.exit(str(error))
