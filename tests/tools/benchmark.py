# SPDX-License-Identifier: MIT
"""Training speed of the scripts, plain and compiled, beside other people's files.

    python tests/tools/benchmark.py
    python tests/tools/benchmark.py --peers TD3_BC/TD3_BC.py wPC/TD3_wBC.py \\
        --jax JAX-CORL/algos/td3bc.py

The second line also measures files of github.com/sfujim/TD3_BC, github.com/qsa-fox/wPC
and github.com/nissymori/JAX-CORL, which you download yourself; JAX-CORL needs jax,
flax, optax, omegaconf and pydantic. d3rlpy's TD3PlusBC is measured where d3rlpy is
installed. All variants take turns, so that other load slows all of them alike. The
table has medians, and their ratios to wpc.py's.
"""

import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import tyro
from check_steps import load
from compiled import two_steps_a_call
from tqdm import trange

try:
    import d3rlpy
except ImportError:
    d3rlpy = None

sys.path.insert(0, str(Path(__file__).parents[2]))
import td3_bc
import wbc
import wpc

STATE_DIM, ACTION_DIM = 11, 3  # Hopper's
BATCH, ROWS = 256, 200_000


@dataclass
class Args:
    rounds: int = 10
    """number of turns of each variant"""
    steps: int = 40
    """number of training steps in a turn"""
    peers: list[Path] = field(default_factory=list)
    """other files to measure, with a class TD3_BC as TD3_BC.py has it"""
    jax: Path | None = None
    """JAX-CORL's td3bc.py"""


def plain(agent, update, sample_batch):
    return lambda dataset, step: update(agent, sample_batch(dataset, BATCH), step)


def script_steps(script, make_steps=plain):
    """A script's own sampling and update."""
    args = script.Args(device="cpu")
    agent = script.Agent(STATE_DIM, ACTION_DIM, 1.0, args)
    steps = make_steps(agent, script.Agent.update, script.sample_batch)
    dataset = {
        "observations": torch.randn(ROWS, STATE_DIM),
        "actions": torch.rand(ROWS, ACTION_DIM) * 2 - 1,
        "rewards": torch.randn(ROWS, 1),
        "next_observations": torch.randn(ROWS, STATE_DIM),
        "terminals": torch.zeros(ROWS, 1),
    }
    return lambda i: steps(dataset, i)


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
    peer, buffer = load(path, "TD3_BC"), Buffer()
    peer.device = torch.device("cpu")  # as the scripts, also where there is a GPU
    agent = peer.TD3_BC(STATE_DIM, ACTION_DIM, 1.0)
    return lambda i: agent.train(buffer, BATCH)


def d3rlpy_steps():
    """The loop of TD3PlusBC.fit, without its log."""
    observations, actions, _, rewards, terminals = Buffer().arrays
    timeouts = np.arange(1, ROWS + 1) % 1000 == 0
    columns = [np.float32(x) for x in (observations, actions, rewards, 0 * terminals)]
    dataset = d3rlpy.dataset.MDPDataset(*columns, np.float32(timeouts))
    agent = d3rlpy.algos.TD3PlusBCConfig(batch_size=BATCH).create(device="cpu")
    agent.build_with_dataset(dataset)
    return lambda i: agent.update(dataset.sample_transition_batch(BATCH))


