# SPDX-License-Identifier: MIT
"""Whole runs as a user starts them: what they leave, and how they stop and continue.

What is slow is tested on wpc.py alone: by test_twins.py it holds for the others.
"""

import hashlib
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from importlib.metadata import version

import numpy as np
import pytest
import torch
from conftest import (
    DATASET,
    ROOT,
    SCRIPTS,
    assert_one_sentence,
    command,
    d4rl_arrays,
    load,
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
    "wpc": ["q", "critic_loss", "v", "value_loss", "weight", "lmbda", "actor_loss"],
    "td3_bc": ["q", "critic_loss", "lmbda", "actor_loss"],
    "wbc": ["q", "critic_loss", "v", "value_loss", "weight", "actor_loss"],
}


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_run_from_start_to_end(name, tmp_path):
    process = run(*command(name, "--device", "cpu"), cwd=tmp_path)
    assert process.returncode == 0 and process.stderr == "", process.stderr
    for part in ("89,910 transitions in 90 episodes", "from step 0", "step 60: "):
        assert part in process.stdout
    (run_dir,) = (tmp_path / "runs").iterdir()
    assert run_dir.name.startswith(f"halfcheetah_replay__{name}__0__20")
    args = json.loads((run_dir / "args.json").read_text())
    assert args["max_timesteps"] == 60 and args.get("alpha", 2.5) == 2.5
    assert args["dataset"] == str(DATASET)

    rows = read_rows(run_dir)
    columns = ["step", "normalized_score", "std_over_episodes", "returns"]
    assert list(rows[0]) == columns + METRICS[name]
    assert [int(row["step"]) for row in rows] == [30, 60]
    for row in rows:
        returns = np.array([float(x) for x in row["returns"].split()])
        scores = wpc.normalized_score(returns, "halfcheetah")
        assert len(scores) == 2
        assert float(row["normalized_score"]) == pytest.approx(scores.mean(), abs=1e-3)
        std = abs(scores[0] - scores[1]) / 2  # over the episodes, with ddof = 0
        assert float(row["std_over_episodes"]) == pytest.approx(std, abs=1e-3)
        assert all(np.isfinite(float(row[metric])) for metric in METRICS[name])

    curves = read_curves(run_dir)
    assert [step for step, _ in curves.pop("eval/normalized_score")] == [30, 60]
    assert set(curves) == {f"train/{metric}" for metric in METRICS[name]}
    for curve in curves.values():
        assert [step for step, _ in curve] == [10, 20, 30, 40, 50, 60]

    script, checkpoint = SCRIPTS[name], load(run_dir)  # it plays the last row again
    agent = script.Agent(17, 6, 1.0, script.Args())
    agent.load_state_dict(checkpoint["networks"])
    mean, std = checkpoint["mean"], checkpoint["std"]
    envs = script.make_envs("halfcheetah", 2)
    returns = script.evaluate(envs, agent.actor, mean, std, seed=0)
    assert " ".join(f"{x:.2f}" for x in returns) == rows[-1]["returns"]


def test_the_loop_is_update_after_update(tmp_path):
    """A run is what its parts give when they are called by hand."""
    line = command("wpc", "--max-timesteps", 20, "--log-freq", 1, "--seed", 3)
    run_here(wpc, *line, "--run-dir", tmp_path)
    args = wpc.Args(alpha=2.5)
    dataset, _ = wpc.load_dataset(DATASET, 17, 6, args)
    wpc.normalize_states(dataset)
    torch.manual_seed(3)
    agent = wpc.Agent(17, 6, 1.0, args)
    torch.manual_seed(3)
    for step in range(1, 21):
        metrics = agent.update(wpc.sample_batch(dataset, 256), step)
    checkpoint = load(tmp_path)
    for name, parameter in agent.state_dict().items():
        assert torch.equal(parameter, checkpoint["networks"][name]), name
    curves = read_curves(tmp_path)
    assert [step for step, _ in curves["train/weight"]] == list(range(2, 21))
    for name, metric in metrics.items():
        assert curves[f"train/{name}"][-1][1] == pytest.approx(metric.item())


