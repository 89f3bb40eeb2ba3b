# SPDX-License-Identifier: MIT
"""Runs a script with every training step as one graph, which is faster.

    python tests/tools/compiled.py wpc.py --env hopper-medium-v2 --alpha 2.5

Arguments, run folder and checkpoints are the script's, and a run may go on with this
tool or without it. On a CPU, `Agent.update` is compiled by torch.compile, which needs a
C++ compiler and takes about a minute the first time; results agree with the script's
but for rounding. On a GPU, sampling and update are captured as CUDA graphs, and results
should be the same to the last bit. Scripts may be edited, but `update` must do the same
in all steps that policy_freq divides, and the same in all others.
"""

import copy
import importlib
import math
import os
import sys
import tempfile
from pathlib import Path

import torch

# --- CPU: torch.compile ---------------------------------------------------------------


class TraceableAdam:
    """Stands in for a torch.optim.Adam, on its state, where torch.compile traces it."""

    def __init__(self, optimizer, device="cpu"):
        group, *others = optimizer.param_groups
        known = type(optimizer) is torch.optim.Adam and not others
        if not known or group["weight_decay"] or group["amsgrad"] or group["maximize"]:
            raise NotImplementedError("compiled.py knows Adam as the scripts have it")
        self.parameters = group["params"]
        self.lr, self.betas, self.eps = group["lr"], group["betas"], group["eps"]
        self.states = [optimizer.state[parameter] for parameter in self.parameters]
        for parameter, state in zip(self.parameters, self.states, strict=True):
            if not state:  # as Adam begins
                state["step"] = torch.tensor(0.0, dtype=torch.float32, device=device)
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
        # Multiplied as in `step`, as beta**t differs by rounding, and in float64
        t = int(self.states[0]["step"])
        self.beta1_power, self.beta2_power = (
            torch.tensor(math.prod([beta] * t), dtype=torch.float64, device=device)
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


def gathered(other_weight):
    """A script's `other_weight`: torch.compile fails on an index by randperm."""

    def with_gather(weight, advantage, batch, args):
        if args.weight == "random":
            permutation = torch.randperm(len(weight), device=weight.device)
            return weight.gather(0, permutation[:, None])
        return other_weight(weight, advantage, batch, args)

    return with_gather


def compile_update(agent, update):
    """`update` on the agent, each step one graph, with the same random numbers."""
    torch._dynamo.config.trace_autograd_ops = True  # lets backward() into the graph
    twin = copy.copy(agent)  # with the same networks and state of the optimizers
    optimizers = {k: x for k, x in vars(agent).items() if k.endswith("_optimizer")}
    for name, optimizer in optimizers.items():
        setattr(twin, name, TraceableAdam(optimizer))

    def one_step(batch, step):
        metrics = update(twin, batch, step)
        for name in optimizers:  # the critics' gradients of the policy's loss, too,
            getattr(twin, name).zero_grad()  # which then need not be computed
        return {name: metric.detach() for name, metric in metrics.items()}

    options = {"cpp_wrapper": True, "fallback_random": True}
    compiled = torch.compile(one_step, fullgraph=True, dynamic=False, options=options)
    # One graph for the steps that update the policy, one for all the others.
    freq = agent.args.policy_freq
    return lambda batch, step: compiled(batch, 1 if step % freq else freq)


# --- GPU: CUDA graphs -----------------------------------------------------------------


class Graphs:
    """Sampling and update on a GPU: first as they are, from then on as CUDA graphs."""

    def __init__(self, agent, update, sample_batch):
        self.agent, self.update, self.sample_batch = agent, update, sample_batch
        self.stream = torch.cuda.Stream()  # gradients must stay on the one stream
        self.graphs, self.metrics, self.seen = {}, {}, 0

    def one_step(self, dataset, step):
        batch = self.sample_batch(dataset, self.agent.args.batch_size)
        metrics = self.update(self.agent, batch, step)
        return {name: metric.detach() for name, metric in metrics.items()}

    def __call__(self, dataset, step):
        freq = self.agent.args.policy_freq
        kind = step % freq == 0  # one graph with the policy's update, one without
        self.seen += 1
        self.stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self.stream):
            if self.seen <= 2 * freq:
                metrics = self.one_step(dataset, step)
            else:
                if kind not in self.graphs:
                    self.capture(kind, dataset, step)
                self.graphs[kind].replay()
                metrics = self.metrics[kind]
        # Evaluation and checkpoints read on the other stream what this one has written.
        torch.cuda.current_stream().wait_stream(self.stream)
        return metrics

    def capture(self, kind, dataset, step):
        optimizers = [
            x for x in vars(self.agent).values() if isinstance(x, torch.optim.Adam)
        ]
        for optimizer in optimizers:
            optimizer.param_groups[0]["capturable"] = True
        self.graphs[kind] = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graphs[kind], stream=self.stream):
            self.metrics[kind] = self.one_step(dataset, step)
        for optimizer in optimizers:  # as in the script's own checkpoints
            optimizer.param_groups[0]["capturable"] = False


# --- The script -----------------------------------------------------------------------


def install(script):
    """From here on, agents of this script (a module) do their steps as graphs."""
    update, sample_batch, steps = script.Agent.update, script.sample_batch, {}
    if hasattr(script, "other_weight"):
        script.other_weight = gathered(script.other_weight)

    def compiled_update(agent, batch, step):
        if agent not in steps and agent.args.device.startswith("cuda"):
            steps[agent] = Graphs(agent, update, sample_batch)
        elif agent not in steps:
            print("the first steps are compiled, which may take a minute", flush=True)
            steps[agent] = compile_update(agent, update)
        return steps[agent](batch, step)

    def sample(dataset, batch_size):
        """On a GPU the dataset itself, as sampling is a part of the graph."""
        if dataset["rewards"].is_cuda:
            return dataset
        return sample_batch(dataset, batch_size)

    script.Agent.update, script.sample_batch = compiled_update, sample


def main():
    if len(sys.argv) < 2 or not Path(sys.argv[1]).is_file():
        sys.exit("name a script: python tests/tools/compiled.py wpc.py --env ...")
    cache = os.environ.get("TORCHINDUCTOR_CACHE_DIR") or tempfile.gettempdir()
    try:
        os.makedirs(cache, exist_ok=True)
    except OSError as error:
        sys.exit(
            f"set TORCHINDUCTOR_CACHE_DIR to a folder that can be written: {error}"
        )
    sys.path.insert(0, str(Path(sys.argv[1]).resolve().parent))
    script = importlib.import_module(Path(sys.argv[1]).stem)
    install(script)
    sys.argv = sys.argv[1:]
    try:
        script.main()
    except torch._dynamo.exc.BackendCompilerFailed as error:
        inductor = torch._inductor.exc
        expected = inductor.InvalidCxxCompiler, inductor.CppCompileError
        if not isinstance(error.inner_exception, expected):
            raise
        reason = str(error).split("\n")[0]
        sys.exit(
            f"{reason}: compiling needs a C++ compiler; python {sys.argv[0]} works"
        )


if __name__ == "__main__":
    main()
