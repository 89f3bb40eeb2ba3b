# SPDX-License-Identifier: MIT
"""tests/tools/together.py: runs that are trained as one are the scripts' runs."""

import contextlib
import csv
import importlib
import json
import os
import pickle
import shlex
import sys
from concurrent.futures import Future

import h5py
import numpy as np
import pytest
import torch
import tyro
from conftest import DATASET, ROOT, assert_one_sentence, load, run, td3_bc, wbc, wpc

sys.path.insert(0, str(ROOT / "tests/tools"))
together = importlib.import_module("together")

DIMS = 5, 2, 1.0
OPTIONS = {"device": "cpu", "policy_noise": 0.0, "batch_size": 16}
# Without noise, which is drawn for all runs together.
OPTIONS |= {"discount": 0.9, "tau": 0.1, "actor_lr": 1e-3, "critic_lr": 1e-4}
OPTIONS |= {"value_lr": 1e-3}  # of the scripts that have it
RUNS = [  # with one of two datasets
    (td3_bc, 0, {"alpha": 1.0}),
    (wpc, 1, {"alpha": 2.5}),
    (wpc, 0, {"alpha": 0.1, "seed": 1}),
    (td3_bc, 1, {"alpha": 0.0, "seed": 2}),
    (wbc, 0, {"seed": 3}),
    (wbc, 1, {}),
]


@pytest.fixture
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def make_dataset(rows):
    state_dim, action_dim, _ = DIMS
    return {
        "observations": torch.randn(rows, state_dim),
        "actions": torch.randn(rows, action_dim).tanh(),
        "rewards": torch.randn(rows, 1),
        "next_observations": torch.randn(rows, state_dim),
        "terminals": (torch.rand(rows, 1) < 0.1).double(),
    }


def make_runs():
    torch.manual_seed(0)
    datasets = make_dataset(100), make_dataset(150)
    data = [  # mean, std and best return tell the runs apart
        (datasets[number], torch.tensor(i), torch.tensor(1), float(i))
        for i, (_, number, _) in enumerate(RUNS)
    ]
    args = []
    for script, _, options in RUNS:
        own = {k: v for k, v in OPTIONS.items() if hasattr(script.Args, k)}
        args.append(script.Args(**own, **options))
    return together.Runs(args, DIMS, data, "cpu")


def test_each_run_is_trained_as_by_its_script(float64):
    runs, singles = make_runs(), []
    for (script, _, _), args in zip(RUNS, runs.runs, strict=True):
        torch.manual_seed(args.seed)
        singles.append(script.Agent(*DIMS, args))
    for step in range(1, 11):
        indices = torch.randint(100, (len(RUNS), 16))
        rows = runs.start + indices
        runs.update({name: x[rows] for name, x in runs.columns.items()}, step)
        for i, (single, (dataset, *_)) in enumerate(
            zip(singles, runs.data, strict=True)
        ):
            batch = {name: column[indices[i]] for name, column in dataset.items()}
            for name, metric in single.update(batch, step).items():
                ours = runs.metrics[name].flatten()[i].item()
                assert ours == pytest.approx(metric.item(), rel=1e-9, abs=1e-12)
    actor, critic = wpc.Actor(*DIMS), wpc.Critic(*DIMS[:2])
    for i, single in enumerate(singles):
        for network in ("actor", "actor_target"):
            getattr(runs.agent, network).net.copy_to(i, actor)
            for key, tensor in getattr(single, network).state_dict().items():
                torch.testing.assert_close(actor.state_dict()[key], tensor)
        for network in ("critic", "critic_target"):
            for q, net in enumerate((critic.q1, critic.q2)):
                row = i + q * len(RUNS)
                getattr(runs.agent, network).net.copy_to(row, net)
            for key, tensor in getattr(single, network).state_dict().items():
                torch.testing.assert_close(critic.state_dict()[key], tensor)