def test_same_seed_same_run_other_seed_other_run(finished, tmp_path):
    run_here(wpc, *command("wpc", "--run-dir", tmp_path / "same"))
    run_here(wpc, *command("wpc", "--run-dir", tmp_path / "other", "--seed", 1))
    assert result(tmp_path / "same") == result(finished)
    assert read_rows(tmp_path / "other")[-1]["q"] != read_rows(finished)[-1]["q"]


def provenance(run_dir):
    lines = (run_dir / "provenance.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def test_every_start_records_what_it_is_of(finished, run_dir):
    (start,) = provenance(finished)
    assert start["step"] == 0 and start["threads"] == 1
    for path, key in ((ROOT / "wpc.py", "script"), (DATASET, "dataset")):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        assert start[f"{key}_sha256"] == digest
    assert start["torch"] == version("torch") and start["mujoco"] == "3.15.0"
    assert start["python"] == sys.version.split()[0]
    _, discounted_returns = wpc.load_dataset(DATASET, 17, 6, wpc.Args())
    assert start["best_discounted_return"] == discounted_returns.max()
    run_here(wpc, *command("wpc")[:2], "--run-dir", run_dir, "--max-timesteps", 70)
    assert [start["step"] for start in provenance(run_dir)] == [0, 60]


def test_the_commit_if_there_is_one(monkeypatch, tmp_path):
    monkeypatch.setattr(wpc, "__file__", str(tmp_path / "wpc.py"))
    assert wpc.git_commit() is None
    for line in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "first"]):
        options = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
        subprocess.run(["git", *options, *line], cwd=tmp_path, check=True)
    line = ["git", "rev-parse", "HEAD"]
    head = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True).stdout
    assert wpc.git_commit() == head.strip()
    monkeypatch.setenv("PATH", "")
    assert wpc.git_commit() is None


def test_states_as_they_are(tmp_path):
    line = command("wpc", "--no-normalize", "--max-timesteps", 1)
    run_here(wpc, *line, "--run-dir", tmp_path)
    checkpoint = load(tmp_path)
    assert (checkpoint["mean"] == 0).all() and (checkpoint["std"] == 1).all()


ALPHAS = [
    ("halfcheetah-medium-expert-v2", [], 0.1),
    ("halfcheetah-medium-v2", [], 2.5),
    ("halfcheetah-medium-expert-v2", ["--alpha", "0.5"], 0.5),
]


@pytest.mark.parametrize("env, arguments, alpha", ALPHAS)
def test_alpha_is_the_papers_unless_given(tmp_path, env, arguments, alpha):
    line = command("wpc", "--env", env, "--max_timesteps", 1, *arguments)
    run_here(wpc, *line, "--run-dir", tmp_path)
    assert json.loads((tmp_path / "args.json").read_text())["alpha"] == alpha


def test_the_help_explains_every_argument(script):
    text = run(*command(script.SCRIPT, "--help")).stdout
    words = " ".join(text.replace("│", " ").split())
    for name in script.Args.__dataclass_fields__:
        assert f"--{name.replace('_', '-')}" in words
    assert "evaluate and save a checkpoint every this many steps" in words


# Stopping and continuing


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stopped_by_a_signal_and_continued(finished, tmp_path, number, code):
    process = start(*command("wpc", "--run-dir", tmp_path))
    wait_until((tmp_path / "checkpoint.pt").exists, process)
    process.send_signal(number)
    output, errors = process.communicate()
    assert process.returncode == code and "Traceback" not in errors
    stopped = load(tmp_path)["step"]
    assert f"stopped at step {stopped}; to continue" in output and stopped < 60
    assert f"python wpc.py --run-dir {tmp_path}" in output
    process = run(*command("wpc")[:2], "--run-dir", tmp_path)
    assert f"from step {stopped}, on cpu" in process.stdout, process.stderr
    assert result(tmp_path) == result(finished)


def test_stopped_before_the_first_evaluation(finished, tmp_path):
    line = command("wpc", "--eval-freq", 10**6, "--max-timesteps", 10**6)
    process = start(*line, "--run-dir", tmp_path)
    wait_until((tmp_path / "args.json").exists, process)
    time.sleep(1)
    process.send_signal(signal.SIGTERM)
    process.communicate()
    assert process.returncode == 143 and load(tmp_path)["step"] > 0
    assert (tmp_path / "evaluations.csv").read_text() == "step\n"
    line = [*command("wpc")[:2], "--run-dir", tmp_path, "--eval-freq", 7]
    assert "has eval_freq = 1000000: keep it" in refusal(wpc, *line)


