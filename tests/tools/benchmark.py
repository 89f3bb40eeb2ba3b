# SPDX-License-Identifier: MIT
"""Training speed of the scripts, plain and with --compile, against a textbook loop and
against the bare matrix products of a step; then evaluation, loading, start-up, and runs
side by side.

    python tests/tools/benchmark.py
    python tests/tools/benchmark.py --peers TD3_BC/TD3_BC.py wPC/TD3_wBC.py

The second line also measures files of https://github.com/sfujim/TD3_BC and
https://github.com/qsa-fox/wPC, which you download yourself. All variants take turns in
one process, so that whatever else the machine does meets all of them. Ratios of medians
come first, as they carry over to other machines.
"""

import csv
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
import torch
import torch.nn.functional as F
import tyro

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
import td3_bc  # noqa: E402
import wbc  # noqa: E402
import wpc  # noqa: E402

STATE_DIM, ACTION_DIM = 11, 3  # Hopper's
BATCH, ROWS = 256, 200_000
DATASET = ROOT / "tests/data/halfcheetah_replay.hdf5"


@dataclass
class Args:
    rounds: int = 10
    """turns of each variant"""
    steps: int = 40
    """training steps of a turn"""
    peers: list[Path] = field(default_factory=list)
    """other files to measure, with a class TD3_BC as TD3_BC.py has it"""


def script_steps(script, compiled):
    """A script's own update, and its own sampling."""
    args = script.Args()
    args.alpha = 2.5
    agent = script.Agent(STATE_DIM, ACTION_DIM, 1.0, args)
    update = script.compile_update(agent) if compiled else agent.update
    dataset = {
        "observations": torch.randn(ROWS, STATE_DIM),
        "actions": torch.rand(ROWS, ACTION_DIM) * 2 - 1,
        "rewards": torch.randn(ROWS, 1),
        "next_observations": torch.randn(ROWS, STATE_DIM),
        "terminals": torch.zeros(ROWS, 1),
    }
    return lambda i: update(script.sample_batch(dataset, BATCH), i)


class Buffer:
    """A replay buffer as TD3 first had it: NumPy arrays, and new tensors a batch."""

    def __init__(self):
        widths = (STATE_DIM, ACTION_DIM, STATE_DIM, 1, 1)
        self.arrays = [np.random.randn(ROWS, width) for width in widths]

    def sample(self, batch_size):
        """States, actions, next states, rewards, and 1 - done."""
        index = np.random.randint(0, ROWS, batch_size)
        return [torch.FloatTensor(array[index]) for array in self.arrays]