def test_each_run_samples_its_own_rows(float64):
    runs = make_runs()
    rewards = torch.cat([runs.sample()["rewards"] for _ in range(100)], dim=1)
    for ours, (dataset, *_) in zip(rewards, runs.data, strict=True):
        assert set(ours.flatten().tolist()) == set(
            dataset["rewards"].flatten().tolist()
        )


def test_each_run_is_evaluated_by_itself(float64):
    """With its own policy, normalization and metrics."""
    runs, own = make_runs(), wpc.Actor(*DIMS)
    runs.two_steps()
    for i, (job, checkpoint, row) in enumerate(list(runs.snapshot())):
        args, actor, mean, std = job
        assert (args, mean, std) == (runs.runs[i], i, 1)
        assert (checkpoint["mean"], checkpoint["std"]) == (i, 1)
        runs.agent.actor.net.copy_to(i, own)
        for key, tensor in own.state_dict().items():
            assert torch.equal(actor.state_dict()[key], tensor), key
            assert torch.equal(checkpoint["agent"]["actor"][key], tensor), key
        assert row["best_discounted_return"] == i
        assert row["q"] == runs.metrics["q"].flatten()[i]


class Pool:
    """Evaluates at once, in this process."""

    def submit(self, function, job):
        future = Future()
        future.set_result(function(job))
        return future


def test_a_row_is_of_as_many_steps_as_it_says(float64, monkeypatch, tmp_path):
    runs, done = make_runs(), []
    for i, args in enumerate(runs.runs):
        args.eval_freq, args.max_timesteps = 20, 60
        args.run_dir = str(tmp_path / str(i))
    monkeypatch.setattr(runs, "compile", lambda _: done.append(2))
    monkeypatch.setattr(runs, "two_compiled_steps", lambda: done.append(2))
    monkeypatch.setattr(together, "evaluate_run", lambda _: {"mean_return": sum(done)})
    together.train(runs, together.Evaluations(runs, Pool(), {}))
    for i in range(len(RUNS)):
        rows = csv.DictReader((tmp_path / str(i) / "evaluations.csv").open())
        steps = [(int(row["step"]), float(row["mean_return"])) for row in rows]
        assert steps == [(step, step) for step in range(0, 61, 20)]


def test_evaluations_go_on_beside_training_and_are_written_in_order(
    monkeypatch, tmp_path
):
    """As many at a time as there are processes for all runs."""
    runs, futures = make_runs(), []
    for i, args in enumerate(runs.runs):
        args.run_dir = str(tmp_path / str(i))

    class Pool:
        def submit(self, *_):
            futures.append(Future())
            return futures[-1]

    def end(evaluation):
        for i, future in enumerate(futures[evaluation * n : (evaluation + 1) * n]):
            future.set_result({"mean_return": evaluation + i / 10})

    def written(i):
        path = tmp_path / str(i) / "evaluations.csv"
        rows = csv.DictReader(path.open()) if path.exists() else []
        return [(int(row["step"]), float(row["mean_return"])) for row in rows]

    n = len(RUNS)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(3 * n + 1))
    evaluations = together.Evaluations(runs, Pool(), {})
    for step in (0, 10, 20):
        evaluations.begin(step, 1.0)
    assert len(futures) == 3 * n  # none is waited for
    end(1)
    end(0)
    evaluations.begin(30, 1.0)
    assert written(n - 1) == [(0, (n - 1) / 10), (10, 1 + (n - 1) / 10)]
    end(3)
    end(2)
    evaluations.end()
    assert [written(i) for i in range(n)] == [
        [(10 * k, k + i / 10) for k in range(4)] for i in range(n)
    ]


def test_the_traced_steps_are_the_steps(float64):
    plain, traced = make_runs(), make_runs()
    torch.manual_seed(1)
    for _ in range(6):
        plain.two_steps()
    torch.manual_seed(1)
    traced.compile(lambda graph, inputs: graph)
    for _ in range(5):
        traced.two_compiled_steps()
    for name, network in traced.agent.actor.named_parameters():
        expected = plain.agent.actor.get_parameter(name)
        torch.testing.assert_close(network, expected)
    assert traced.metrics.keys() == plain.metrics.keys()
    for name, metric in traced.metrics.items():
        torch.testing.assert_close(metric, plain.metrics[name])


