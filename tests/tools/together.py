# SPDX-License-Identifier: MIT
"""Trains many runs at once on one GPU, with evaluation on the CPU's cores.

    python tests/tools/experiments.py list table1 --runs runs/paper > commands.txt
    python tests/tools/together.py commands.txt

A step of one run leaves a GPU idle nearly all of the time. Here all R runs become one:
a network's parameters are (R, P), a batch is (R, B, width), and each step is `update`
of wpc.py, in which every mean over a batch is taken for each run by itself. TD3+BC is
wPC with weight 1, and wBC is wPC with alpha 0; smaller robots are padded with zeros.
The step is traced, compiled by torch.compile and captured as a CUDA graph.

Networks start as the script starts them with the run's seed. Batches and noise are
drawn for all runs together, so a run is not the one that the script makes with the same
seed, but one as likely. Each run leaves args.json and evaluations.csv, as its script
does, and a checkpoint.pt with its policy, for play.py; it can't be continued.
"""

import copy
import csv
import hashlib
import importlib
import io
import itertools
import json
import multiprocessing
import re
import shlex
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from torch._inductor.compile_fx import compile_fx
from torch.fx.experimental.proxy_tensor import make_fx
from torch.overrides import TorchFunctionMode
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[2]))
from compiled import TraceableAdam
from make_dataset import usable_cpus

import wpc

CYCLE = 10  # steps in a CUDA graph


@dataclass
class Options:
    commands: tyro.conf.Positional[Path]
    """file of lines such as "python wpc.py --env ... --run-dir ...", a run each"""
    seconds: float = float("inf")
    """stop training after this time; what was evaluated until then is kept"""
    workers: int = field(default_factory=lambda: max(1, usable_cpus() - 2))
    """number of processes that evaluate; by default two fewer than there are CPUs"""
    tf32: bool = False
    """multiply matrices in TF32, which is faster, with 10 instead of 23 bits"""
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    """where to train"""
    compile: bool = True
    """compile the traced steps"""


# --- Many networks as one -------------------------------------------------------------


class Networks(nn.Module):
    """R networks of the script's `mlp` as one, with parameters (R, P).

    Inputs and outputs are as wide as `widths` says. Where a network is narrower, it has
    zeros in place of weights, which stay zero, as its inputs there are zero;
    `inputs[i]` are the places of network i's own inputs.
    """

    def __init__(self, networks, widths, inputs):
        super().__init__()
        ends = [widths[0], 256, 256, widths[1]]
        self.shapes = list(itertools.pairwise(ends))
        self.inputs = inputs
        rows = [self.flatten(i, network) for i, network in enumerate(networks)]
        self.flat = nn.Parameter(torch.stack(rows))

    def own(self, i, network):
        """The layers of network i, and where their inputs stand among all inputs."""
        layers = [x for x in network if isinstance(x, nn.Linear)]
        places = [self.inputs[i], *(range(x.in_features) for x in layers[1:])]
        return zip(layers, map(torch.tensor, map(list, places)), strict=True)

    def flatten(self, i, network):
        parts = []
        for (layer, places), shape in zip(
            self.own(i, network), self.shapes, strict=True
        ):
            weight, bias = torch.zeros(shape), torch.zeros(shape[1])
            weight[places, : layer.out_features] = layer.weight.detach().T
            bias[: layer.out_features] = layer.bias.detach()
            parts += [weight.flatten(), bias]
        return torch.cat(parts)

    def layers(self, flat):
        """Weights (R, in, out) and biases (R, 1, out) of each layer."""
        start = 0
        for width, height in self.shapes:
            middle, end = start + width * height, start + (width + 1) * height
            weight = flat[:, start:middle].view(-1, width, height)
            yield weight, flat[:, None, middle:end]
            start = end

    def forward(self, x):
        """(R, B, in) to (R, B, out); of the first networks only, if x is of fewer."""
        (w1, b1), (w2, b2), (w3, b3) = self.layers(self.flat[: len(x)])
        x = F.relu(torch.bmm(x, w1) + b1)
        x = F.relu(torch.bmm(x, w2) + b2)
        return torch.bmm(x, w3) + b3

    def copy_to(self, i, network):
        """Writes network i of R into one of the script's."""
        flat = self.flat.detach()[i : i + 1].cpu()
        for (layer, places), (weight, bias) in zip(
            self.own(i, network), self.layers(flat), strict=True
        ):
            layer.weight.data.copy_(weight[0, places, : layer.out_features].T)
            layer.bias.data.copy_(bias[0, 0, : layer.out_features])


