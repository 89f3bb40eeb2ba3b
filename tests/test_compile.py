# SPDX-License-Identifier: MIT
"""tests/tools/compiled.py: the same steps as the scripts' own, but for rounding, and
the same runs.

What is traced is tested for every script, weight and frequency; it is compiled to C++
for wpc.py alone, as that takes a minute.
"""

import contextlib
import copy
import importlib
import sys
import types

import pytest
import torch
from conftest import (
    DATASET,
    ROOT,
    SCRIPTS,
    as_bits,
    assert_one_sentence,
    command,
    load,
    networks,
    read_rows,
    run,
    run_here,
    start,
    td3_bc,
    wait_until,
    wbc,
    wpc,
    wpc_with,
)
from torch._inductor.decomposition import decompositions
from torch._inductor.exc import InductorError

sys.path.insert(0, str(ROOT / "tests/tools"))
compiled = importlib.import_module("compiled")
benchmark = importlib.import_module("benchmark")

VARIANTS = [
    (script, {"policy_freq": n}) for script in (wpc, td3_bc, wbc) for n in (2, 3)
]
VARIANTS += [(wpc, {"policy_freq": 1})]
VARIANTS += [(wpc_with(w), {}) for w in ("exponential", "random", "static")]


@pytest.fixture
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def random_batch():
    return {
        "observations": torch.randn(32, 5),
        "actions": 2 * torch.rand(32, 2) - 1,
        "rewards": torch.randn(32, 1),
        "next_observations": torch.randn(32, 5),
        "terminals": (torch.rand(32, 1) < 0.1).to(torch.get_default_dtype()),
        "better_half": (torch.rand(32, 1) < 0.5).to(torch.get_default_dtype()),
    }


def state(agent):
    return {k: x.state_dict() for k, x in vars(agent).items() if k != "args"}


def one_by_one(agent, update, sample_batch):
    """The script's own steps, called as compiled ones."""
    return lambda dataset, step: update(agent, sample_batch(dataset, 32), step)


def do_steps(script, args, make_steps=one_by_one, kept=(21,), last=21):
    """The metrics so far, what is saved and the random state after the steps `kept`."""
    torch.manual_seed(0)
    agent = script.Agent(5, 2, 1.0, args)
    steps = make_steps(agent, script.Agent.update, script.sample_batch)
    dataset = {k: x.to(args.device) for k, x in random_batch().items()}
    metrics, found = {}, []
    for step in range(1, last + 1):
        metrics |= steps(dataset, step)
        if step in kept:
            values = {name: metric.item() for name, metric in metrics.items()}
            saved = copy.deepcopy(state(agent))
            found.append((values, saved, torch.get_rng_state()))
    return found


@pytest.fixture
def traced(monkeypatch):
    """What is traced is not compiled; the steps that the tool did itself, so far."""
    done = []

    def as_it_is(graph, *_):
        done.append(graph)
        return graph.forward

    monkeypatch.setattr(torch._inductor, "compile", as_it_is)
    torch._dynamo.reset()
    return done


@pytest.mark.parametrize("script, options", VARIANTS)
def test_the_traced_step_is_the_step(float64, traced, script, options):
    args = script.Args(device="cpu", batch_size=32, max_timesteps=21, **options)
    eager = do_steps(script, args)
    ours = do_steps(script, args, compiled.two_steps_a_call)
    torch.testing.assert_close(ours, eager, rtol=1e-9, atol=1e-12)
    # Without and with the policy's update; with policy_freq 3 it comes first or second
    assert len(traced) == {1: 1, 2: 1, 3: 3}[args.policy_freq]


@pytest.mark.parametrize("eval_freq", [1, 4, 5])
def test_no_step_waits_while_the_policy_is_evaluated(float64, traced, eval_freq):
    """Where the script evaluates and saves, all is as it is after that step."""
    args = td3_bc.Args(
        device="cpu", batch_size=32, eval_freq=eval_freq, max_timesteps=13
    )
    # From step 2 on, as the script's Adam of the actor is empty before its first step
    kept = [step for step in range(2, 14) if step % eval_freq == 0 or step == 13]
    found = [
        do_steps(td3_bc, args, make_steps, kept, last=13)
        for make_steps in (one_by_one, compiled.two_steps_a_call)
    ]
    torch.testing.assert_close(*found, rtol=1e-9, atol=1e-12)
    assert bool(traced) == (eval_freq > 1)