def test_a_second_signal_acts_at_once():
    """The first one asks the loop to stop; the second one has its default action."""
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    stop_signals = wpc.catch_stop_signals()
    signal.raise_signal(signal.SIGTERM)
    assert stop_signals == [signal.SIGTERM]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is not signal.SIG_DFL
    signal.signal(signal.SIGINT, handlers[0])
    signal.signal(signal.SIGTERM, handlers[1])


def test_killed_at_random(tmp_path):
    """kill -9 at any moment, often while files are written, changes nothing."""
    options = ["--eval-freq", 4, "--eval-episodes", 1, "--log-freq", 3]
    line = command("wpc", *options, "--max-timesteps", 60)
    assert run(*line, "--run-dir", tmp_path / "whole").returncode == 0
    rng, killed = random.Random(0), tmp_path / "killed"
    checkpoint = killed / "checkpoint.pt"
    for _ in range(5):
        if checkpoint.exists() and wpc.load_checkpoint(killed)["step"] > 52:
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


def test_killed_before_the_first_checkpoint(finished, run_dir):
    """--run-dir alone starts the same run again."""
    (run_dir / "checkpoint.pt").unlink()
    run_here(wpc, *command("wpc")[:2], "--run-dir", run_dir)
    assert result(run_dir)[:2] == result(finished)[:2]


def test_a_finished_run_says_so_and_can_be_prolonged(capsys, run_dir, tmp_path):
    before = result(run_dir)
    run_here(wpc, *command("wpc")[:2], "--run-dir", run_dir)
    assert "finished at step 60" in capsys.readouterr().out
    assert result(run_dir) == before
    longer, whole = ["--max-timesteps", 80], tmp_path / "whole"
    run_here(wpc, *command("wpc")[:2], "--run-dir", run_dir, *longer)
    run_here(wpc, *command("wpc", "--run-dir", whole, *longer))
    assert result(run_dir) == result(whole)


def test_the_same_data_may_move(run_dir, tmp_path):
    moved = shutil.copy(DATASET, tmp_path / "moved.hdf5")
    run_here(wpc, *command("wpc", "--run-dir", run_dir, "--dataset", moved))


CONTRADICTIONS = [
    ("wpc", ["--seed", 1], "has seed = 0: keep it"),
    ("wpc", ["--alpha", 1.0], "has alpha = 2.5: keep it"),
    ("wpc", ["--batch-size", 32], "has batch_size = 256: keep it"),
    ("td3_bc", [], "is of another script, or another version of td3_bc.py"),
    ("wbc", [], "is of another script, or another version of wbc.py"),
]


@pytest.mark.parametrize("name, arguments, sentence", CONTRADICTIONS)
def test_what_contradicts_the_run_is_refused(run_dir, name, arguments, sentence):
    before, line = result(run_dir), command(name, "--run-dir", run_dir, *arguments)
    assert sentence in refusal(SCRIPTS[name], *line)
    assert result(run_dir) == before


def test_other_data_are_refused(run_dir, tmp_path):
    other = write_hdf5(tmp_path / "other.hdf5", d4rl_arrays(400))
    line = command("wpc", "--run-dir", run_dir, "--dataset", other)
    assert "began with another dataset" in refusal(wpc, *line)


def test_two_processes_at_once(tmp_path):
    line = command("wpc", "--max-timesteps", 100_000, "--run-dir", tmp_path / "one")
    first = start(*line)
    wait_until((tmp_path / "one/checkpoint.pt").exists, first)
    assert_one_sentence(run(*line), "is in use by another process")
    first.kill()
    first.communicate()
    pair = [start(*command("wpc", "--max-timesteps", 1), cwd=tmp_path) for _ in "ab"]
    for process in pair:
        assert process.communicate()[1] == "" and process.returncode == 0
    assert len(list((tmp_path / "runs").iterdir())) == 2


def test_the_lock_leaves_a_link_s_target_alone(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "precious").write_text("content")
    (tmp_path / "run/lock").symlink_to(tmp_path / "precious")
    run_here(wpc, *command("wpc", "--max-timesteps", 1, "--run-dir", tmp_path / "run"))
    assert (tmp_path / "precious").read_text() == "content"
