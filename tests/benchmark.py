# SPDX-License-Identifier: MIT
"""Training speed of the three scripts, against a textbook loop and against the bare matrix products of a step.

    python tests/benchmark.py

All variants take turns in one process, so that whatever else the machine does meets all of them; ratios of medians
come first, as they carry over to other machines. After that: evaluation, loading, start-up, and runs side by side.
"""

import csv
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
import td3_bc  # noqa: E402
import wbc  # noqa: E402
import wpc  # noqa: E402

SHAPES = {"Hopper": (11, 3), "Walker2d": (17, 6), "HalfCheetah": (17, 6)}
BATCH, ROWS = 256, 200_000


@dataclass
class Args:
    rounds: int = 15  # turns of each variant
    steps: int = 60  # training steps of a turn


def script_steps(script, obs_dim, action_dim):
    """The real update of a script, with the sampling of `train`."""
    args = script.Args()
    args.alpha = 2.5
    networks, optimizers = script.make_networks(obs_dim, action_dim, args, "cpu")
    widths = [obs_dim, action_dim, 1, 1, obs_dim, 1][: 6 if script is wpc else 5]
    transitions, rng = torch.randn(ROWS, sum(widths)), torch.Generator().manual_seed(0)

    def step(i):
        batch = transitions[torch.randint(ROWS, (BATCH,), generator=rng)].split(widths, dim=1)
        script.update(networks, optimizers, batch, args, i, rng)

    return step


def textbook_steps(obs_dim, action_dim):
    """wPC as one would first write it: NumPy buffers, a FloatTensor for each array, three Adams, a loop for the targets."""
    actor, actor_target = (wpc.mlp(obs_dim, action_dim).append(nn.Tanh()) for _ in range(2))
    q1, q2, q1_target, q2_target = (wpc.mlp(obs_dim + action_dim, 1) for _ in range(4))
    value = wpc.mlp(obs_dim, 1)
    critics = nn.ModuleList([q1, q2])
    actor_optimizer, critic_optimizer, value_optimizer = (torch.optim.Adam(n.parameters(), 3e-4) for n in (actor, critics, value))
    data = [np.random.randn(ROWS, width) for width in (obs_dim, action_dim, 1, 1, obs_dim)]

    def step(i):
        index = np.random.randint(0, ROWS, BATCH)
        s, a, r, not_done, s_next = (torch.FloatTensor(array[index]) for array in data)
        with torch.no_grad():
            noise = (torch.randn_like(a) * 0.2).clamp(-0.5, 0.5)
            sa_next = torch.cat([s_next, (actor_target(s_next) + noise).clamp(-1, 1)], 1)
            y = r + 0.99 * not_done * torch.min(q1_target(sa_next), q2_target(sa_next))
        sa = torch.cat([s, a], 1)
        critic_loss = F.mse_loss(q1(sa), y) + F.mse_loss(q2(sa), y)
        critic_optimizer.zero_grad()
        critic_loss.backward()
        critic_optimizer.step()
        value_loss = F.mse_loss(value(s), y)
        value_optimizer.zero_grad()
        value_loss.backward()
        value_optimizer.step()
        if i % 2 == 0:
            with torch.no_grad():
                weight = (q1(sa) > value(s)).float()
            pi = actor(s)
            q = q1(torch.cat([s, pi], 1))
            actor_loss = -2.5 / q.abs().mean().detach() * q.mean() + (weight * (pi - a) ** 2).mean()
            actor_optimizer.zero_grad()
            actor_loss.backward()
            actor_optimizer.step()
            pairs = ((q1, q1_target), (q2, q2_target), (actor, actor_target))
            for network, target in pairs:
                for p, p_target in zip(network.parameters(), target.parameters()):
                    p_target.data.copy_(0.005 * p.data + 0.995 * p_target.data)

    return step


def product_steps(obs_dim, action_dim):
    """The floor: no more than wPC's matrix products, forward and backward, at their shapes."""
    layers = {}
    for inputs, outputs in ((obs_dim, 1), (obs_dim + action_dim, 1), (obs_dim, action_dim)):
        sizes = ((inputs, 256), (256, 256), (256, outputs))
        layers[inputs, outputs] = [(torch.randn(BATCH, i), torch.randn(o, i), torch.randn(BATCH, o)) for i, o in sizes]
    v, q, pi = layers.values()

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


def benchmark_steps(args):
    results = {}
    for robot, shape in SHAPES.items():
        for threads in sorted({1, torch.get_num_threads()}):
            torch.set_num_threads(threads)
            scripts = {s.SCRIPT: script_steps(s, *shape) for s in (wpc, td3_bc, wbc)}
            variants = {"textbook": textbook_steps(*shape), "products": product_steps(*shape)} | scripts
            rates = {name: [] for name in variants}
            for turn in range(args.rounds + 1):
                for name, step in variants.items():
                    start = time.perf_counter()
                    for i in range(1, args.steps + 1):
                        step(i)
                    if turn:  # the first is to warm up
                        rates[name].append(args.steps / (time.perf_counter() - start))
            results[robot, threads] = {name: float(np.median(rate)) for name, rate in rates.items()}
    print("| | threads | wpc / textbook | products / wpc | wpc | td3_bc | wbc | textbook | products |\n|" + "---|" * 9)
    for (robot, threads), rate in results.items():
        ratios = f"{rate['wpc'] / rate['textbook']:.2f} | {rate['products'] / rate['wpc']:.2f}"
        speeds = " | ".join(f"{rate[name]:.0f}" for name in ("wpc", "td3_bc", "wbc", "textbook", "products"))
        print(f"| {robot} | {threads} | {ratios} | {speeds} |")
    return results


