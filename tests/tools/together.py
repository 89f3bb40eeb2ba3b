# SPDX-License-Identifier: MIT
"""Trains many runs at once on one GPU, with evaluation on the CPU's cores.

    python tests/tools/experiments.py list table1 --runs runs/paper > commands.txt
    grep hopper commands.txt > hopper.txt
    python tests/tools/together.py hopper.txt

A step of one run leaves a GPU idle nearly all of the time. Here all R runs become one:
a network's parameters are (R, P), a batch is (R, B, width), and each step is `update`
of wpc.py, in which every mean over a batch is taken for each run by itself. TD3+BC is
wPC with V at minus infinity, which makes each weight 1, and wBC is wPC with alpha 0.
The step is traced, compiled by torch.compile and captured as a CUDA graph.

Networks start as the script starts them with the run's seed. Batches and noise are
drawn for all runs together, so a run is not the one that the script makes with the same
seed, but one as likely. The runs must be of one robot. If you edit wpc.py, let `update`
combine the rows of a batch by means alone. Each run leaves args.json and
evaluations.csv, as its script does, and a checkpoint.pt with its policy, for play.py;
it can't be continued.
"""

import copy
import functools
import importlib
import multiprocessing
import os
import pickle
import re
import shlex
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from torch._inductor.compile_fx import compile_fx
from torch.fx.experimental.proxy_tensor import make_fx
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torch.overrides import TorchFunctionMode

sys.path.insert(0, str(Path(__file__).parents[2]))
from compiled import TraceableAdam, as_cuda_graph

import wpc


@dataclass
class Options:
    commands: tyro.conf.Positional[Path]
    """file of lines such as "python wpc.py --env ... --run-dir ...", a run each"""
    tf32: bool = False
    """multiply matrices in TF32, which is faster, with 10 instead of 23 bits"""
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    """where to train; on a CPU, nothing is compiled"""


# --- Many networks as one -------------------------------------------------------------


class Networks(nn.Module):
    """R of the script's `MLP` as one, with parameters (R, P)."""

    def __init__(self, networks):
        super().__init__()
        self.shapes = [
            layer.weight.shape for layer in networks[0] if isinstance(layer, nn.Linear)
        ]
        rows = [parameters_to_vector(x.parameters()).detach() for x in networks]
        self.flat = nn.Parameter(torch.stack(rows))

    def forward(self, x):
        """(R, B, in) to (R, B, out); of the first networks only, if x is of fewer."""
        rest = self.flat[: len(x)]
        for i, (height, width) in enumerate(self.shapes):
            sizes = height * width, height, rest.shape[1] - height * (width + 1)
            weight, bias, rest = rest.split(sizes, dim=1)
            x = torch.bmm(x if i == 0 else F.relu(x), weight.view(-1, height, width).mT)
            x = x + bias[:, None]
        return x

    def copy_to(self, i, network):
        """Gives one of the script's networks the parameters of network i of R."""
        vector_to_parameters(self.flat.detach()[i], network.parameters())


class Actors(nn.Module):
    """The policies of R runs."""

    def __init__(self, actors):
        super().__init__()
        self.net, self.max_action = Networks(actors), actors[0].max_action

    def forward(self, s):
        return self.max_action * torch.tanh(self.net(s))


class Critics(nn.Module):
    """The twin critics of R runs, as 2 R networks."""

    def __init__(self, critics):
        super().__init__()
        q2s = [critic.q2 for critic in critics]
        self.net = Networks([critic.q1 for critic in critics] + q2s)

    def forward(self, s, a):
        sa = torch.cat([s, a], dim=-1)
        return self.net(torch.cat([sa, sa])).chunk(2)

    def q1(self, s, a):
        return self.net(torch.cat([s, a], dim=-1))


class Values(nn.Module):
    """V of R runs; for the weight, it is minus infinity in those of TD3+BC."""

    def __init__(self, values, scripts):
        super().__init__()
        self.net = Networks(values)
        weight_1 = torch.tensor([[[script == "td3_bc"]] for script in scripts])
        self.register_buffer("weight_1", weight_1)

    def forward(self, s):
        v = self.net(s)
        if torch.is_grad_enabled():  # V is trained
            return v
        return v.masked_fill(self.weight_1, -torch.inf)