def peer_steps(path):
    """The training step of a file that has the class TD3_BC."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    agent, buffer = module.TD3_BC(STATE_DIM, ACTION_DIM, 1.0), Buffer()
    return lambda i: agent.train(buffer, BATCH)


def textbook_steps():
    """wPC as one would first write it: a buffer of NumPy arrays, three plain Adams, a
    loop for the targets."""
    actor, actor_target = (wpc.Actor(STATE_DIM, ACTION_DIM, 1.0) for _ in range(2))
    critic, critic_target = (wpc.Critic(STATE_DIM, ACTION_DIM) for _ in range(2))
    value = wpc.Value(STATE_DIM)
    actor_optimizer = torch.optim.Adam(actor.parameters(), 3e-4)
    critic_optimizer = torch.optim.Adam(critic.parameters(), 3e-4)
    value_optimizer = torch.optim.Adam(value.parameters(), 3e-4)
    buffer = Buffer()

    def step(i):
        s, a, s_next, r, not_done = buffer.sample(BATCH)
        with torch.no_grad():
            noise = (torch.randn_like(a) * 0.2).clamp(-0.5, 0.5)
            a_next = (actor_target(s_next) + noise).clamp(-1, 1)
            y = r + 0.99 * not_done * torch.min(*critic_target(s_next, a_next))
        q1, q2 = critic(s, a)
        critic_loss = F.mse_loss(q1, y) + F.mse_loss(q2, y)
        critic_optimizer.zero_grad()
        critic_loss.backward()
        critic_optimizer.step()
        value_loss = F.mse_loss(value(s), y)
        value_optimizer.zero_grad()
        value_loss.backward()
        value_optimizer.step()
        if i % 2 == 0:
            with torch.no_grad():
                weight = (critic.q1(s, a) > value(s)).float()
            pi = actor(s)
            q = critic.q1(s, pi)
            constraint = (weight * (pi - a) ** 2).mean()
            actor_loss = -2.5 / q.abs().mean().detach() * q.mean() + constraint
            actor_optimizer.zero_grad()
            actor_loss.backward()
            actor_optimizer.step()
            for network, target in ((critic, critic_target), (actor, actor_target)):
                pairs = zip(network.parameters(), target.parameters(), strict=True)
                for p, p_target in pairs:
                    p_target.data.copy_(0.005 * p.data + 0.995 * p_target.data)

    return step


def product_steps():
    """The floor: only wPC's matrix products, forward and backward, at their shapes."""

    def network(inputs, outputs):
        sizes = ((inputs, 256), (256, 256), (256, outputs))
        return [
            (torch.randn(BATCH, i), torch.randn(o, i), torch.randn(BATCH, o))
            for i, o in sizes
        ]

    v, q = network(STATE_DIM, 1), network(STATE_DIM + ACTION_DIM, 1)
    pi = network(STATE_DIM, ACTION_DIM)

    def forward(network):
        for x, weight, _ in network:
            x @ weight.T

    def backward(network, parameters=True, inputs=False):
        for i, (x, weight, gradient) in enumerate(network):
            if parameters:
                gradient.T @ x
            if i > 0 or inputs:
                gradient @ weight

    def step(i):
        for network in (pi, q, q, q, q, v):  # targets: pi and both Q; then both Q and V
            forward(network)
        for network in (q, q, v):
            backward(network)
        if i % 2 == 0:
            for network in (q, v, pi, q):  # the weight; then Q1(s, pi(s))
                forward(network)
            backward(q, parameters=False, inputs=True)
            backward(pi)

    return step


def steps_per_second(variants, args):
    """The median speed of each variant over its turns."""
    for step in variants.values():
        step(1)  # compiles what is to be compiled
        step(2)
    speeds = {name: [] for name in variants}
    for _ in range(args.rounds):
        for name, step in variants.items():
            start = time.perf_counter()
            for i in range(1, args.steps + 1):
                step(i)
            speeds[name].append(args.steps / (time.perf_counter() - start))
    return {name: float(np.median(speed)) for name, speed in speeds.items()}


def benchmark_steps(args):
    """Prints a table with a row for each variant; returns wpc's speed on one thread."""
    columns = {}
    for threads in sorted({1, os.cpu_count()}):
        torch.set_num_threads(threads)
        torch._dynamo.reset()  # what is compiled depends on the number of threads
        variants = {"textbook": textbook_steps(), "products": product_steps()}
        for script in (wpc, td3_bc, wbc):
            variants[script.SCRIPT] = script_steps(script, compiled=False)
            variants[f"{script.SCRIPT} --compile"] = script_steps(script, compiled=True)
        variants |= {path.name: peer_steps(path) for path in args.peers}
        columns[threads] = steps_per_second(variants, args)
    header = "| "
    for threads in columns:
        header += f"| {threads} thread(s): / textbook | steps/s "
    print(f"{header}|\n|---|" + "---|---|" * len(columns))
    for name in columns[1]:
        row = f"| {name} "
        for speed in columns.values():
            row += f"| {speed[name] / speed['textbook']:.2f} | {speed[name]:.0f} "
        print(f"{row}|")
    return columns[1]["wpc"]