def test_a_continued_adam_has_the_same_powers_of_its_betas():
    """To the last bit, which beta**t is not: each step rounds."""
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.Adam([parameter])
    fresh = compiled.TraceableAdam(optimizer)
    for _ in range(5000):
        parameter.grad = torch.ones(1)
        fresh.step()
    continued = compiled.TraceableAdam(optimizer)
    assert optimizer.state[parameter]["step"] == 5000
    assert torch.equal(continued.beta1_power, fresh.beta1_power)
    assert torch.equal(continued.beta2_power, fresh.beta2_power)
    assert continued.beta2_power.item() == pytest.approx(0.999**5000)
    assert continued.beta2_power.item() != 0.999**5000


OTHER_ADAMS = [("Adam", {x: True}) for x in ("weight_decay", "amsgrad", "maximize")]
OTHER_ADAMS += [("Adam", {}), ("AdamW", {}), ("NAdam", {})]


@pytest.mark.parametrize("kind, options", OTHER_ADAMS)
def test_another_adam_is_refused(kind, options):
    parameters = torch.nn.Linear(2, 1).parameters()
    if (kind, options) == ("Adam", {}):
        parameters = [{"params": x} for x in parameters]  # two groups
    optimizer = getattr(torch.optim, kind)(parameters, **options)
    with pytest.raises(NotImplementedError):
        compiled.TraceableAdam(optimizer)


def compiled_command(*arguments):
    python, script, *flags = command("wpc", *arguments)
    return [python, str(ROOT / "tests/tools/compiled.py"), script, *flags]


def assert_equal_but_for_rounding(run_dir, other):
    ours, theirs = load(run_dir), load(other)
    torch.testing.assert_close(ours["agent"], theirs["agent"], rtol=1e-3, atol=1e-4)
    assert torch.equal(ours["rng_state"], theirs["rng_state"])


def test_compiled_runs(tmp_path):
    """One test, as the first run compiles for a minute and the others use its code."""
    plain, whole, killed = (tmp_path / name for name in "abc")
    run_here(wpc, *command("wpc", "--run-dir", plain))
    process = run(*compiled_command("--run-dir", whole))
    assert process.returncode == 0, process.stderr
    assert_equal_but_for_rounding(whole, plain)
    assert read_rows(whole) != read_rows(plain)  # or nothing was compiled

    # Killed and continued, a run ends as it would have.
    process = start(*compiled_command("--run-dir", killed))
    wait_until((killed / "checkpoint.pt").exists, process)
    process.kill()
    process.communicate()
    assert load(killed)["step"] < 60
    process = run(*compiled_command("--run-dir", killed))
    assert process.returncode == 0, process.stderr
    assert as_bits(load(killed)) == as_bits(load(whole))
    assert read_rows(killed) == read_rows(whole)

    # From step 60 on, the run goes on without the tool.
    for folder in (plain, whole):
        line = command("wpc", "--run-dir", folder, "--max-timesteps", 70)
        run_here(wpc, *line)
    assert_equal_but_for_rounding(whole, plain)


@pytest.mark.parametrize("first", [5, 6])
def test_a_plain_run_goes_on_compiled(float64, traced, script, first):
    """At any step, with Adam's state as the script's own steps have left it."""
    args, dataset = script.Args(device="cpu", batch_size=32), random_batch()
    agents = []
    for compiles in (False, True):
        torch.manual_seed(0)
        agent = script.Agent(5, 2, 1.0, args)
        functions = script.Agent.update, script.sample_batch
        steps = one_by_one(agent, *functions)
        for step in range(1, first + 6):
            if compiles and step == first:
                for name in ("actor", "critic", "value"):  # as in a new process
                    getattr(agent, name, agent.actor).zero_grad()
                steps = compiled.two_steps_a_call(agent, *functions)
            steps(dataset, step)
        agents.append((state(agent), torch.get_rng_state()))
    torch.testing.assert_close(*agents, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("compiler", ["no_such_compiler", "false"])
def test_without_a_compiler(monkeypatch, tmp_path, compiler):
    monkeypatch.setenv("CXX", compiler)
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "empty"))
    process = run(*compiled_command("--run-dir", tmp_path / "run"))
    assert_one_sentence(process, "compiling needs a C++ compiler")


def test_where_the_cache_cannot_be_written(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "file/cache"))
    process = run(*compiled_command("--run-dir", tmp_path / "run"))
    assert_one_sentence(process, "TORCHINDUCTOR_CACHE_DIR")