class Critics(nn.Module):
    """The twin critics of R runs, as 2 R networks."""

    def __init__(self, critics, widths, inputs):
        super().__init__()
        networks = [critic.q1_net for critic in critics]
        networks += [critic.q2_net for critic in critics]
        self.net = Networks(networks, widths, inputs + inputs)

    def forward(self, s, a):
        sa = torch.cat([s, a], dim=-1)
        return self.net(torch.cat([sa, sa])).chunk(2)

    def q1(self, s, a):
        return self.net(torch.cat([s, a], dim=-1))


class ForEachRun(TorchFunctionMode):
    """In it, a mean over (R, B, width) is one for each run, (R, 1, 1).

    So are losses; their sum gives each run the gradient of its own. Gradients are
    computed for those parameters only that the next optimizer step waits for.
    """

    def __init__(self, parameters, action_dims):
        super().__init__()
        self.parameters = parameters
        self.share = action_dims / action_dims.max()  # of actions that are no padding

    def __torch_function__(self, function, types, args=(), kwargs=None):
        if function is torch.Tensor.mean and args[0].ndim == 3:
            mean = args[0].mean(dim=(1, 2), keepdim=True)
            return mean if args[0].shape[-1] == 1 else mean / self.share
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


def weight_of_each_run(kinds, device="cpu"):
    """`other_weight` of wpc.py for runs of the given kinds of weight."""
    own = {}
    for kind in sorted(set(kinds)):
        own[kind] = torch.tensor([[[k == kind]] for k in kinds], device=device)
    WEIGHT_MASKS[:] = own.values()

    def other_weight(weight, advantage, batch, args):
        results = {"binary": weight, "one": torch.ones_like(weight)}
        if "random" in own:
            permutation = torch.rand_like(weight).argsort(dim=1)
            results["random"] = weight.gather(1, permutation)
        for kind in own.keys() - results.keys():
            kind_args = replace(args, weight=kind)
            results[kind] = WPC_WEIGHT(weight, advantage, batch, kind_args)
        for kind, mask in own.items():
            weight = torch.where(mask, results[kind], weight)
        return weight

    return other_weight


WPC_WEIGHT = wpc.other_weight
WEIGHT_MASKS = []


# --- All runs as one ------------------------------------------------------------------


def system(args):
    """Weight and alpha with which wpc.py does what the arguments' own script does."""
    if hasattr(args, "weight"):
        return args.weight, args.alpha
    return ("one", args.alpha) if hasattr(args, "alpha") else ("binary", 0.0)