class ForEachRun(TorchFunctionMode):
    """In it, a mean over (R, B, width) is one for each run, (R, 1, 1).

    So are losses; their sum gives each run the gradient of its own. Gradients are
    computed for those parameters only that the next optimizer step waits for.
    """

    def __init__(self, parameters):
        super().__init__()
        self.parameters = parameters

    def __torch_function__(self, function, types, args=(), kwargs=None):
        if function is torch.Tensor.mean and args[0].ndim == 3:
            return args[0].mean(dim=(1, 2), keepdim=True)
        if function is F.mse_loss:
            return (args[0] - args[1]).square().mean(dim=(1, 2), keepdim=True)
        if function is torch.Tensor.backward:
            waiting = [p for p in self.parameters if p.grad is None]
            loss = args[0].sum()
            gradients = torch.autograd.grad(loss, waiting, allow_unused=True)
            for parameter, gradient in zip(waiting, gradients, strict=True):
                parameter.grad = gradient
            return None
        return function(*args, **(kwargs or {}))


# --- All runs as one ------------------------------------------------------------------


def script_of(args):
    return type(args).__module__


class Runs:
    """R runs that are trained as one. `dims` is (state_dim, action_dim, max_action),
    `data` has what prepare_dataset returns for each."""

    def __init__(self, runs, dims, data, device):
        self.runs, self.data, self.device = runs, data, device
        self.metrics = {}
        agents = []
        for args in runs:
            torch.manual_seed(args.seed)
            agents.append(wpc.Agent(*dims, wpc.Args(seed=args.seed, device="cpu")))
        self.agent, self.actor = copy.copy(agents[0]), agents[0].actor
        agent = self.agent
        shared = {k: x for args in runs for k, x in asdict(args).items()}
        known = {field.name for field in fields(wpc.Args)}
        agent.args = wpc.Args(**{k: x for k, x in shared.items() if k in known})
        alphas = [[[getattr(args, "alpha", 0.0)]] for args in runs]
        agent.args.alpha = torch.tensor(alphas, device=device)
        agent.actor = Actors([x.actor for x in agents])
        agent.critic = Critics([x.critic for x in agents])
        agent.value = Values([x.value for x in agents], map(script_of, runs))
        for name in NETWORKS:
            network = getattr(agent, name).to(device)
            rate = getattr(agent.args, f"{name}_lr")
            optimizer = torch.optim.Adam(network.parameters(), rate)
            setattr(agent, f"{name}_optimizer", TraceableAdam(optimizer))
        agent.actor_target = copy.deepcopy(agent.actor)
        agent.critic_target = copy.deepcopy(agent.critic)
        self.mode = ForEachRun([getattr(agent, name).net.flat for name in NETWORKS])
        self.load(data)

    def load(self, data):
        """Puts all datasets into one, in which each run has its rows."""
        datasets = {id(dataset): dataset for dataset, *_ in data}
        sizes = [len(dataset["rewards"]) for dataset in datasets.values()]
        starts = dict(zip(datasets, np.cumsum([0, *sizes]), strict=False))
        self.columns = {
            name: torch.cat([x[name] for x in datasets.values()]).to(self.device)
            for name in data[0][0]
        }
        own = [(starts[id(dataset)], len(dataset["rewards"])) for dataset, *_ in data]
        self.start, self.size = torch.tensor(own, device=self.device).T[..., None]

    def sample(self):
        shape = (len(self.runs), self.agent.args.batch_size)
        # torch.compile makes the numbers float32, with 24 random bits: of a million
        # rows, some are then drawn 3% more often than others.
        uniform = torch.rand(shape, dtype=torch.float64, device=self.device)
        indices = self.start + (uniform * self.size).long()
        return {name: column[indices] for name, column in self.columns.items()}

    def update(self, batch, step):
        with self.mode:
            metrics = self.agent.update(batch, step)
        for parameter in self.mode.parameters:
            parameter.grad = None
        self.metrics |= {name: metric.detach() for name, metric in metrics.items()}

    def two_steps(self):
        """A step without the policy's update and one with it, as policy_freq is 2."""
        self.update(self.sample(), 1)
        self.update(self.sample(), 2)
        return list(self.metrics.values())

    def state(self):
        """All tensors that a step reads or writes."""
        tensors = [*self.columns.values(), self.start, self.size]
        tensors.append(self.agent.args.alpha)
        for part in vars(self.agent).values():
            if isinstance(part, nn.Module):
                tensors += [*part.parameters(), *part.buffers()]
            elif isinstance(part, TraceableAdam):
                tensors += [part.beta1_power, part.beta2_power]
                tensors += [x for state in part.states for x in state.values()]
        return tensors

    def compile(self, compiler):
        """Traces two steps, which does them, and compiles them."""
        state = self.state()
        with torch.enable_grad():
            graph = make_fx(lambda *_: self.two_steps())(*state)
        self.inputs = [tensor.detach() for tensor in state]  # the same memory
        with torch.no_grad():
            self.compiled = compiler(graph, self.inputs)

    @torch.no_grad()
    def two_compiled_steps(self):
        values = self.compiled(*self.inputs)
        self.metrics = dict(zip(self.metrics, values, strict=True))

    def capture(self):
        """Makes two compiled steps a CUDA graph, without doing them."""
        self.two_compiled_steps = as_cuda_graph(self.two_compiled_steps, self.device)

    def snapshot(self):
        """Of each run: what to evaluate, its checkpoint, and its row but for scores."""
        metrics = {name: x.flatten().tolist() for name, x in self.metrics.items()}
        networks = copy.deepcopy(self.agent.actor.net).cpu()
        for i, args in enumerate(self.runs):
            networks.copy_to(i, self.actor)
            actor = copy.deepcopy(self.actor)
            _, mean, std, best_return = self.data[i]
            checkpoint = {
                "args": asdict(args),
                "agent": {"actor": actor.state_dict()},
                "mean": mean,
                "std": std,
                "max_action": actor.max_action,
            }
            row = {name: x[i] for name, x in metrics.items()}
            for name in ABSENT[script_of(args)] & row.keys():
                del row[name]
            row["best_discounted_return"] = best_return
            yield (args, actor, mean, std), checkpoint, row