def test_other_failures_of_the_compiler_keep_their_traceback(monkeypatch, tmp_path):
    """Such as what it can't compile in an edited script."""
    error = InductorError(ValueError("unheard of"), None)

    def main():
        raise error

    script = types.SimpleNamespace(main=main)
    monkeypatch.setattr(compiled, "install", lambda _: None)
    monkeypatch.setattr(compiled.importlib, "import_module", lambda _: script)
    monkeypatch.setattr(sys, "argv", ["compiled.py", str(ROOT / "wpc.py")])
    with pytest.raises(InductorError, match="unheard of"):
        compiled.main()


@pytest.mark.parametrize("arguments", [[], ["nothing.py"]])
def test_a_script_must_be_named(arguments):
    process = run(sys.executable, ROOT / "tests/tools/compiled.py", *arguments)
    assert_one_sentence(process, "name a script: python tests/tools/compiled.py wpc.py")


def test_the_script_that_is_named_is_run(tmp_path):
    """A copy elsewhere is that copy, not the script of its name here."""
    text = (ROOT / "wpc.py").read_text().replace("The policy maximises Q", "My own")
    (tmp_path / "wpc.py").write_text(text)
    tool = ROOT / "tests/tools/compiled.py"
    process = run(sys.executable, tool, tmp_path / "wpc.py", "--help")
    assert process.returncode == 0 and "My own, and a constraint" in process.stdout


def test_what_a_script_does_otherwise(monkeypatch, script):
    """A step gets the dataset, as it samples itself."""
    done = []

    class Agent:
        update = script.Agent.update

    def make_steps(agent, update, sample_batch):
        assert sample_batch is script.sample_batch
        return lambda dataset, step: done.append((update, dataset, step))

    module = types.SimpleNamespace(**vars(script) | {"Agent": Agent})
    monkeypatch.setattr(compiled, "two_steps_a_call", make_steps)
    compiled.install(module)
    dataset = {"rewards": torch.ones(9)}
    assert module.sample_batch(dataset, 4) is dataset
    Agent().update(dataset, 7)
    assert done == [(script.Agent.update, dataset, 7)]


def test_thin_products_are_computed_in_the_other_order(monkeypatch):
    mm, used = torch.ops.aten.mm.default, []

    def compile_it(graph, *_):
        used.append(decompositions[mm])
        return graph.forward

    monkeypatch.setattr(torch._inductor, "compile", compile_it)
    torch._dynamo.reset()
    do_steps(wpc, wpc.Args(device="cpu", batch_size=32), compiled.two_steps_a_call)
    assert used == [compiled.thin_mm]
    assert decompositions[mm] is not compiled.thin_mm  # for what others compile
    a, thin, wide = torch.randn(40, 50), torch.randn(50, 3), torch.randn(50, 40)
    torch.testing.assert_close(compiled.thin_mm(a, thin), a @ thin)
    for others in ((a, wide), (thin.T, thin)):  # as they are
        assert compiled.thin_mm(*others) is NotImplemented


class PretendGraph:
    """Stands in for a CUDA graph: while it is captured, nothing is done, and a replay
    writes its results to the memory that was theirs then."""

    captured = None

    def __enter__(self):
        PretendGraph.captured = self

    def __exit__(self, *_):
        PretendGraph.captured = None

    def replay(self):
        values = self.call(*self.inputs)
        for memory, value in zip(self.values, values, strict=True):
            memory.copy_(value)


@pytest.fixture
def pretend_cuda(monkeypatch):
    """Devices that are entered, and graphs that are captured."""
    devices, graphs = [], []

    def compile_it(graph, *_):
        def call(*inputs):
            captured = PretendGraph.captured
            if not captured:
                return graph.forward(*inputs)
            graphs.append(captured)
            captured.call, captured.inputs = graph.forward, inputs
            count = len(graph.graph.output_node().args[0])
            captured.values = [torch.zeros(()) for _ in range(count)]
            return captured.values

        return call

    def device(name):
        devices.append(name)
        return contextlib.nullcontext()

    monkeypatch.setattr(torch._inductor, "compile", compile_it)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", PretendGraph)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph: graph)
    monkeypatch.setattr(torch.cuda, "device", device)
    torch._dynamo.reset()
    return devices, graphs