def benchmark_evaluation(results):
    """The share of a run that evaluation takes: one every 5,000 steps, 10 episodes of 1000 steps each."""
    gym.logger.min_level = gym.logger.ERROR
    for robot, (obs_dim, action_dim) in SHAPES.items():
        envs = gym.make_vec(wpc.ROBOTS[robot.lower()][0], 10, vectorization_mode="sync")
        for env in envs.envs:  # full-length episodes, whatever the policy
            env.unwrapped._terminate_when_unhealthy = False
        actor = wpc.make_networks(obs_dim, action_dim, wpc.Args(), "cpu")[0]["actor"]
        mean, std = torch.zeros(obs_dim), torch.ones(obs_dim)
        times = []
        for seed in range(3):
            start = time.perf_counter()
            wpc.evaluate(envs, actor, mean, std, seed)
            times.append(time.perf_counter() - start)
        training = 5000 / results[robot, torch.get_num_threads()]["wpc"]
        seconds = float(np.median(times))
        print(f"evaluation, {robot}: {seconds:.2f} s, {100 * seconds / (seconds + training):.1f}% of a run")


def benchmark_loading(folder):
    """Time and peak memory of a fresh process that loads Hopper's and HalfCheetah's largest datasets."""
    for rows, obs_dim, action_dim in ((1_000_000, 11, 3), (2_000_000, 17, 6)):
        path = folder / "data.hdf5"
        with h5py.File(path, "w") as file:
            for key, width in (("observations", obs_dim), ("actions", action_dim)):
                file[key] = np.random.default_rng(0).random((rows, width), np.float32)
            file["rewards"] = np.ones(rows, np.float32)
            file["terminals"], file["timeouts"] = np.zeros(rows, bool), np.arange(rows) % 1000 == 999
        program = (
            "import time, wpc\n"
            "peak = lambda: 1024 * int(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])\n"
            "before, start = peak(), time.perf_counter()\n"
            f"transitions = wpc.load_dataset({str(path)!r}, {obs_dim}, {action_dim}, wpc.Args())[0]\n"
            "seconds, size = time.perf_counter() - start, transitions.nbytes\n"
            "print(f'{seconds:.1f} s, peak {(peak() - before) / size:.2f} times the {size / 1e6:.0f} MB of transitions')"
        )
        output = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
        print(f"loading {rows:,} transitions: {output.stdout.strip()}")


def benchmark_start(folder):
    """From the command line to the first training step, the evaluation before it left to one episode."""
    line = "--env halfcheetah --dataset tests/data/halfcheetah_replay.hdf5 --max-timesteps 1 --eval-episodes 1 --run-dir"
    times = []
    for i in range(3):
        start = time.perf_counter()
        command = [sys.executable, "wpc.py", *line.split(), str(folder / str(i))]
        subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
        times.append(time.perf_counter() - start)
    print(f"start-up, with one step and two evaluations of one episode: {np.median(times):.1f} s")


def benchmark_side_by_side(folder, args):
    """A run with all threads, and as many runs at once with one thread each: what the machine does in all, in turns."""
    cores, steps = torch.get_num_threads(), 20 * args.steps
    line = f"--env halfcheetah --dataset tests/data/halfcheetah_replay.hdf5 --max-timesteps {steps} --log-freq {steps} --eval-episodes 1 --run-dir"
    totals = {1: [], cores: []}
    for turn in range(3):
        for threads, rates in totals.items():
            environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
            folders = [folder / f"{turn} {threads} {run}" for run in range(cores // threads)]
            commands = [[sys.executable, "wpc.py", *line.split(), str(f)] for f in folders]
            runs = [subprocess.Popen(c, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL) for c in commands]
            assert not any([run.wait() for run in runs])
            last = [list(csv.DictReader((f / "evaluations.csv").open()))[-1] for f in folders]
            rates.append(sum(float(row["steps_per_second"]) for row in last))
    for threads, rates in totals.items():
        print(f"{cores // threads} run(s) of wpc with {threads} thread(s) each: {np.median(rates):.0f} steps/s in all")


if __name__ == "__main__":
    args = tyro.cli(Args, description=__doc__)
    results = benchmark_steps(args)
    benchmark_evaluation(results)
    with tempfile.TemporaryDirectory() as folder:
        benchmark_loading(Path(folder))
        benchmark_start(Path(folder))
        benchmark_side_by_side(Path(folder), args)
