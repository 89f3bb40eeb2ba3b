# SPDX-License-Identifier: MIT
"""Runs a script with its training steps as graphs, which is faster.

    python tests/tools/compiled.py wpc.py --env hopper-medium-v2 --alpha 2.5

Arguments, run folder and checkpoints are the script's, and a run may go on with this
tool or without it. On a CPU, two steps are compiled as one, which needs a C++ compiler
and takes about a minute the first time; results agree with the script's but for
rounding. On a GPU, sampling and update are captured as CUDA graphs, and results should
be the same to the last bit. Scripts may be edited, but `update` must do the same in all
steps that policy_freq divides, and the same in all others.
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


def two_steps_a_call(agent, update, sample_batch):
    """A function that does every other step, with the one before it, as one graph.

    From the second call on, TorchDynamo, which looks at each input, is left out.
    """
    torch._dynamo.config.trace_autograd_ops = True  # lets backward() into the graph
    args, twin = agent.args, copy.copy(agent)  # with the same networks and states
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
        options = {"cpp_wrapper": True, "fallback_random": True}
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
            compiled, inputs, names = calls[steps]
            return dict(zip(names, compiled(*inputs), strict=True))
        print("the first steps are compiled, which may take a minute", flush=True)
        traced = torch.compile(do, backend=inductor, fullgraph=True, dynamic=False)
        metrics = traced(dataset, steps)
        calls[steps] = *found, list(metrics)
        return metrics

    return one_step


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
        parts = vars(self.agent).values()
        optimizers = [x for x in parts if isinstance(x, torch.optim.Adam)]
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

    def compiled_update(agent, dataset, step):
        if agent not in steps:
            kind = Graphs if agent.args.device.startswith("cuda") else two_steps_a_call
            steps[agent] = kind(agent, update, sample_batch)
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
