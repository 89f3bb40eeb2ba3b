# SPDX-License-Identifier: MIT
"""--cudagraphs without a GPU: a stand-in for CUDA graphs on the CPU, as strict as they are where it matters.

While it records, a step leaves no trace: what it wrote is put back, what it made is filled with NaN. Whatever would make
the host wait for the device, and any random number from a generator that was not registered, is an error. A replay runs
the recorded operations on the recorded memory, and no line of Python. The device itself has not been tried.
"""

import signal

import pytest
import torch
from conftest import DATASET
from test_run import result
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

WAITS = ("_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "_unique2")


def tensors(tree):
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor)]


class Graph:
    """As torch.cuda.CUDAGraph."""

    replays = 0

    def register_generator_state(self, generator):
        self.generator = generator

    def replay(self):
        Graph.replays += 1
        with torch.no_grad():
            for function, args, kwargs, results in self.operations:
                for result, new in zip(results, tensors(function(*args, **kwargs))):
                    result.copy_(new)


class Recording(TorchDispatchMode):
    """As torch.cuda.graph."""

    def __init__(self, graph):
        super().__init__()
        self.graph, graph.operations = graph, []

    def __enter__(self):
        self.written, self.states = [], (self.graph.generator.get_state(), torch.get_rng_state())
        return super().__enter__()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function.namespace == "profiler":  # Adam's marks, no work
            return function(*args, **kwargs)
        name = function.overloadpacket.__name__
        assert name not in WAITS and (name != "_to_copy" or "device" not in kwargs), f"{function} waits for the device"
        if generator := kwargs.get("generator"):  # the registered one, in a wrapper of its own
            assert torch.equal(generator.get_state(), self.graph.generator.get_state())
        for argument, value in zip(function._schema.arguments, args):
            if argument.alias_info and argument.alias_info.is_write:
                self.written += [(tensor, tensor.clone()) for tensor in tensors(value)]
        results = function(*args, **kwargs)
        new = not any(r.alias_info for r in function._schema.returns)  # memory of the graph's own, no view
        self.graph.operations.append((function, args, kwargs, tensors(results) if new else []))
        return results

    def __exit__(self, *error):
        super().__exit__(*error)
        assert torch.equal(torch.get_rng_state(), self.states[1])
        self.graph.generator.set_state(self.states[0])
        with torch.no_grad():
            for tensor, before in reversed(self.written):
                tensor.copy_(before)
            for *_, results in self.graph.operations:
                for tensor in results:
                    tensor.fill_(float("nan") if tensor.is_floating_point() else 0)


@pytest.fixture
def train(script, monkeypatch, tmp_path):
    """Trains in this process and returns all that the run ends with."""
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", Recording)
    monkeypatch.setattr(Graph, "replays", 0)
    handlers = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)]

    def call(folder, **options):
        default = dict(max_timesteps=60, eval_freq=30, eval_episodes=1, log_freq=7, batch_size=32, device="cpu")
        args = script.Args(env="halfcheetah", dataset=str(DATASET), run_dir=str(tmp_path / folder), **default | options)
        args.alpha = 2.5
        script.train(args)
        end = result(tmp_path / folder)
        end[0]["args"].pop("cudagraphs")
        return end

    yield call
    for number, handler in handlers:
        signal.signal(number, handler)


@pytest.mark.parametrize("policy_freq", [1, 2, 3])
def test_replayed_steps_are_the_steps(train, policy_freq):
    assert train("graphs", cudagraphs=True, policy_freq=policy_freq) == train("eager", policy_freq=policy_freq)
    assert Graph.replays == 60 - 2 * policy_freq


@pytest.mark.parametrize("script", ["wpc"], indirect=True)
@pytest.mark.parametrize("weight", ["exponential", "random", "static"])
def test_every_weight(train, weight):
    assert train("graphs", cudagraphs=True, weight=weight) == train("eager", weight=weight)


def test_adam_can_be_captured(script):
    """What the stand-in can't see, and torch.cuda.graph refuses otherwise; fused, Adam counts its steps on the device."""
    for optimizer in script.make_networks(3, 2, script.Args(), "cpu")[1].values():
        assert all(group["capturable"] and group["fused"] for group in optimizer.param_groups)


def test_a_run_goes_on_with_graphs_or_without(train):
    eager = train("eager")
    for before, after in ((True, True), (True, False), (False, True)):
        folder = f"{before} {after}"
        train(folder, cudagraphs=before, max_timesteps=30)
        assert train(folder, cudagraphs=after) == eager