class Runs:
    """R runs that are trained as one. `dims` has each run's (state_dim, action_dim,
    max_action), `data` what prepare_dataset returns."""

    def __init__(self, runs, dims, data, device):
        self.runs, self.dims, self.data, self.device = runs, dims, data, device
        self.metrics, self.graph = {}, None
        self.rows = [[] for _ in runs]  # of each run: (step, evaluation, other columns)
        self.jobs = [[] for _ in runs]  # of each run: (evaluation, what is evaluated)
        kinds, alphas = zip(*map(system, runs), strict=True)
        wpc.other_weight = weight_of_each_run(kinds, device)

        agents = []
        for args, own in zip(runs, dims, strict=True):
            torch.manual_seed(args.seed)
            agents.append(wpc.Agent(*own, wpc.Args(seed=args.seed, device="cpu")))
        self.actors = [agent.actor for agent in agents]
        self.agent = agent = copy.copy(agents[0])
        agent.args = wpc.Args(**shared(runs))
        agent.args.alpha = torch.tensor(alphas, device=device).view(-1, 1, 1)
        agent.args.weight = "each run's"
        agent.actor = copy.deepcopy(self.actors[0])
        state_dim, action_dim = max(x[0] for x in dims), max(x[1] for x in dims)
        states = [list(range(own[0])) for own in dims]
        inputs = [  # of a critic: the own states, and the own actions after all states
            [*range(own[0]), *range(state_dim, state_dim + own[1])] for own in dims
        ]
        networks = [a.actor.net for a in agents]
        agent.actor.net = Networks(networks, (state_dim, action_dim), states)
        agent.value = copy.deepcopy(agents[0].value)
        networks = [a.value.net for a in agents]
        agent.value.net = Networks(networks, (state_dim, 1), states)
        critics = [a.critic for a in agents]
        agent.critic = Critics(critics, (state_dim + action_dim, 1), inputs)
        for name, rate in RATES.items():
            network = getattr(agent, name).to(device)
            optimizer = torch.optim.Adam(
                network.parameters(), getattr(agent.args, rate)
            )
            setattr(agent, f"{name}_optimizer", TraceableAdam(optimizer, device))
        agent.actor_target = copy.deepcopy(agent.actor)
        agent.critic_target = copy.deepcopy(agent.critic)

        parameters = [getattr(agent, n).net.flat for n in RATES]
        action_dims = torch.tensor([[[own[1]]] for own in dims], device=device)
        self.mode = ForEachRun(parameters, action_dims)
        self.load(data)

    def load(self, data):
        """Puts all datasets into one, in which each run has its rows."""
        datasets = {id(dataset): dataset for dataset, *_ in data}
        widths = {}
        for dataset in datasets.values():
            for name, column in dataset.items():
                widths[name] = max(widths.get(name, 0), column.shape[1])
        starts, columns, rows = {}, {name: [] for name in widths}, 0
        for key, dataset in datasets.items():
            starts[key], size = rows, len(dataset["rewards"])
            rows += size
            for name, width in widths.items():
                column = dataset.get(name, torch.zeros(size, width))
                columns[name].append(F.pad(column, (0, width - column.shape[1])))
        self.columns = {k: torch.cat(x).to(self.device) for k, x in columns.items()}
        start = [[starts[id(dataset)]] for dataset, *_ in data]
        size = [[len(dataset["rewards"])] for dataset, *_ in data]
        self.start = torch.tensor(start, device=self.device)
        self.size = torch.tensor(size, device=self.device)

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
        tensors += [self.mode.share, self.agent.args.alpha, *WEIGHT_MASKS]
        for part in vars(self.agent).values():
            if isinstance(part, nn.Module):
                tensors += part.parameters()
            elif isinstance(part, TraceableAdam):
                tensors += [part.beta1_power, part.beta2_power]
                tensors += [x for state in part.states for x in state.values()]
        return tensors

    def compile(self, compiler=compile_fx):
        """Traces two steps, which does them, and compiles them."""
        state = self.state()
        with torch.enable_grad():
            graph = make_fx(lambda *_: self.two_steps())(*state)
        self.inputs = [tensor.detach() for tensor in state]  # the same memory
        self.metrics = dict.fromkeys(self.metrics)
        with torch.no_grad():
            self.compiled = compiler(graph, self.inputs)

    @torch.no_grad()
    def do(self, steps):
        for _ in range(steps // 2):
            values = self.compiled(*self.inputs)
        self.metrics = dict(zip(self.metrics, values, strict=True))

    def cycle(self):
        """Does CYCLE steps."""
        if self.graph is None:
            self.do(CYCLE)
        else:
            self.graph.replay()

    def capture(self):
        """From here on, a cycle is a CUDA graph."""
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            self.do(CYCLE)

    def snapshot(self):
        """Of each run: what `evaluate_run` needs, and its row so far."""
        metrics = {
            name: metric.flatten().tolist()
            for name, metric in self.metrics.items()
            if metric is not None
        }
        network = copy.deepcopy(self.agent.actor.net).cpu()
        for i, args in enumerate(self.runs):
            network.copy_to(i, self.actors[i].net)
            state = self.actors[i].state_dict().items()
            actor = {name: tensor.numpy().copy() for name, tensor in state}
            _, mean, std, best_return = self.data[i]
            row = {name: metric[i] for name, metric in metrics.items()}
            for name in ABSENT[type(args).__module__] & row.keys():
                del row[name]
            job = (args, self.dims[i], actor, mean.numpy(), std.numpy())
            yield job, {"best_discounted_return": best_return} | row


def shared(runs):
    """The arguments that all runs have in common, also those only some scripts have."""
    return {k: v for args in runs for k, v in asdict(args).items() if k in SHARED}


SHARED = ("batch_size", "discount", "tau", "policy_noise", "noise_clip", "policy_freq")
SHARED += ("actor_lr", "critic_lr", "value_lr", "beta")
RATES = {"critic": "critic_lr", "value": "value_lr", "actor": "actor_lr"}
ABSENT = {"wpc": set(), "td3_bc": {"v", "value_loss", "weight"}, "wbc": {"lmbda"}}

# --- Evaluation -----------------------------------------------------------------------

ENVS = {}


def evaluate_run(args, dims, actor, mean, std):
    """The script's own evaluation, in a process of its own."""
    torch.set_num_threads(1)
    key = args.env, args.eval_episodes
    if key not in ENVS:
        ENVS[key] = wpc.make_envs(args.env, args.eval_episodes)
    network = wpc.Actor(*dims)
    network.load_state_dict({k: torch.from_numpy(x) for k, x in actor.items()})
    mean, std = torch.from_numpy(mean), torch.from_numpy(std)
    return wpc.evaluate(ENVS[key], network, mean, std, args)


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
    for name in (*SHARED, "eval_freq"):
        if len({getattr(args, name) for args in runs if hasattr(args, name)}) > 1:
            sys.exit(f"{path}: all runs must have the same {name}")
    if not runs or runs[0].policy_freq != 2 or runs[0].eval_freq % CYCLE:
        sys.exit(
            f"{path} must have runs with policy_freq 2 and an eval_freq that {CYCLE} "
            "divides"
        )
    if any(args.max_timesteps % args.eval_freq for args in runs):
        sys.exit(f"{path}: eval_freq must divide each run's max_timesteps")
    return runs


def load(runs, device):
    """The runs as one, with their datasets."""
    data, dims = {}, {}
    for args in runs:
        if args.env not in dims:
            envs = wpc.make_envs(args.env, 1)
            states, actions = envs.single_observation_space, envs.single_action_space
            dims[args.env] = states.shape[0], actions.shape[0], float(actions.high[0])
        path = args.dataset or wpc.download_dataset(args.env)
        if path not in data:
            # With the static weight's column, whether a run needs it or not
            options = wpc.Args(args.env, path, discount=args.discount, device="cpu")
            options.weight = "static"
            arrays = wpc.read_dataset(path, *dims[args.env])
            data[path] = wpc.prepare_dataset(arrays, options)
    if len({max_action for _, _, max_action in dims.values()}) > 1:
        sys.exit("the robots' actions must all have the same bounds")
    own_dims = [dims[args.env] for args in runs]
    own_data = [data[args.dataset or wpc.download_dataset(args.env)] for args in runs]
    return Runs(runs, own_dims, own_data, device)


def succeeded(future):
    return future.done() and not future.exception()


def write_runs(runs, made_by):
    """Writes what each run leaves, as far as it is evaluated."""
    for args, rows, jobs in zip(runs.runs, runs.rows, runs.jobs, strict=True):
        done = [
            {"step": step} | future.result() | row
            for step, future, row in rows
            if succeeded(future)
        ]
        if not done:
            continue
        folder = Path(args.run_dir)
        folder.mkdir(parents=True, exist_ok=True)
        record = json.dumps(asdict(args) | made_by, indent=2)
        wpc.write_file(folder / "args.json", record.encode())

        table = io.StringIO()
        writer = csv.DictWriter(table, done[-1], lineterminator="\n")
        writer.writeheader()
        writer.writerows(done)
        wpc.write_file(folder / "evaluations.csv", table.getvalue().encode())

        evaluated = [i for i, (future, _) in enumerate(jobs) if succeeded(future)]
        del jobs[: evaluated[-1]]  # so that the first is the last that was evaluated
        _, (*_, max_action), actor, mean, std = jobs[0][1]
        checkpoint = {
            "args": asdict(args) | {"made_by": "together.py"},  # so no script goes on
            "agent": {"actor": {k: torch.from_numpy(x) for k, x in actor.items()}},
            "mean": torch.from_numpy(mean),
            "std": torch.from_numpy(std),
            "max_action": max_action,
        }
        content = io.BytesIO()
        torch.save(checkpoint, content)
        wpc.write_file(folder / "checkpoint.pt", content.getvalue())


def train(runs, options, pool, made_by):
    """Trains to the largest max_timesteps; a run is evaluated up to its own."""
    begin, waiting = time.perf_counter(), []

    def submit(step, speed):
        for i, (job, row) in enumerate(runs.snapshot()):
            if step <= runs.runs[i].max_timesteps:
                waiting.append(pool.submit(evaluate_run, *job))
                row["steps_per_second"] = speed
                runs.rows[i].append((step, waiting[-1], row))
                runs.jobs[i].append((waiting[-1], job))

    def wait(most):
        """Until at most so many evaluations are to come."""
        while len(waiting) > most:
            waiting.pop(0).result()

    submit(0, 0.0)
    runs.compile(compile_fx if options.compile else lambda graph, inputs: graph)
    runs.do(CYCLE - 2)
    step = CYCLE
    if options.device == "cuda":
        runs.capture()
    wait(0)
    write_runs(runs, made_by)
    print(f"compiled after {time.perf_counter() - begin:.0f} s", flush=True)
    eval_freq = runs.runs[0].eval_freq
    last = max(args.max_timesteps for args in runs.runs)
    clock = time.perf_counter()
    for evaluation in tqdm(range(eval_freq, last + 1, eval_freq), disable=None):
        begin_step = step
        while step + CYCLE <= evaluation:
            runs.cycle()
            step += CYCLE
        if options.device == "cuda":
            torch.cuda.synchronize()
        now = time.perf_counter()
        speed = (step - begin_step) / (now - clock)
        submit(evaluation, speed)
        if evaluation % (10 * eval_freq) == 0:
            write_runs(runs, made_by)
            print(
                f"step {evaluation:,} after {now - begin:.0f} s, {speed:.0f} steps/s "
                f"of {len(runs.runs)} runs, {len(waiting)} evaluations to come",
                flush=True,
            )
        if now - begin > options.seconds:
            break
        wait(4 * len(runs.runs))
        clock = time.perf_counter()
    wait(0)


def main():
    options = tyro.cli(Options, description=__doc__)
    torch.backends.cuda.matmul.allow_tf32 = options.tf32
    runs = load(read_commands(options.commands), options.device)
    torch.manual_seed(0)
    on_gpu = options.device == "cuda"
    made_by = {
        "made_by": "tests/tools/together.py",
        "script_sha256": hashlib.sha256(wpc.SCRIPT.read_bytes()).hexdigest(),
        **{x.__name__: x.__version__ for x in (torch, gym, mujoco, np)},
        "trained_on": torch.cuda.get_device_name() if on_gpu else "cpu",
        "matrix_products": "tf32" if options.tf32 else "float32",
    }
    print(f"{len(runs.runs)} runs on {made_by['trained_on']}", flush=True)
    context = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(options.workers, context) as pool:
            train(runs, options, pool, made_by)
    except KeyboardInterrupt:
        sys.exit("stopped; what was evaluated is kept")
    finally:  # when the pool has ended what it had begun
        write_runs(runs, made_by)


if __name__ == "__main__":
    try:
        main()
    except wpc.UserError as error:
        sys.exit(str(error))
