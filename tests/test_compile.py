# SPDX-License-Identifier: MIT
"""--compile: the same steps as without it, but for rounding, and the same runs.

What is traced is tested for every script, weight and frequency; it is compiled to C++
for wpc.py alone, as that takes a minute.
"""

import shutil
import signal
import sys

import pytest
import torch
from conftest import (
    ROOT,
    assert_one_sentence,
    command,
    load,
    refusal,
    result,
    run,
    start,
    td3_bc,
    wait_until,
    wbc,
    wpc,
)

VARIANTS = [
    (script, {"policy_freq": n}) for script in (wpc, td3_bc, wbc) for n in (1, 2, 3)
]
VARIANTS += [(wpc, {"weight": w}) for w in ("exponential", "random", "static")]


def random_batch():
    return {
        "observations": torch.randn(32, 5).double(),
        "actions": 2 * torch.rand(32, 2).double() - 1,
        "rewards": torch.randn(32, 1).double(),
        "next_observations": torch.randn(32, 5).double(),
        "terminals": (torch.rand(32, 1) < 0.1).double(),
        "better_half": (torch.rand(32, 1) < 0.5).double(),
    }


def twenty_steps(script, args, compiled):
    """The last metrics, the last gradients, and what is saved, in float64."""
    torch.manual_seed(0)
    agent = script.Agent(5, 2, 1.0, args).double()
    update = script.compile_update(agent) if compiled else agent.update
    for step in range(1, 21):
        metrics = update(random_batch(), step)
    gradients = {
        name: p.grad for name, p in agent.named_parameters() if p.requires_grad
    }
    return metrics, gradients, script.training_state(agent)


@pytest.mark.parametrize("script, options", VARIANTS)
def test_the_traced_step_is_the_step(monkeypatch, script, options):
    real_compile = torch.compile

    def only_trace(function, options, **arguments):
        return real_compile(function, backend="eager", **arguments)

    monkeypatch.setattr(torch, "compile", only_trace)
    torch._dynamo.reset()
    args = script.Args(**options)
    if script is not wbc:
        args.alpha = 2.5
    eager = twenty_steps(script, args, compiled=False)
    traced = twenty_steps(script, args, compiled=True)
    torch.testing.assert_close(traced, eager, rtol=1e-9, atol=1e-12)


PREPARE = """
import sys
import torch
import torch._inductor.config
from torch._inductor.compile_fx import compile_fx

sys.path.insert(0, "tests")
from test_compile import twenty_steps, wpc


def run_graph(graph, *_, **__):
    return graph.forward


def prepare(graph, inputs):
    return compile_fx(graph, inputs, inner_compile=run_graph)


real_compile = torch.compile
torch.compile = lambda f, options, **others: real_compile(f, backend=prepare, **others)
torch._inductor.config.fallback_random = True
args = wpc.Args(alpha=2.5, weight="random", policy_freq=1)
eager, prepared = (twenty_steps(wpc, args, compiled) for compiled in (False, True))
torch.testing.assert_close(prepared, eager, rtol=1e-9, atol=1e-12)
"""


def test_pytorchs_compiler_takes_the_random_weight():
    """All that it does before it writes C++, in a process of its own, as it leaves
    settings behind. On an index by randperm, plain as it is, it fails."""
    process = run(sys.executable, "-c", PREPARE, cwd=ROOT)
    assert process.returncode == 0, process.stderr


def test_a_continued_adam_has_the_same_powers_of_its_betas(script):
    """To the last bit, which beta**t is not: each step rounds."""
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.Adam([parameter])
    fresh = script.TraceableAdam(optimizer)
    for _ in range(5000):
        parameter.grad = torch.ones(1)
        fresh.step()
    continued = script.TraceableAdam(optimizer)
    assert optimizer.state[parameter]["step"] == 5000
    assert torch.equal(continued.beta1_power, fresh.beta1_power)
    assert torch.equal(continued.beta2_power, fresh.beta2_power)
    assert continued.beta2_power.item() == pytest.approx(0.999**5000)
    assert continued.beta2_power.item() != 0.999**5000


def assert_equal_but_for_rounding(run_dir, other):
    ours, theirs = load(run_dir), load(other)
    for key in ("networks", "optimizers"):
        torch.testing.assert_close(ours[key], theirs[key], rtol=1e-3, atol=1e-4)
    assert torch.equal(ours["rng_state"], theirs["rng_state"])


def test_compiled_runs(finished, run_dir, tmp_path):
    """One test, as the first run compiles for a minute and the others use its code."""
    compiled, stopped, switched = (tmp_path / name for name in "abc")
    process = run(*command("wpc", "--run-dir", compiled, "--compile"))
    assert process.returncode == 0 and process.stderr == "", process.stderr
    assert "compiling, which takes about a minute" in process.stdout
    assert_equal_but_for_rounding(compiled, finished)
    assert result(compiled) != result(finished)  # or nothing was compiled

    # Stopped by a signal and continued, a run ends as it would have.
    process = start(*command("wpc", "--run-dir", stopped, "--compile"))
    wait_until((stopped / "checkpoint.pt").exists, process)
    process.send_signal(signal.SIGTERM)
    process.communicate()
    assert load(stopped)["step"] < 60
    process = run(*command("wpc")[:2], "--run-dir", stopped)
    assert process.returncode == 0, process.stderr
    assert result(stopped) == result(compiled)

    # From step 60 on, one run is compiled and another is no longer.
    shutil.copytree(compiled, switched)
    for folder, flag in ((run_dir, "--compile"), (switched, "--no-compile")):
        line = command("wpc", "--run-dir", folder, flag, "--max-timesteps", 70)
        process = run(*line)
        assert process.returncode == 0, process.stderr
    assert_equal_but_for_rounding(run_dir, switched)


@pytest.mark.parametrize("compiler", ["no_such_compiler", "false"])
def test_without_a_compiler(monkeypatch, tmp_path, compiler):
    monkeypatch.setenv("CXX", compiler)
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "empty"))
    process = run(*command("wpc", "--run-dir", tmp_path / "run", "--compile"))
    assert_one_sentence(process, "--compile failed (")
    assert not (tmp_path / "run/checkpoint.pt").exists()


def test_not_on_a_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    line = command("wpc", "--compile", "--device", "cuda")
    assert "--compile is for CPUs" in refusal(wpc, *line)