@pytest.mark.parametrize("policy_freq", [1, 2, 3])
def test_on_a_gpu_the_compiled_steps_are_replayed(float64, pretend_cuda, policy_freq):
    """As far as that can be seen without one."""
    args = wpc.Args(device="cpu", batch_size=32, eval_freq=5, max_timesteps=21)
    args.policy_freq = policy_freq
    eager = do_steps(wpc, args, kept=(10, 21))

    def make_steps(agent, *functions):
        agent.args = copy.copy(args)
        agent.args.device = "cuda:1"
        return compiled.two_steps_a_call(agent, *functions)

    ours = do_steps(wpc, args, make_steps, kept=(10, 21))
    torch.testing.assert_close(ours, eager, rtol=1e-9, atol=1e-12)
    devices, graphs = pretend_cuda
    assert len(graphs) == {1: 1, 2: 2, 3: 3}[policy_freq]
    assert devices == ["cuda:1"] * len(graphs)


# benchmark.py


def test_the_benchmark_runs_the_scripts(script):
    assert benchmark.Steps(benchmark.script_steps(script)).run(2) > 0


def test_the_benchmark_compiles_what_it_calls_compiled(monkeypatch):
    updates = []
    monkeypatch.setattr(
        benchmark,
        "two_steps_a_call",
        lambda agent, update, sample: lambda dataset, step: updates.append(update),
    )
    monkeypatch.setattr(benchmark, "d3rlpy", None)
    made = benchmark.variants(benchmark.Args(), threads=1)
    for script in SCRIPTS.values():
        made[f"compiled {script.__name__}.py"].step(1)
        assert updates == [script.Agent.update]
        made[f"{script.__name__}.py"].step(1)
        assert updates.pop() and not updates


def test_a_peer_is_measured_on_the_cpu(tmp_path):
    """Where there is a GPU, the files choose it."""
    (tmp_path / "peer.py").write_text(
        "device = 'cuda'\n"
        "class TD3_BC:\n"
        "    def __init__(self, state_dim, action_dim, max_action):\n"
        "        assert str(device) == 'cpu'\n"
        "    def train(self, buffer, batch_size):\n"
        "        assert len(buffer.sample(batch_size)) == 5\n"
    )
    assert benchmark.Steps(benchmark.peer_steps(tmp_path / "peer.py")).run(2) > 0


def test_d3rlpy_is_measured():
    pytest.importorskip("d3rlpy")
    assert benchmark.Steps(benchmark.d3rlpy_steps()).run(2) > 0


def test_the_benchmarks_table(monkeypatch, capsys):
    speeds = {"wpc.py": 100.0, "compiled wpc.py": 250.0}
    made = {}
    for name, x in speeds.items():  # the first turn compiles; then three count
        turns = iter([1.0, x, 9 * x, x])
        made[name] = types.SimpleNamespace(run=lambda _, turns=turns: next(turns))
    monkeypatch.setattr(benchmark, "variants", lambda *_: made)
    monkeypatch.setattr(benchmark.os, "sched_setaffinity", lambda *_: None)
    monkeypatch.setattr(benchmark.os, "sched_getaffinity", lambda _: {0})
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    benchmark.main(benchmark.Args(rounds=3))
    lines = capsys.readouterr().out.splitlines()
    assert lines[2:] == ["| wpc.py | 1.00 | 100 |", "| compiled wpc.py | 2.50 | 250 |"]


def test_speed_is_steps_a_second(monkeypatch):
    clock = types.SimpleNamespace(perf_counter=iter([3.0, 5.0]).__next__)
    monkeypatch.setattr(benchmark, "time", clock)
    assert benchmark.Steps(lambda i: None).run(10) == 5


# On a GPU


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
@pytest.mark.parametrize("policy_freq", [1, 2, 3])
def test_steps_on_a_gpu_are_the_scripts(float64, script, policy_freq):
    options = {"policy_freq": policy_freq, "batch_size": 32, "max_timesteps": 201}
    args, states = script.Args(device="cuda", **options), []
    for make_steps in (one_by_one, compiled.two_steps_a_call):
        found = do_steps(script, args, make_steps, kept=(201,), last=201)
        states.append((found, torch.cuda.get_rng_state()))
    torch.testing.assert_close(*states, rtol=1e-7, atol=1e-10)


def test_the_scripts_agents_are_those_of_networks():
    """`state` above misses nothing: all of an agent but its arguments is saved."""
    agent = wpc.Agent(5, 2, 1.0, wpc.Args(device="cpu", dataset=str(DATASET)))
    assert len(networks(agent)) == 5 and len(state(agent)) == 8