def benchmark_evaluation(speed):
    """The share of evaluation in a run: every 5,000 steps, 10 full-length episodes."""
    for robot, state_dim, action_dim in (("hopper", 11, 3), ("walker2d", 17, 6)):
        envs = wpc.make_envs(robot, 10)
        for env in envs.envs:  # full-length episodes, whatever the policy
            env.unwrapped._terminate_when_unhealthy = False
        actor = wpc.Actor(state_dim, action_dim, 1.0)
        mean, std = torch.zeros(state_dim), torch.ones(state_dim)
        times = []
        for seed in range(3):
            start = time.perf_counter()
            wpc.evaluate(envs, actor, mean, std, seed)
            times.append(time.perf_counter() - start)
        seconds = float(np.median(times))
        share = seconds / (seconds + 5000 / speed)
        print(f"evaluation, {robot}: {seconds:.2f} s, {100 * share:.1f}% of a run")


LOAD = """
import time, wpc
start = time.perf_counter()
dataset, _ = wpc.load_dataset({path!r}, {state_dim}, {action_dim}, wpc.Args())
wpc.normalize_states(dataset)
seconds = time.perf_counter() - start
print(f"{{len(dataset['rewards']):,}} transitions in {{seconds:.1f}} s")
"""


def benchmark_loading(folder):
    """Hopper's and HalfCheetah's largest datasets, each in a fresh process."""
    for rows, state_dim, action_dim in ((1_000_000, 11, 3), (2_000_000, 17, 6)):
        path = folder / "data.hdf5"
        rng = np.random.default_rng(0)
        with h5py.File(path, "w") as file:
            file["observations"] = rng.random((rows, state_dim), np.float32)
            file["actions"] = rng.random((rows, action_dim), np.float32)
            file["rewards"] = np.ones(rows, np.float32)
            file["terminals"] = np.zeros(rows, bool)
            file["timeouts"] = np.arange(rows) % 1000 == 999
        program = LOAD.format(
            path=str(path), state_dim=state_dim, action_dim=action_dim
        )
        line = [sys.executable, "-c", program]
        output = subprocess.run(line, cwd=ROOT, capture_output=True, check=True).stdout
        print(f"loading: {output.decode().strip()}")


def run_line(run_dir, *arguments):
    line = [sys.executable, ROOT / "wpc.py", "--env", "halfcheetah", "--device", "cpu"]
    line += ["--dataset", DATASET, "--eval-episodes", 1, "--run-dir", run_dir]
    return [str(x) for x in (*line, *arguments)]


def benchmark_start(folder):
    """A whole run of one step and one evaluation of one episode."""
    times = []
    for i in range(3):
        start = time.perf_counter()
        line = run_line(folder / str(i), "--max-timesteps", 1)
        subprocess.run(line, capture_output=True, check=True)
        times.append(time.perf_counter() - start)
    print(f"a run of one step: {np.median(times):.1f} s")


def run_together(folder, runs, threads, steps):
    """Steps a second, all together, of runs at the same time."""
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    options = ["--max-timesteps", steps, "--log-freq", steps]
    folders = [folder / f"{runs}_{threads}_{i}" for i in range(runs)]
    processes = [
        subprocess.Popen(
            run_line(run_dir, *options), stdout=subprocess.DEVNULL, env=environment
        )
        for run_dir in folders
    ]
    assert all(process.wait() == 0 for process in processes)
    speed = 0
    for run_dir in folders:
        row = list(csv.DictReader((run_dir / "evaluations.csv").open()))[-1]
        speed += float(row["steps_per_second"])
    return speed


def benchmark_side_by_side(folder, args):
    """One run with all threads, against as many runs with one thread each."""
    cores, steps = os.cpu_count(), 20 * args.steps
    together = run_together(folder, cores, 1, steps)
    alone = run_together(folder, 1, cores, steps)
    print(f"{cores} runs with one thread each: {together:.0f} steps/s together")
    print(f"1 run with {cores} threads: {alone:.0f} steps/s")


def main(args: Args):
    torch.set_flush_denormal(True)
    speed = benchmark_steps(args)
    benchmark_evaluation(speed)
    with tempfile.TemporaryDirectory() as folder:
        benchmark_loading(Path(folder))
        benchmark_start(Path(folder))
        benchmark_side_by_side(Path(folder), args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