NETWORKS = ("critic", "value", "actor")
ABSENT = {"wpc": set(), "td3_bc": {"v", "value_loss", "weight"}, "wbc": {"lmbda"}}

# --- Evaluation -----------------------------------------------------------------------

make_envs = functools.cache(wpc.make_envs)


def evaluate_run(job):
    """The script's own evaluation, in a process of its own."""
    torch.set_num_threads(1)
    args, actor, mean, std = pickle.loads(job)
    return wpc.evaluate(make_envs(args.env, args.eval_episodes), actor, mean, std, args)


class Evaluations:
    """Evaluates the runs in other processes, and keeps the results in their folders."""

    def __init__(self, runs, pool, made_by):
        self.runs, self.pool, self.made_by = runs, pool, made_by
        self.rows, self.pending = [[] for _ in runs.runs], []
        self.most = max(1, len(os.sched_getaffinity(0)) // len(runs.runs))

    def begin(self, step, speed):
        """Begins an evaluation of all runs, when there are processes for it."""
        self.end(self.most - 1)
        jobs = []
        for job, checkpoint, row in self.runs.snapshot():
            job = pickle.dumps(job)  # else each tensor would be an open file
            row["steps_per_second"] = speed
            jobs.append((self.pool.submit(evaluate_run, job), checkpoint, row))
        self.pending.append((step, jobs))

    def end(self, left=0):
        """Writes what was found, in order; waits until no more than `left` go on."""
        while self.pending:
            step, jobs = self.pending[0]
            if len(self.pending) <= left and not all(x.done() for x, *_ in jobs):
                break
            for args, rows, job in zip(self.runs.runs, self.rows, jobs, strict=True):
                future, checkpoint, row = job
                rows.append({"step": step} | future.result() | row)
                checkpoint["evaluations"] = rows
                checkpoint["args"] |= self.made_by  # with which no script goes on
                wpc.save(Path(args.run_dir), checkpoint)
            del self.pending[0]


# --- Training -------------------------------------------------------------------------


def read_commands(path):
    """The arguments of each line of a file of commands.

    Exits with a sentence if the runs can't be trained as one.
    """
    runs = []
    pattern = r"python (?:tests/tools/compiled\.py )?(wpc|td3_bc|wbc)\.py\b(.*)"
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        sys.exit(str(error))
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        command = re.fullmatch(pattern, line)
        if not command:
            sys.exit(f'{path}: a line must begin "python wpc.py", or likewise: {line}')
        script, flags = command.groups()
        args = importlib.import_module(script).Args
        runs.append(tyro.cli(args, args=shlex.split(flags)))
        if Path(runs[-1].run_dir, "evaluations.csv").exists():
            sys.exit(f"{runs[-1].run_dir} holds a run already: name another --run-dir")
    if len({args.run_dir for args in runs}) < len(runs):
        sys.exit(f"{path}: each line must have a --run-dir of its own")
    shared = {}
    for args in runs:
        for name, value in asdict(args).items():
            if shared.setdefault(name, value) != value and name not in MAY_DIFFER:
                sys.exit(f"{path}: all runs must have the same {name}")
    if not runs or runs[0].policy_freq != 2 or runs[0].eval_freq % 2:
        sys.exit(f"{path} must have runs with policy_freq 2 and an even eval_freq")
    if runs[0].max_timesteps % runs[0].eval_freq:
        sys.exit(f"{path}: eval_freq must divide max_timesteps")
    return runs


MAY_DIFFER = ("env", "dataset", "alpha", "seed", "device", "run_dir")


def load(runs, device):
    """The runs as one, with their datasets."""
    datasets, sizes = {}, set()
    for args in runs:
        key = args.env, args.dataset
        if key in datasets:
            continue
        envs = wpc.make_envs(args.env, 1)
        states, actions = envs.single_observation_space, envs.single_action_space
        dims = states.shape[0], actions.shape[0], float(actions.high[0])
        sizes.add(dims)
        path = args.dataset or wpc.download_dataset(args.env)
        options = wpc.Args(args.env, path, discount=args.discount, device="cpu")
        datasets[key] = wpc.prepare_dataset(wpc.read_dataset(path, *dims), options)
    if len(sizes) > 1:
        sys.exit("the runs must be of one robot: make a file for each robot's commands")
    data = [datasets[args.env, args.dataset] for args in runs]
    return Runs(runs, dims, data, device)


def train(runs, evaluations, compiler=None):
    """Trains to the end; with a compiler, by a CUDA graph of what it makes."""
    args, begin = runs.runs[0], time.perf_counter()
    evaluations.begin(0, 0.0)
    runs.compile(compiler or (lambda graph, inputs: graph))
    step = 2
    evaluations.end()  # a broken environment is found early
    for evaluation in range(args.eval_freq, args.max_timesteps + 1, args.eval_freq):
        clock, first = time.perf_counter(), step
        while step < evaluation:
            runs.two_compiled_steps()
            step += 2
            if step == 10 and compiler:
                runs.capture()
        if compiler:
            torch.cuda.synchronize()
        speed = (step - first) / (time.perf_counter() - clock)
        seconds = time.perf_counter() - begin
        print(f"step {step:,} after {seconds:.0f} s, {speed:.0f} steps/s", flush=True)
        evaluations.begin(step, speed)
    evaluations.end()


def main():
    options = tyro.cli(Options, description=__doc__)
    torch.backends.cuda.matmul.allow_tf32 = options.tf32
    runs = load(read_commands(options.commands), options.device)
    torch.manual_seed(0)
    on_gpu = options.device == "cuda"
    made_by = {
        "made_by": "tests/tools/together.py",
        "trained_on": torch.cuda.get_device_name() if on_gpu else "cpu",
        "matrix_products": "tf32" if options.tf32 else "float32",
    }
    print(f"{len(runs.runs)} runs on {made_by['trained_on']}", flush=True)
    context = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(len(os.sched_getaffinity(0)), context) as pool:
            evaluations = Evaluations(runs, pool, made_by)
            train(runs, evaluations, compile_fx if on_gpu else None)
    except KeyboardInterrupt:
        sys.exit("stopped; what was evaluated is kept")


if __name__ == "__main__":
    try:
        main()
    except wpc.UserError as error:
        sys.exit(str(error))
