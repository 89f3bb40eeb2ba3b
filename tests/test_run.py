# SPDX-License-Identifier: MIT
"""Whole runs as a user starts them: what they leave, and how they stop and continue.

What is slow is tested on wpc.py alone: by test_twins.py it holds for the others.
"""

import hashlib
import importlib
import itertools
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
from conftest import (
    DATASET,
    ROOT,
    SCRIPTS,
    command,
    environment,
    files,
    load,
    networks,
    read_curves,
    read_rows,
    refusal,
    result,
    run,
    run_here,
    start,
    wait_until,
    wpc,
    write_hdf5,
)

METRICS = {
    "wpc": ["q", "critic_loss", "v", "value_loss", "lmbda", "actor_loss", "weight"],
    "td3_bc": ["q", "critic_loss", "lmbda", "actor_loss"],
    "wbc": ["q", "critic_loss", "v", "value_loss", "actor_loss", "weight"],
}
SCORES = ["mean_return", "std_return", "normalized_score"]


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_run_from_start_to_end(monkeypatch, capfd, tmp_path, name):
    monkeypatch.chdir(tmp_path)
    script = SCRIPTS[name]
    torch.set_flush_denormal(False)
    run_here(script, *command(name))
    assert torch.tensor(1e-38) / 100 == 0  # the script flushes them again
    output, errors = capfd.readouterr()
    assert errors == ""
    lines = output.splitlines()
    assert len(lines) == 5 and lines[0].startswith(
        "to continue, add --run-dir 'runs/half"
    )
    assert "89,910 transitions, 0 of them terminal; the largest action" in lines[1]
    assert " is 1 (bound 1.0)" in lines[1]
    assert name == "wbc" or lines[1].endswith("; alpha 2.5")
    (run_dir,) = Path("runs").iterdir()
    assert run_dir.name.startswith(f"halfcheetah_replay__{name}__0__20")

    rows = read_rows(run_dir)
    assert list(rows[0]) == ["step", *SCORES, *METRICS[name], "best_discounted_return"]
    assert [int(row["step"]) for row in rows] == [0, 30, 60]
    for row, line in zip(rows, lines[2:], strict=True):
        assert line.startswith(f"step {row['step']}: ")
        for column in ("mean_return", "best_discounted_return", "q"):
            if row[column]:
                assert f"{column} {float(row[column]):.1f}" in line
        score = 100 * (float(row["mean_return"]) + 280.178953) / (12135.0 + 280.178953)
        assert float(row["normalized_score"]) == pytest.approx(score)
    assert all(rows[0][metric] == "" for metric in METRICS[name])
    assert all(np.isfinite(float(rows[2][metric])) for metric in METRICS[name])

    curves = read_curves(run_dir)
    assert set(curves) == set(rows[0])
    for column, curve in curves.items():
        values = [(int(row["step"]), row[column]) for row in rows if row[column]]
        assert [step for step, _ in curve] == [step for step, _ in values]
        expected = [float(value) for _, value in values]
        assert [value for _, value in curve] == pytest.approx(expected)

    checkpoint = load(run_dir)  # the policy in it plays the last row again
    actor = script.Actor(17, 6, checkpoint["max_action"])
    actor.load_state_dict(checkpoint["agent"]["actor"])
    assert checkpoint["args"].pop("dataset_contents")
    args = script.Args(**checkpoint["args"])
    envs = script.make_envs(args.env, args.eval_episodes)
    row = script.evaluate(envs, actor, checkpoint["mean"], checkpoint["std"], args)
    assert list(row) == SCORES
    assert {key: rows[2][key] for key in row} == {k: str(x) for k, x in row.items()}
    assert load(run_dir)["step"] == 60