@pytest.mark.parametrize(
    "lines, sentence",
    [
        (["wpc.py --tau 0.1", "td3_bc.py"], "all runs must have the same tau"),
        (["wpc.py --value-lr 1", "td3_bc.py", "wbc.py"], "the same value_lr"),
        (["td3_bc.py", "wbc.py", "wpc.py --value-lr 1"], "the same value_lr"),
        (["wpc.py", "td3_bc.py --eval-freq 10"], "the same eval_freq"),
        (["wpc.py --policy-freq 1"], "runs with policy_freq 2"),
        (["wpc.py --eval-freq 15"], "an even eval_freq"),
        (["wpc.py", "wbc.py --max-timesteps 10000"], "the same max_timesteps"),
        (["wpc.py --max-timesteps 7777"], "must divide max_timesteps"),
        ([], "must have runs"),
        (["wpc.py --run-dir a", "wbc.py --run-dir a"], "a --run-dir of its own"),
        (["my_wpc.py"], 'must begin "python wpc.py", .*: python my_wpc.py'),
        (["-u wpc.py"], "must begin"),
    ],
)
def test_runs_that_can_not_be_one_are_refused(tmp_path, lines, sentence):
    path = tmp_path / "commands.txt"
    path.write_text("\n".join(f"python {line}" for line in lines))
    with pytest.raises(SystemExit, match=sentence):
        together.read_commands(path)


def test_a_file_of_commands_that_is_not_there(tmp_path):
    with pytest.raises(SystemExit, match=r"\[Errno 2\].*none.txt"):
        together.read_commands(tmp_path / "none.txt")


def test_comments_and_the_compiled_tool_are_passed_over(tmp_path):
    tool = "python tests/tools/compiled.py td3_bc.py --run-dir b"
    text = f"# two runs\n\npython wpc.py --run-dir a\n{tool}\n"
    (tmp_path / "commands.txt").write_text(text)
    runs = together.read_commands(tmp_path / "commands.txt")
    assert [type(args) for args in runs] == [wpc.Args, td3_bc.Args]
    assert [args.run_dir for args in runs] == ["a", "b"]


def test_what_was_evaluated_is_kept(monkeypatch, tmp_path):
    """Where training is stopped before the evaluation at step 20 has ended."""
    flags = f"--env halfcheetah --dataset {DATASET} --device cpu --run-dir {tmp_path} "
    flags += "--max-timesteps 40 --eval-freq 10"
    (tmp_path / "commands.txt").write_text(f"python wpc.py {flags}")
    actors = []

    class Stopped(Future):
        def result(self):
            raise KeyboardInterrupt

    class Pool:
        def submit(self, _, job):
            actors.append(pickle.loads(job)[1].state_dict())
            future = Stopped() if len(actors) > 2 else Future()
            if len(actors) <= 2:
                future.set_result({"mean_return": float(len(actors))})
            return future

    context = contextlib.nullcontext(Pool())
    monkeypatch.setattr(together, "ProcessPoolExecutor", lambda *_: context)
    line = ["together.py", str(tmp_path / "commands.txt"), "--device", "cpu"]
    monkeypatch.setattr(sys, "argv", line)
    with pytest.raises(SystemExit, match="what was evaluated is kept"):
        together.main()
    rows = csv.DictReader((tmp_path / "evaluations.csv").open())
    kept = [(row["step"], row["mean_return"]) for row in rows]
    assert kept == [("0", "1.0"), ("10", "2.0")]
    policy = load(tmp_path)["agent"]["actor"]
    assert all(torch.equal(x, actors[1][name]) for name, x in policy.items())
    assert len(actors) > 2
    assert not torch.equal(policy["4.bias"], actors[2]["4.bias"])


