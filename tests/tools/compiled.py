# SPDX-License-Identifier: MIT
"""Runs a script with its training steps as graphs, which is faster.

    python tests/tools/compiled.py wpc.py --env hopper-medium-v2 --alpha 2.5

Arguments, run folder and checkpoints are the script's, and a run may go on with this
tool or without it. Two steps are compiled as one, with their sampling, which takes
about a minute the first time and, on a CPU, needs a C++ compiler. On a GPU, what is
compiled is replayed as a CUDA graph. Results agree with the script's but for rounding;
PyTorch 2.11 also draws batches and noise in another order (2.13 keeps the script's).
Scripts may be edited, but `update` must do the same in all steps that policy_freq
divides, and the same in all others.
"""

import copy
import functools
import importlib
import math
import os
import sys
import tempfile
from pathlib import Path
from unittest import mock

import torch

# --- Two steps as one -----------------------------------------------------------------


class TraceableAdam:
    """Stands in for a torch.optim.Adam, on its state, where torch.compile traces it."""

    def __init__(self, optimizer):
        group, *others = optimizer.param_groups
        known = type(optimizer) is torch.optim.Adam and not others
        if not known or group["weight_decay"] or group["amsgrad"] or group["maximize"]:
            raise NotImplementedError("compiled.py knows Adam as the scripts have it")
        self.parameters = group["params"]
        self.lr, self.betas, self.eps = group["lr"], group["betas"], group["eps"]
        self.states = [optimizer.state[parameter] for parameter in self.parameters]
        device = self.parameters[0].device
        for parameter, state in zip(self.parameters, self.states, strict=True):
            if not state:  # as Adam begins
                state["step"] = torch.tensor(0.0, dtype=torch.float32, device=device)
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
        # In float64, as in `step`; without an axis, PyTorch 2.13 loses compiled changes
        t = int(self.states[0]["step"])
        self.beta1_power, self.beta2_power = (
            torch.tensor([math.prod([beta] * t)], dtype=torch.float64, device=device)
            for beta in self.betas
        )

    def zero_grad(self):
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self):
        beta1, beta2 = self.betas
        self.beta1_power.mul_(beta1)
        self.beta2_power.mul_(beta2)
        step_size = (self.lr / (1 - self.beta1_power)).type_as(self.parameters[0])
        bias_correction = (1 - self.beta2_power).type_as(self.parameters[0])
        for parameter, state in zip(self.parameters, self.states, strict=True):
            m, v, gradient = state["exp_avg"], state["exp_avg_sq"], parameter.grad
            state["step"].add_(1)
            m.lerp_(gradient, 1 - beta1)
            v.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
            parameter -= step_size * m / ((v / bias_correction).sqrt() + self.eps)


def thin_mm(a, b):
    """A product with a thin result, as of a first layer's gradient, in the other order:
    on an AMD EPYC, MKL then takes a half to a fifth of the time. (If you change this,
    empty the compiler's cache, which doesn't notice.)"""
    if b.shape[1] < 32 <= a.shape[0]:
        return torch.mm(b.T, a.T).T
    return NotImplemented  # as it is


def as_cuda_graph(call, device):
    """The call as a CUDA graph. It is captured here, but not done."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.device(device), torch.cuda.graph(graph):
        values = call()

    def replay():
        graph.replay()
        return values  # in the same memory each time

    return replay


def two_steps_a_call(agent, update, sample_batch):
    """A function that does every other step, with the one before it, as one graph.

    From the second call on, TorchDynamo, which looks at each input, is left out, and on
    a GPU, Python too.
    """
    torch._dynamo.config.trace_autograd_ops = True  # lets backward() into the graph
    args, twin = agent.args, copy.copy(agent)  # with the same networks and states
    on_gpu = args.device.startswith("cuda")
    optimizers, waiting, found, calls = [], [], [], {}
    for name, part in vars(agent).items():
        if name.endswith("_optimizer"):
            optimizers.append(TraceableAdam(part))
            setattr(twin, name, optimizers[-1])

    def do(dataset, steps):
        metrics = {}
        for step in steps:
            metrics |= update(twin, sample_batch(dataset, args.batch_size), step)
        for optimizer in optimizers:  # the critics' gradients of the policy's loss,
            optimizer.zero_grad()  # too, which then need not be computed
        return {name: metric.detach() for name, metric in metrics.items()}

    def inductor(graph, examples):
        options = {"cpp_wrapper": not on_gpu, "fallback_random": True}
        from torch._inductor.decomposition import decompositions  # needs its cache

        own = {} if on_gpu else {torch.ops.aten.mm.default: thin_mm}
        with mock.patch.dict(decompositions, own):
            compiled = torch._inductor.compile(graph, examples, options)

        def call(*inputs):
            found[:] = compiled, inputs
            return compiled(*inputs)

        return call

    def one_step(dataset, step):
        waiting.append(1 if step % args.policy_freq else args.policy_freq)
        evaluated = step % args.eval_freq == 0 or step == args.max_timesteps
        if len(waiting) == 1:
            return do(dataset, [waiting.pop()]) if evaluated else {}
        steps = waiting.pop(0), waiting.pop()
        if steps in calls:
            call, names = calls[steps]
            return dict(zip(names, call(), strict=True))
        print("the first steps are compiled, which may take a minute", flush=True)
        traced = torch.compile(do, backend=inductor, fullgraph=True, dynamic=False)
        metrics = traced(dataset, steps)
        compiled, inputs = found
        call = functools.partial(compiled, *inputs)
        calls[steps] = (
            as_cuda_graph(call, args.device) if on_gpu else call,
            list(metrics),
        )
        return metrics

    return one_step


# --- The script -----------------------------------------------------------------------


def install(script):
    """From here on, agents of this script (a module) do their steps as graphs."""
    update, sample_batch, steps = script.Agent.update, script.sample_batch, {}

    def compiled_update(agent, dataset, step):
        if agent not in steps:
            steps[agent] = two_steps_a_call(agent, update, sample_batch)
        return steps[agent](dataset, step)

    script.Agent.update = compiled_update
    script.sample_batch = lambda dataset, _: dataset  # sampling is a part of the steps


def main():
    if len(sys.argv) < 2 or not Path(sys.argv[1]).is_file():
        sys.exit("name a script: python tests/tools/compiled.py wpc.py --env ...")
    cache = os.environ.get("TORCHINDUCTOR_CACHE_DIR") or tempfile.gettempdir()
    try:
        os.makedirs(cache, exist_ok=True)
    except OSError as error:
        sys.exit(f"set TORCHINDUCTOR_CACHE_DIR to a folder to write to: {error}")
    sys.path.insert(0, str(Path(sys.argv[1]).resolve().parent))
    script = importlib.import_module(Path(sys.argv[1]).stem)
    install(script)
    sys.argv = sys.argv[1:]
    try:
        script.main()
    except torch._dynamo.exc.BackendCompilerFailed as error:
        reason = type(error.inner_exception).__name__
        if reason not in ("InvalidCxxCompiler", "CppCompileError"):
            raise
        sys.exit(f"compiling needs a C++ compiler; python {sys.argv[0]} needs none")


if __name__ == "__main__":
    main()