def test_the_loop_is_update_after_update(tmp_path):
    """A run is what its parts give when they are called by hand."""
    line = command("wpc", "--max-timesteps", 20, "--eval-freq", 5, "--seed", 3)
    run_here(wpc, *line, "--eval-episodes", 1, "--run-dir", tmp_path)
    args = wpc.Args(env="halfcheetah", dataset=str(DATASET), device="cpu")
    arrays = wpc.read_dataset(DATASET, 17, 6, 1.0)
    dataset, mean, std, _ = wpc.prepare_dataset(arrays, args)
    torch.manual_seed(3)
    agent = wpc.Agent(17, 6, 1.0, args)
    torch.manual_seed(3)
    for step in range(1, 21):
        metrics = agent.update(wpc.sample_batch(dataset, 256), step)
    checkpoint = load(tmp_path)
    assert torch.equal(checkpoint["mean"], mean)
    assert torch.equal(checkpoint["std"], std)
    for name, network in networks(agent).items():
        for key, parameter in network.state_dict().items():
            assert torch.equal(parameter, checkpoint["agent"][name][key]), name
    row = read_rows(tmp_path)[-1]
    for name, metric in metrics.items():
        assert float(row[name]) == metric.item()


def test_same_seed_same_run_other_seed_other_run(finished, tmp_path):
    run_here(wpc, *command("wpc", "--run-dir", tmp_path / "same"))
    run_here(wpc, *command("wpc", "--run-dir", tmp_path / "other", "--seed", 1))
    assert result(tmp_path / "same") == result(finished)
    ours, theirs = read_rows(tmp_path / "other"), read_rows(finished)
    for row, other in zip(ours, theirs, strict=True):
        assert row["mean_return"] != other["mean_return"]
    assert ours[-1]["q"] != theirs[-1]["q"]


def test_args_json_says_what_the_run_is_of(finished):
    record = json.loads((finished / "args.json").read_text())
    digest = hashlib.sha256((ROOT / "wpc.py").read_bytes()).hexdigest()
    assert record.pop("script_sha256") == digest
    for package in ("torch", "gymnasium", "mujoco", "numpy"):
        assert record.pop(package) == importlib.import_module(package).__version__
    with h5py.File(DATASET) as file:
        data = b"".join(
            np.float32(file[name][:]).tobytes()
            for name in ("observations", "actions", "rewards", "terminals", "timeouts")
        )
    assert record.pop("dataset_contents") == hashlib.sha256(data).hexdigest()
    args = wpc.Args(**record)  # nothing else is in it
    assert (args.env, args.dataset) == ("halfcheetah", str(DATASET))
    assert (args.max_timesteps, args.eval_freq, args.alpha) == (60, 30, 2.5)
    assert args.run_dir == str(finished)


def test_an_evaluation_is_saved_before_it_is_printed(monkeypatch, tmp_path):
    saved = []

    def write(line, **_):
        if not line.startswith("step"):
            return
        step = load(tmp_path)["step"]
        assert int(read_rows(tmp_path)[-1]["step"]) == step
        assert read_curves(tmp_path)["mean_return"][-1][0] == step
        assert line.startswith(f"step {step}: ")
        saved.append(step)

    monkeypatch.setattr(wpc, "print", write, raising=False)
    run_here(wpc, *command("wpc", "--run-dir", tmp_path))
    assert saved == [0, 30, 60]


def test_steps_per_second_are_of_training_alone(monkeypatch, tmp_path):
    """By a clock on which a second passes each time it is read."""
    clock = map(float, itertools.count()).__next__
    monkeypatch.setattr(wpc, "perf_counter", clock)
    line = command("wpc", "--run-dir", tmp_path)
    run_here(wpc, *line, "--max-timesteps", 40)
    run_here(wpc, *line, "--max-timesteps", 60)  # its first step is not counted
    rows = load(tmp_path)["evaluations"]
    assert [row["step"] for row in rows] == [0, 30, 40, 60]
    assert [row["steps_per_second"] for row in rows] == [0, 30, 10, 19]


