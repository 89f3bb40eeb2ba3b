# SPDX-License-Identifier: MIT
"""Whole runs as a user starts them: what they leave behind, how they stop, go on, refuse and fail.

What is slow runs on wpc.py alone: tests/test_twins.py carries it over to the others.
"""

import csv
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
import zipfile

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from conftest import DATASET, ROOT, SCRIPTS, command, d4rl_arrays, run, wpc, write_hdf5
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator


def rows(run_dir):
    return list(csv.DictReader(open(run_dir / "evaluations.csv")))


def curves(run_dir):
    """TensorBoard's scalars: {tag: [(step, value), ...]}, steps a second left out, as they never repeat."""
    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0}).Reload()
    tags = [tag for tag in events.Tags()["scalars"] if "steps_per_second" not in tag]
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in tags}


def result(run_dir):
    """All that a run ends with, but its speed and its folder, in a form that compares to the last bit."""
    checkpoint = torch.load(run_dir / "checkpoint.pt", weights_only=True)
    table = rows(run_dir)
    for row in checkpoint["rows"] + table:
        row.pop("steps_per_second", None)
    checkpoint["args"].pop("run_dir")
    return [checkpoint_bits(checkpoint), table, curves(run_dir)]


def checkpoint_bits(value):
    if isinstance(value, dict):
        return {key: checkpoint_bits(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [checkpoint_bits(v) for v in value]
    return value.numpy().tobytes() if isinstance(value, torch.Tensor) else value


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of wpc.py that nothing disturbed."""
    run_dir = tmp_path_factory.mktemp("finished") / "run"
    process = run(*command("wpc", "--run-dir", run_dir))
    assert process.returncode == 0, process.stderr
    return run_dir


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_run_from_start_to_end(name, tmp_path):
    process = run(*command(name), cwd=tmp_path)
    assert process.returncode == 0 and process.stderr == "", process.stderr
    for part in ("89,910 transitions of 90 episodes", "score 20.5, at best 36.4", "finished step 300", "evaluations.csv"):
        assert part in process.stdout
    (run_dir,) = (tmp_path / "runs").iterdir()
    assert run_dir.name.startswith(f"halfcheetah_replay__{name}__0__20")
    args = json.loads((run_dir / "args.json").read_text())
    assert args["max_timesteps"] == 300 and args.get("alpha", 2.5) == 2.5

    table = rows(run_dir)
    assert [int(row["step"]) for row in table] == [0, 100, 200, 300]
    for row in table:
        returns = [float(x) for x in row["returns"].split()]
        low, high = -280.178953, 12135.0
        assert len(returns) == 2
        assert float(row["score"]) == pytest.approx(100 * (np.mean(returns) - low) / (high - low), abs=1e-3)
    own = {"wpc": {"v", "v_loss", "weight", "lmbda"}, "wbc": {"v", "v_loss", "weight"}, "td3_bc": {"lmbda"}}[name]
    common = {"q", "target_q", "critic_loss", "actor_loss", "action_distance", "best_discounted_return", "steps_per_second"}
    assert set(table[-1]) == {"step", "score", "score_std", "returns"} | own | common
    assert all(np.isfinite(float(table[-1][key])) for key in own | common)
    scalars = curves(run_dir)
    assert [step for step, _ in scalars["eval/score"]] == [0, 100, 200, 300]
    assert {tag for tag in scalars if tag != "eval/score"} == {f"train/{key}" for key in own | common - {"steps_per_second"}}
    assert all([s for s, _ in scalars[tag]] == list(range(50, 301, 50)) for tag in scalars if tag != "eval/score")

    script, checkpoint = SCRIPTS[name], torch.load(run_dir / "checkpoint.pt", weights_only=True)
    actor = script.make_networks(17, 6, script.Args(), "cpu")[0]["actor"]
    actor.load_state_dict(checkpoint["networks"]["actor"])
    again = script.evaluate(gym.make_vec("HalfCheetah-v4", 2), actor, checkpoint["mean"], checkpoint["std"], seed=0)
    assert " ".join(f"{x:.2f}" for x in again) == table[-1]["returns"]


def test_same_seed_same_run_other_seed_other_run(finished, tmp_path):
    run(*command("wpc", "--run-dir", tmp_path / "same"))
    run(*command("wpc", "--run-dir", tmp_path / "other", "--seed", 1))
    assert result(tmp_path / "same") == result(finished)
    assert rows(tmp_path / "other")[-1]["q"] != rows(finished)[-1]["q"]


def test_the_metrics_are_means_since_the_last_log(tmp_path):
    """log_freq 1 gives every step's metrics; those of log_freq 50 are their means."""
    for freq in (1, 50):
        run(*command("wpc", "--run-dir", tmp_path / str(freq), "--log-freq", freq, "--max-timesteps", 100))
    every, fifty = curves(tmp_path / "1"), curves(tmp_path / "50")
    for tag in ("train/q", "train/v_loss"):
        values = dict(every[tag])
        assert dict(fifty[tag])[100] == pytest.approx(np.mean([values[step] for step in range(51, 101)]), rel=1e-5)
    policy = dict(every["train/weight"])
    assert list(policy) == list(range(2, 101, 2))  # the steps on which the policy moves
    assert dict(fifty["train/weight"])[100] == pytest.approx(np.mean([policy[s] for s in range(52, 101, 2)]), rel=1e-5)


def test_a_table_whose_columns_are_not_all_there_at_first(tmp_path):
    arguments = ["--eval-freq", 1, "--log-freq", 1, "--policy-freq", 3, "--max-timesteps", 4, "--run-dir", tmp_path]
    assert run(*command("wpc", *arguments)).returncode == 0
    assert [bool(row["q"]) for row in rows(tmp_path)] == [False, True, True, True, True]
    assert [bool(row["actor_loss"]) for row in rows(tmp_path)] == [False, False, False, True, False]


def test_the_paper_s_alpha(tmp_path):
    for env, alpha in (("halfcheetah-medium-expert-v2", 0.1), ("halfcheetah-medium-v2", 2.5)):
        process = run(*command("wpc", "--env", env, "--max-timesteps", 1, "--run-dir", tmp_path / env))
        assert f"alpha    {alpha}, the paper's for {env}\n" in process.stdout
        assert json.loads((tmp_path / env / "args.json").read_text())["alpha"] == alpha
    process = run(*command("wpc", "--env", env, "--max_timesteps", 1, "--alpha", "0.5", "--run-dir", tmp_path / "own"))
    assert "the paper's" not in process.stdout
    assert json.loads((tmp_path / "own/args.json").read_text())["alpha"] == 0.5


def until(condition, process, seconds=180):
    """Waits for a condition while a process runs."""
    end = time.time() + seconds
    while not condition():
        assert process.poll() is None and time.time() < end, process.communicate()
        time.sleep(0.01)


def start(*line, **options):
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, **options)


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stopped_by_a_signal_and_continued(finished, tmp_path, number, code):
    process = start(*command("wpc", "--run-dir", tmp_path))
    until((tmp_path / "checkpoint.pt").exists, process)
    time.sleep(0.2)
    process.send_signal(number)
    output, errors = process.communicate(timeout=30)
    assert process.returncode == code and "stopped at step" in output and "Traceback" not in errors
    stopped = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["step"]
    assert f"--run-dir {tmp_path}" in output and 0 < stopped < 300
    process = run(sys.executable, str(ROOT / "wpc.py"), "--run-dir", str(tmp_path))  # the rest comes from the checkpoint
    assert f"from step {stopped} on" in process.stdout and process.returncode == 0, process.stderr
    assert result(tmp_path) == result(finished)


def test_killed_at_random_twenty_times(tmp_path):
    """kill -9 at any moment, many of them while files are written: the same command goes on, to the same end."""
    line = ["--eval-freq", 4, "--eval-episodes", 1, "--log-freq", 3, "--max-timesteps", 200, "--run-dir"]
    assert run(*command("wpc", *line, tmp_path / "whole")).returncode == 0
    rng, kills, killed = random.Random(0), 0, tmp_path / "killed"
    table = killed / "evaluations.csv"
    while kills < 20:
        before = table.stat().st_mtime_ns if table.exists() else 0
        process = start(*command("wpc", *line, killed))
        until(lambda: table.exists() and table.stat().st_mtime_ns > before, process)  # it writes again
        time.sleep(rng.random() * 0.3)
        process.kill()
        process.communicate()
        kills += 1
        if (killed / "checkpoint.pt").exists() and wpc.load_checkpoint(killed)["step"] > 180:
            shutil.rmtree(killed)  # nearly done: from the start again
    process = run(*command("wpc", *line, killed))
    assert process.returncode == 0, process.stderr
    assert result(killed) == result(tmp_path / "whole")


def test_killed_between_the_two_renames(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    (tmp_path / "run/checkpoint.pt").unlink()
    assert wpc.load_checkpoint(tmp_path / "run")["step"] == 200
    assert run(*command("wpc", "--run-dir", tmp_path / "run")).returncode == 0
    assert result(tmp_path / "run") == result(finished)


def test_a_finished_run_typed_again_says_so_and_goes_on_when_asked(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    before = result(tmp_path / "run")
    process = run(*command("wpc", "--run-dir", tmp_path / "run"))
    assert process.returncode == 0 and "finished step 300" in process.stdout
    assert result(tmp_path / "run") == before
    assert run(*command("wpc", "--run-dir", tmp_path / "run", "--max-timesteps", 400)).returncode == 0
    assert run(*command("wpc", "--run-dir", tmp_path / "long", "--max-timesteps", 400)).returncode == 0
    assert rows(tmp_path / "run")[-1]["returns"] == rows(tmp_path / "long")[-1]["returns"]


@pytest.mark.parametrize(
    "script, arguments, sentence",
    [
        ("wpc", ["--seed", 1], "has seed 0"),
        ("wpc", ["--alpha", 1.0], "has alpha 2.5"),
        ("wpc", ["--batch-size", 32], "has batch_size 256"),
        ("td3_bc", [], "holds no run of td3_bc.py but another's"),
        ("wpc", ["--dataset", "OTHER"], "is on other data than"),
    ],
)
def test_what_contradicts_the_checkpoint_is_refused(finished, tmp_path, script, arguments, sentence):
    other = write_hdf5(tmp_path / "other.hdf5", d4rl_arrays(40))
    before = result(finished)
    process = run(*command(script, "--run-dir", finished, *[other if a == "OTHER" else a for a in arguments]))
    assert process.returncode == 1 and sentence in process.stderr and process.stderr.count("\n") == 1
    assert result(finished) == before
    moved = shutil.copy(DATASET, tmp_path / "moved.hdf5")  # the same data elsewhere are no other data
    assert run(*command("wpc", "--run-dir", finished, "--dataset", moved)).returncode == 0


def test_two_at_once(tmp_path):
    first = start(*command("wpc", "--run-dir", tmp_path / "one", "--max-timesteps", 100_000))
    until((tmp_path / "one/checkpoint.pt").exists, first)
    second = run(*command("wpc", "--run-dir", tmp_path / "one", "--max-timesteps", 100_000))
    assert second.returncode == 1 and "in use by another process" in second.stderr
    first.kill()
    first.communicate()
    pair = [start(*command("wpc", "--max-timesteps", 1), cwd=tmp_path) for _ in range(2)]
    for process in pair:
        assert process.communicate(timeout=60)[1] == "" and process.returncode == 0
    assert len(list((tmp_path / "runs").iterdir())) == 2


@pytest.mark.parametrize("limit", [100, 20_000, 1_000_000])
def test_disk_full(finished, tmp_path, limit):
    shutil.copytree(finished, tmp_path / "run")
    before = result(tmp_path / "run")
    process = run(
        *command("wpc", "--run-dir", tmp_path / "run", "--max-timesteps", 400),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    assert process.returncode == 1 and "File too large" in process.stderr
    assert "Traceback" not in process.stderr and process.stderr.count("\n") == 1, process.stderr
    checkpoint = wpc.load_checkpoint(tmp_path / "run")
    assert checkpoint["step"] == 300 and json.loads((tmp_path / "run/args.json").read_text())
    assert run(*command("wpc", "--run-dir", tmp_path / "run")).returncode == 0  # space again
    assert result(tmp_path / "run") == before


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    for run_dir in (tmp_path / "file", tmp_path / "file/run", "/proc/run"):
        process = run(*command("wpc", "--run-dir", run_dir))
        assert process.returncode == 1 and process.stderr.count("\n") == 1 and "Traceback" not in process.stderr


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["--env", "hopper-medium-v0"], "--env hopper-medium-v0 is none of halfcheetah-random-v2"),
        (["--env", "ant"], "with --dataset also halfcheetah, hopper, walker2d"),
        (["--env", "hopper"], "'observations' is (90000, 17), where (90000, 11) was expected"),
        (["--dataset", "nowhere.hdf5"], "there is no nowhere.hdf5"),
        (["--tau", "1.5"], "--tau is 1.5, but must be from 0 to 1"),
        (["--discount", "nan"], "--discount is nan"),
        (["--alpha", "inf"], "--alpha is inf"),
        (["--alpha", "-1"], "--alpha is -1.0"),
        (["--q-lr", "-1"], "--q-lr is -1.0"),
        (["--batch-size", "0"], "--batch-size is 0, but must be from 1"),
        (["--eval-freq", "0"], "--eval-freq is 0"),
        (["--seed", "-1"], "--seed is -1"),
        (["--device", "cuda"], "--device cuda and --cudagraphs need a GPU"),
        (["--cudagraphs"], "--cudagraphs need a GPU: leave them out"),
    ],
)
def test_mistakes_get_one_sentence(tmp_path, arguments, sentence):
    if arguments[-1] == "cuda" and torch.cuda.is_available():
        sentence = ""
    process = run(*command("wpc", *arguments), cwd=tmp_path)
    assert sentence in process.stderr and "Traceback" not in process.stderr
    assert process.returncode == 1 and process.stderr.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_divergence_is_told_and_the_last_checkpoint_kept(tmp_path):
    process = run(*command("wpc", *"--q-lr 1e6 --v-lr 1e6 --policy-lr 1e6".split(), "--run-dir", tmp_path / "lr"))
    assert process.returncode == 1 and "diverged by step 50: not finite are" in process.stderr
    assert "critic_loss" in process.stderr and "Traceback" not in process.stderr
    assert wpc.load_checkpoint(tmp_path / "lr")["step"] == 0
    process = run(*command("wpc", *"--q-lr 1e3 --v-lr 1e3 --policy-lr 1e3".split(), "--run-dir", tmp_path / "1e3"))
    assert process.returncode == 0 and "Q is over twice" in process.stdout  # runs away, but stays finite
    arrays = d4rl_arrays(400)
    arrays["rewards"] = arrays["rewards"] * np.float32(1e30)
    huge = write_hdf5(tmp_path / "huge.hdf5", arrays)
    process = run(*command("wpc", "--dataset", huge, "--run-dir", tmp_path / "huge", "--log-freq", 10**6))
    assert process.returncode == 1 and "diverged by step 100: not finite are critic_loss, v_loss" in process.stderr
    assert wpc.load_checkpoint(tmp_path / "huge")["step"] == 0


def test_runaway_q_is_told_once(tmp_path):
    arrays = d4rl_arrays(400)
    arrays["rewards"] = np.zeros(400, np.float32)  # the best return is 0, and any Q above it too much
    small = write_hdf5(tmp_path / "small.hdf5", arrays)
    arguments = ["--max-timesteps", 100, "--discount", 1, "--dataset", small]
    seeds = [run(*command("wpc", *arguments, "--seed", seed, "--run-dir", tmp_path / str(seed))) for seed in range(4)]
    counts = [process.stdout.count("Q is over twice the data's best discounted return") for process in seeds]
    assert set(counts) <= {0, 1} and 1 in counts
    for seed, count in enumerate(counts):
        above = [v > 0 for _, v in curves(tmp_path / str(seed))["train/target_q"]]
        assert count == any(above) and seeds[seed].returncode == 0
    assert "a smaller --alpha" in seeds[counts.index(1)].stdout


def damage(content, rng):
    """The bytes with some flipped, or cut short."""
    content = bytearray(content)
    if rng.random() < 0.3:
        return bytes(content[: rng.integers(len(content))])
    for i in rng.integers(len(content), size=rng.integers(1, 4)):
        content[i] ^= 1 << rng.integers(8)
    return bytes(content)


def test_damaged_datasets(tmp_path):
    rng, told = np.random.default_rng(0), 0
    arrays = d4rl_arrays(40)
    plain = write_hdf5(tmp_path / "plain.hdf5", arrays)
    with h5py.File(tmp_path / "packed.hdf5", "w") as file:
        for key, value in arrays.items():
            file.create_dataset(key, data=value, compression="gzip", chunks=True)
    for i in range(400):
        path = tmp_path / "damaged.hdf5"
        path.write_bytes(damage((plain, tmp_path / "packed.hdf5")[i % 2].read_bytes(), rng))
        try:
            with np.errstate(all="ignore"):
                transitions, mean, std, *_ = wpc.load_dataset(path, 17, 6, wpc.Args(normalize=False))
            assert transitions.shape[1] == 43 and 0 < len(transitions) < 40 and torch.isfinite(transitions).all()
        except SystemExit as stop:
            told += 1
            assert str(path) in stop.code and "\n" not in stop.code
    assert told > 100


def test_damaged_checkpoints_are_told(finished, tmp_path):
    rng, content = np.random.default_rng(0), (finished / "checkpoint.pt").read_bytes()
    good, told = checkpoint_bits(torch.load(finished / "checkpoint.pt", weights_only=True)), 0
    for _ in range(150):
        (tmp_path / "checkpoint.pt").write_bytes(damage(content, rng))
        try:  # not told only if the damage hit what is never read, such as the padding between entries
            assert checkpoint_bits(wpc.load_checkpoint(tmp_path)) == good
        except SystemExit as stop:
            told += 1
            assert "is damaged" in stop.code and "previous.pt" in stop.code and "\n" not in stop.code
    assert told > 140


def test_a_damaged_checkpoint_and_the_one_before_it(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    (tmp_path / "run/checkpoint.pt").write_bytes((finished / "checkpoint.pt").read_bytes()[:-100])
    process = run(*command("wpc", "--run-dir", tmp_path / "run"))
    assert process.returncode == 1 and "checkpoint.pt is damaged: delete it to go on" in process.stderr
    (tmp_path / "run/checkpoint.pt").unlink()
    assert run(*command("wpc", "--run-dir", tmp_path / "run")).returncode == 0
    assert result(tmp_path / "run") == result(finished)


def test_nothing_in_a_checkpoint_is_run(tmp_path):
    class Malicious:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harm"),)

    torch.save({"args": Malicious()}, tmp_path / "checkpoint.pt")
    assert zipfile.is_zipfile(tmp_path / "checkpoint.pt")
    with pytest.raises(SystemExit, match="is damaged"):
        wpc.load_checkpoint(tmp_path)
    assert not (tmp_path / "harm").exists()
    torch.load(tmp_path / "checkpoint.pt", weights_only=False)
    assert (tmp_path / "harm").exists()  # it would have


def test_the_help_explains_every_argument(script):
    text = " ".join(run(sys.executable, script.__file__, "--help").stdout.replace("│", " ").split())
    for name in script.Args.__dataclass_fields__:
        assert f"--{name.replace('_', '-')}" in text
    assert "steps from one update of the policy" in text


@pytest.mark.parametrize("name", SCRIPTS)
def test_learning(name, tmp_path):
    """2,000 steps bring the policy closer to the actions of the dataset's last, best episodes.

    A score after so few steps depends on the seed; this distance fell in each of ten tries, to less than two thirds.
    """
    run(*command(name, "--max-timesteps", 2000, "--eval-freq", 2000, "--run-dir", tmp_path))
    script = SCRIPTS[name]
    transitions, *_ = script.load_dataset(DATASET, 17, 6, script.Args())
    s, a = transitions[-20_000:, :17], transitions[-20_000:, 17:23]
    actor = script.make_networks(17, 6, script.Args(), "cpu")[0]["actor"]
    before = (actor(s) - a).abs().mean().item()
    actor.load_state_dict(torch.load(tmp_path / "checkpoint.pt", weights_only=True)["networks"]["actor"])
    after = (actor(s) - a).abs().mean().item()
    assert after < 0.7 * before