JAX = """
import functools, sys, time, types

path, threads, layer_norm, rows, state_dim, action_dim = sys.argv[1:]
for name in ("d4rl", "distrax", "gym", "wandb"):  # imported, but not needed here
    sys.modules[name] = types.ModuleType(name)
sys.modules["gym"].Env = object
sys.argv = sys.argv[:1]
import jax

program = open(path).read()
if layer_norm == "False":
    assert program.count("layer_norm=True") == 2
    program = program.replace("layer_norm=True", "layer_norm=False")
module = types.ModuleType("peer")
exec(compile(program, path, "exec"), module.__dict__)
config, key = module.config, jax.random.PRNGKey(0)
draw = functools.partial(jax.random.normal, key)
rows, state_dim, action_dim = int(rows), int(state_dim), int(action_dim)
data = module.Transition(
    draw((rows, state_dim)),
    draw((rows, action_dim)),
    draw((rows,)),
    draw((rows, state_dim)),
    0 * draw((rows,)),
)
state = module.create_td3bc_train_state(
    key, data.observations[0], data.actions[0], config
)
update = jax.jit(module.TD3BC().update_n_times, static_argnums=(3,))
for line in sys.stdin:
    calls = int(line) // config.n_jitted_updates
    start = time.perf_counter()
    for _ in range(calls):
        key, own = jax.random.split(key)
        state, _ = update(state, data, own, config)
    jax.block_until_ready(state.actor.params)
    print(calls * config.n_jitted_updates, time.perf_counter() - start, flush=True)
"""


class JaxSteps:
    """JAX-CORL's training steps, in a process of its own on so many cores."""

    def __init__(self, path, threads, layer_norm):
        sizes = (ROWS, STATE_DIM, ACTION_DIM)
        line = [sys.executable, "-c", JAX, path, threads, layer_norm, *sizes]
        cores = sorted(os.sched_getaffinity(0))[:threads]
        self.process = subprocess.Popen(
            [str(x) for x in line],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
            preexec_fn=lambda: os.sched_setaffinity(0, cores),
        )

    def run(self, steps):
        self.process.stdin.write(f"{steps}\n")
        self.process.stdin.flush()
        done, seconds = self.process.stdout.readline().split()
        return int(done) / float(seconds)


class Steps:
    """Training steps in this process."""

    def __init__(self, step):
        self.step = step

    def run(self, steps):
        """Does so many steps; returns steps a second."""
        start = time.perf_counter()
        for i in range(1, steps + 1):
            self.step(i)
        return steps / (time.perf_counter() - start)


def variants(args, threads):
    made = {}
    for script in (wpc, td3_bc, wbc):
        name = script.SCRIPT.name
        made[name] = Steps(script_steps(script))
        made[f"compiled {name}"] = Steps(script_steps(script, two_steps_a_call))
    made |= {path.name: Steps(peer_steps(path)) for path in args.peers}
    if d3rlpy:
        made["d3rlpy's TD3PlusBC"] = Steps(d3rlpy_steps())
    if args.jax:
        made["JAX-CORL"] = JaxSteps(args.jax, threads, True)
        made["JAX-CORL, no LayerNorm"] = JaxSteps(args.jax, threads, False)
    return made


def main(args: Args):
    torch.set_flush_denormal(True)
    columns, all_cores = {}, os.sched_getaffinity(0)
    for threads in sorted({1, len(all_cores)}):
        os.sched_setaffinity(0, sorted(all_cores)[:threads])
        torch.set_num_threads(threads)
        torch._dynamo.reset()  # what is compiled depends on the number of threads
        made = variants(args, threads)
        for variant in made.values():
            variant.run(args.steps)  # compiles what is to be compiled
        speeds = {name: [] for name in made}
        for _ in trange(args.rounds, desc=f"{threads} thread(s)"):
            for name, variant in made.items():
                speeds[name].append(variant.run(args.steps))
        columns[threads] = {name: np.median(speed) for name, speed in speeds.items()}
        for variant in made.values():
            if isinstance(variant, JaxSteps):
                variant.process.kill()
        os.sched_setaffinity(0, all_cores)
    header = "| "
    for threads in columns:
        header += f"| {threads} thread(s): / wpc.py | steps/s "
    print(f"{header}|\n|---|" + "---|---|" * len(columns))
    for name in columns[1]:
        row = f"| {name} "
        for speed in columns.values():
            row += f"| {speed[name] / speed['wpc.py']:.2f} | {speed[name]:.0f} "
        print(f"{row}|")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