def test_steps_that_a_gpu_has_yet_to_do_are_waited_for(monkeypatch, tmp_path):
    """They are done when a metric is read, which here takes ten seconds."""
    clock = itertools.count()

    def item():
        return float([next(clock) for _ in range(10)][-1])

    metrics = {"q": SimpleNamespace(item=item)}
    monkeypatch.setattr(wpc.Agent, "update", lambda *_: metrics)
    monkeypatch.setattr(wpc, "perf_counter", clock.__next__)
    run_here(wpc, *command("wpc", "--run-dir", tmp_path))
    rows = load(tmp_path)["evaluations"]
    assert [row["steps_per_second"] for row in rows] == [0, 30 / 11, 30 / 11]


# Arguments


ALPHAS = [
    ({}, 2.5),
    ({"env": "halfcheetah-medium-expert-v2"}, 0.1),
    ({"env": "halfcheetah-medium-v2"}, 2.5),
    ({"env": "halfcheetah-medium-expert-v2", "alpha": 0.5}, 0.5),
]


@pytest.mark.parametrize("options, alpha", ALPHAS)
def test_alpha_is_the_papers_unless_given(options, alpha):
    assert wpc.Args(**options).alpha == alpha


def test_every_start_has_a_new_run_folder(script, monkeypatch):
    """Also two in one second, or in two containers with one process number."""
    monkeypatch.setattr(os, "getpid", lambda: 7)
    name = script.SCRIPT.stem
    folders = {script.Args(seed=7).run_dir for _ in range(100)}
    assert len(folders) == 100
    start = rf"runs/hopper-medium-v2__{name}__7__20\d\d-\d\d-\d\d_"
    assert all(re.fullmatch(rf"{start}\d\d-\d\d-\d\d\.\d{{6}}", x) for x in folders)
    other = script.Args(dataset="folder/my.data.hdf5").run_dir
    assert other.startswith(f"runs/my.data__{name}__0__20")


def test_the_help_explains_every_argument(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["script.py", "--help"])
    with pytest.raises(SystemExit):
        script.main()
    words = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for name in script.Args.__dataclass_fields__:
        assert f"--{name.replace('_', '-')}" in words
    assert "number of steps between evaluations; each logs and saves" in words


def test_in_a_notebook(monkeypatch, capsys, tmp_path):
    """Imported twice, and called without a command line."""
    monkeypatch.chdir(tmp_path)
    importlib.reload(wpc)
    args = wpc.Args(env="halfcheetah", dataset=str(DATASET), max_timesteps=100)
    args.eval_episodes = 2
    rows = wpc.train(args)
    assert "step 100: mean_return" in capsys.readouterr().out
    assert [row["step"] for row in rows] == [0, 100]
    assert str(rows[1]["q"]) == read_rows(Path(args.run_dir))[1]["q"]
    assert [row["step"] for row in read_rows(Path(args.run_dir))] == ["0", "100"]

    args, ones = wpc.Args(), torch.ones
    batch = {"observations": ones(4, 3), "next_observations": ones(4, 3)}
    batch |= {name: ones(4, 1) for name in ("actions", "rewards", "terminals")}
    batch = {name: x.to(args.device) for name, x in batch.items()}
    metrics = wpc.Agent(3, 1, 2.0, args).update(batch, 2)
    assert np.isfinite([x.item() for x in metrics.values()]).all()


# Stopping and continuing