def test_a_run_that_is_there_is_not_written_over(tmp_path):
    (tmp_path / "evaluations.csv").touch()
    (tmp_path / "commands.txt").write_text(f"python wpc.py --run-dir {tmp_path}")
    with pytest.raises(SystemExit, match="holds a run already"):
        together.read_commands(tmp_path / "commands.txt")


def test_environments_of_gymnasium(tmp_path):
    def args(env, state_dim):
        path = tmp_path / f"{env}.hdf5"
        with h5py.File(path, "w") as file:
            for name in ("actions", "rewards", "terminals", "timeouts"):
                file[name] = np.zeros((30, 1), np.float32)
            file["observations"] = np.zeros((30, state_dim), np.float32)
        return wpc.Args(env, str(path))

    pendulum = args("Pendulum-v1", 3)
    runs = together.load([pendulum], "cpu")
    assert runs.actor.max_action == 2
    ((job, _, _),) = runs.snapshot()
    assert together.evaluate_run(pickle.dumps(job))["mean_return"] < 0
    with pytest.raises(SystemExit, match="must be of one robot"):
        together.load([pendulum, args("MountainCarContinuous-v0", 2)], "cpu")


def test_each_run_leaves_what_its_script_leaves(tmp_path):
    flags = f"--env halfcheetah --dataset {DATASET} --device cpu --eval-episodes 1 "
    flags += "--max-timesteps 20 --eval-freq 10"
    lines = [
        f"python {name}.py {flags} --seed {seed} --run-dir {tmp_path / name}{seed}"
        for name, seed in (("wpc", 0), ("td3_bc", 0), ("wbc", 1))
    ]
    (tmp_path / "commands.txt").write_text("\n".join(lines))
    line = [sys.executable, ROOT / "tests/tools/together.py"]
    line += [tmp_path / "commands.txt", "--device", "cpu"]
    process = run(*line, cwd=ROOT)
    assert process.returncode == 0, process.stderr
    columns = {}
    for line in lines:
        folder = tmp_path / shlex.split(line)[-1]
        rows = list(csv.DictReader((folder / "evaluations.csv").open()))
        assert [row["step"] for row in rows] == ["0", "10", "20"]
        assert float(rows[-1]["normalized_score"]) < 5
        assert float(rows[-1]["best_discounted_return"]) > 5
        columns[folder.name] = rows[0].keys()
        args = json.loads((folder / "args.json").read_text())
        assert args["made_by"] == "tests/tools/together.py"
        assert str(args["seed"]) == folder.name[-1]
    assert {"q", "v", "weight", "lmbda"} <= columns["wpc0"]
    assert "lmbda" in columns["td3_bc0"] and "v" not in columns["td3_bc0"]
    assert "weight" in columns["wbc1"] and "lmbda" not in columns["wbc1"]

    # Before the first step, the script's own evaluation finds the same.
    line = [*shlex.split(lines[-1])[1:-1], tmp_path / "own"]
    assert run(sys.executable, *line, cwd=ROOT).returncode == 0
    own = next(csv.DictReader((tmp_path / "own/evaluations.csv").open()))
    assert rows[0]["mean_return"] == own["mean_return"]

    # The policy is the one that was evaluated last, and no script starts anew there.
    checkpoint = load(folder)
    actor = wpc.Actor(17, 6, checkpoint["max_action"])
    actor.load_state_dict(checkpoint["agent"]["actor"])
    args = tyro.cli(wbc.Args, args=shlex.split(lines[-1])[2:])
    job = args, actor, checkpoint["mean"], checkpoint["std"]
    score = together.evaluate_run(pickle.dumps(job))
    assert score["mean_return"] == pytest.approx(float(rows[-1]["mean_return"]))
    before = (folder / "evaluations.csv").read_text()
    process = run(sys.executable, *shlex.split(lines[-1])[1:], cwd=ROOT)
    assert_one_sentence(process, "has another made_by: choose another --run-dir")
    assert (folder / "evaluations.csv").read_text() == before