def test_stopped_by_ctrl_c_and_continued_as_shown(finished, tmp_path):
    """In the default run folder, whose name has a space."""
    data = tmp_path / "my data.hdf5"
    data.symlink_to(DATASET)
    process = start(
        *command("wpc", "--dataset", data),
        cwd=tmp_path,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    wait_until(lambda: list(tmp_path.glob("runs/*/checkpoint.pt")), process)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate()
    (run_dir,) = (tmp_path / "runs").iterdir()
    assert " " in run_dir.name and load(run_dir)["step"] < 60
    assert process.returncode == 1 and errors == "stopped\n"
    option = output.splitlines()[0].removeprefix("to continue, add ")
    line = f"{shlex.join(command('wpc', '--dataset', data))} {option}"
    options = {"shell": True, "cwd": tmp_path, "env": environment()}
    subprocess.run(line, check=True, **options)
    assert list((tmp_path / "runs").iterdir()) == [run_dir]
    assert result(run_dir) == result(finished)


@pytest.mark.parametrize("moment", ["before", "after"])
def test_stopped_while_saving(monkeypatch, finished, tmp_path, moment):
    def save(run_dir, checkpoint):
        if checkpoint["step"] == 30 and moment == "before":
            raise KeyboardInterrupt
        real_save(run_dir, checkpoint)
        if checkpoint["step"] == 30:
            raise KeyboardInterrupt

    real_save = wpc.save
    monkeypatch.setattr(wpc, "save", save)
    line = command("wpc", "--run-dir", tmp_path)
    assert refusal(wpc, *line) == "stopped"
    monkeypatch.undo()
    assert load(tmp_path)["step"] == (0 if moment == "before" else 30)
    run_here(wpc, *line)
    assert result(tmp_path) == result(finished)


def test_killed_at_random(tmp_path):
    """kill -9 at any moment, often while files are written, changes nothing."""
    line = command("wpc", "--max-timesteps", 40, "--eval-freq", 4)
    run_here(wpc, *line, "--run-dir", tmp_path / "whole")
    rng, killed = random.Random(0), tmp_path / "killed"
    checkpoint = killed / "checkpoint.pt"
    for _ in range(2):
        if checkpoint.exists() and load(killed)["step"] > 32:
            shutil.rmtree(killed)  # nearly done: from the start again
        before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
        process = start(*line, "--run-dir", killed)

        def writes_again(before=before):
            return checkpoint.exists() and checkpoint.stat().st_mtime_ns > before

        wait_until(writes_again, process)
        time.sleep(rng.random() * 0.3)
        process.kill()
        process.communicate()
    process = run(*line, "--run-dir", killed)
    assert process.returncode == 0, process.stderr
    assert result(killed) == result(tmp_path / "whole")


def test_output_piped_to_head_loses_nothing(finished, tmp_path):
    """The pipe breaks when the next evaluation is printed; by then it is saved."""
    line = command("wpc", "--run-dir", tmp_path)
    process = run("sh", "-c", f"{shlex.join(line)} | head -1")
    assert process.stdout.startswith("to continue, add --run-dir"), process
    assert load(tmp_path)["step"] == 30
    time.sleep(1)
    run_here(wpc, *line)
    assert result(tmp_path) == result(finished)


def test_killed_before_the_first_checkpoint(finished, run_dir):
    (run_dir / "checkpoint.pt").unlink()
    run_here(wpc, *command("wpc", "--run-dir", run_dir))
    assert result(run_dir) == result(finished)


def test_a_finished_run_stays_and_can_be_prolonged(run_dir, tmp_path, capsys):
    before, record = result(run_dir), (run_dir / "args.json").read_bytes()
    for fewer in ([], ["--max-timesteps", 30]):
        run_here(wpc, *command("wpc", "--run-dir", run_dir, *fewer))
        assert (
            f"{run_dir} is finished; raise --max-timesteps" in capsys.readouterr().out
        )
        assert result(run_dir) == before
        assert (run_dir / "args.json").read_bytes() == record
    longer, whole = ["--max-timesteps", 80], tmp_path / "whole"
    run_here(wpc, *command("wpc", "--run-dir", run_dir, *longer))
    run_here(wpc, *command("wpc", "--run-dir", whole, *longer))
    assert result(run_dir) == result(whole)
    assert [row["step"] for row in read_rows(run_dir)] == ["0", "30", "60", "80"]


def test_prolonged_by_a_step_without_the_policys(run_dir):
    """Its row has no metrics of the policy's, and stands below others that have."""
    run_here(wpc, *command("wpc", "--run-dir", run_dir, "--max-timesteps", 61))
    before, last = read_rows(run_dir)[-2:]
    assert before["lmbda"] and last["step"] == "61" and float(last["q"])


def test_the_data_may_move(run_dir, tmp_path):
    moved = shutil.copy(DATASET, tmp_path / "moved.hdf5")
    run_here(wpc, *command("wpc", "--run-dir", run_dir, "--dataset", moved))


def other_data(change):
    with h5py.File(DATASET) as file:
        arrays = {key: file[key][:] for key in file if key != "metadata"}
    return {key: change(key, column) for key, column in arrays.items()}


OTHER_DATA = {
    "other units": lambda key, x: x * 2 if key == "observations" else x,
    "one reward": lambda key, x: np.r_[x[:-1], 9] if key == "rewards" else x,
    "other actions": lambda key, x: -x if key == "actions" else x,
    "fewer rows": lambda key, x: x[:-1000],
}


@pytest.mark.parametrize("change", OTHER_DATA.values(), ids=OTHER_DATA)
def test_a_run_does_not_go_on_with_other_data(run_dir, tmp_path, change):
    """Other data, even in one value, have another digest."""
    path, before = tmp_path / "other.hdf5", files(run_dir)
    write_hdf5(path, other_data(change))
    line = command("wpc", "--run-dir", run_dir, "--dataset", path)
    assert "has another dataset_contents: choose" in refusal(wpc, *line)
    assert files(run_dir) == before


def test_a_continued_run_draws_other_numbers_on_a_gpu(run_dir, monkeypatch):
    """There, the generator starts from a seed, which must not be the first one."""
    seeds, real_seed = [], torch.manual_seed
    monkeypatch.setattr(torch, "manual_seed", lambda x: seeds.append(x) or real_seed(x))
    line = command("wpc", "--run-dir", run_dir, "--seed", 0, "--max-timesteps", 61)
    run_here(wpc, *line)
    assert seeds == [0, 0, 60]


def test_a_sweep_outlives_its_trials(tmp_path, monkeypatch):
    """A trial that fails raises an exception, and leaves no file open."""
    monkeypatch.chdir(tmp_path)
    options = {"dataset": str(DATASET), "max_timesteps": 4, "eval_freq": 2}
    options |= {"eval_episodes": 1, "device": "cpu", "batch_size": 8}
    ends, opened = [], []
    for critic_lr in (1e30, 3e-4, 3e-4):
        try:
            rows = wpc.train(wpc.Args("halfcheetah", critic_lr=critic_lr, **options))
            ends.append([row["step"] for row in rows])
        except Exception as error:
            ends.append(type(error))
        opened.append(len(os.listdir("/proc/self/fd")))
    assert ends == [wpc.UserError, [0, 2, 4], [0, 2, 4]]
    assert opened[1] == opened[2] and len(list(Path("runs").iterdir())) == 3


def test_a_run_of_a_gpu_goes_on_without_one(run_dir, monkeypatch):
    checkpoint = load(run_dir)
    checkpoint["args"]["device"] = "cuda"
    torch.save(checkpoint, run_dir / "checkpoint.pt")
    places, real_load = [], torch.load

    def torch_load(path, map_location=None):
        places.append(map_location)
        return real_load(path, map_location)

    monkeypatch.setattr(torch, "load", torch_load)
    run_here(wpc, *command("wpc", "--run-dir", run_dir, "--max-timesteps", 61))
    assert places == ["cpu", "cpu"]  # to continue, and to see who saved last
    monkeypatch.undo()
    assert load(run_dir)["step"] == 61


def test_a_run_of_td3_bc_is_not_for_the_others(tmp_path):
    line = ["--max-timesteps", 1, "--run-dir", tmp_path]
    run_here(SCRIPTS["td3_bc"], *command("td3_bc", *line))
    for name, differs in (("wpc", "value_lr"), ("wbc", "alpha")):
        sentence = f"has another {differs}: choose another --run-dir"
        assert sentence in refusal(SCRIPTS[name], *command(name, *line))
