# SPDX-License-Identifier: MIT
"""What goes wrong gets one sentence that is true, and destroys nothing."""

import errno
import json
import os
import resource
import signal
import time

import numpy as np
import pytest
import torch
from conftest import (
    as_bits,
    assert_one_sentence,
    command,
    d4rl_arrays,
    load,
    read_curves,
    refusal,
    result,
    run,
    start,
    wait_until,
    wpc,
    write_hdf5,
)
from test_data import damage

# Wrong arguments

MISTAKES = [
    (["--env", "ant"], "--env ant can't be made: Environment `ant` doesn't exist"),
    (["--env", "hopper"], "'observations' has shape (90000, 17), not (90000, 11)"),
    (["--dataset", "nowhere.hdf5"], "nowhere.hdf5 is no file: name one"),
    (["--dataset", "."], ". is no file: name one"),
    (["--tau", "1.5"], "--tau is 1.5, but must be from 0 to 1"),
    (["--discount", "nan"], "--discount is nan"),
    (["--alpha", "inf"], "--alpha is inf"),
    (["--alpha", "-1"], "--alpha is -1.0"),
    (["--beta", "0"], "--beta is 0.0"),
    (["--critic-lr", "-1"], "--critic-lr is -1.0"),
    (["--batch-size", "0"], "--batch-size is 0, but must be from 1"),
    (["--batch-size", "100000"], "too few for --batch-size 100000"),
    (
        ["--eval-episodes", "1001"],
        "--eval-episodes is 1001, but must be from 1 to 1000",
    ),
    (["--eval-freq", "0"], "--eval-freq is 0"),
    (["--policy-freq", "0"], "--policy-freq is 0"),
    (["--seed", "-1"], "--seed is -1"),
]


@pytest.mark.parametrize("arguments, sentence", MISTAKES)
def test_mistakes_get_one_sentence(monkeypatch, tmp_path, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    assert sentence in refusal(wpc, *command("wpc", *arguments))
    assert not (tmp_path / "runs").exists()


def test_a_mistake_ends_the_process_with_that_sentence_alone(tmp_path):
    line = [*command("wpc")[:2], "--env", "hopper-medium-v0"]
    sentence = "--env is hopper-medium-v0: name a D4RL task (halfcheetah-random-v2, "
    assert_one_sentence(run(*line, cwd=tmp_path), sentence)


def test_a_gpu_that_is_not_there(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match="--device cuda needs a GPU"):
        wpc.check_args(wpc.Args(env="hopper-medium-v2", device="cuda"))


def test_every_number_has_limits(script):
    numbers = {
        name
        for name, value in vars(script.Args()).items()
        if type(value) in (int, float) or name == "alpha"
    }
    assert script.LIMITS.keys() == numbers


def test_run_folders_that_cannot_be(tmp_path):
    (tmp_path / "file").write_text("content")
    for run_dir in (tmp_path / "file", tmp_path / "file/run", "/proc/run"):
        sentence = refusal(wpc, *command("wpc", "--run-dir", run_dir))
        assert "or choose another --run-dir" in sentence
    assert (tmp_path / "file").read_text() == "content"


def test_a_folder_of_another_version(run_dir):
    args = json.loads((run_dir / "args.json").read_text())
    (run_dir / "args.json").write_text(json.dumps(args | {"v_lr": 1.0}))
    before = result(run_dir)
    sentence = refusal(wpc, *command("wpc")[:2], "--run-dir", run_dir)
    assert "or another version of wpc.py" in sentence
    assert result(run_dir) == before


# Damage


def test_damaged_checkpoints(finished, tmp_path):
    """They are told, or load as they were: the damage hit what is never read."""
    rng, content = np.random.default_rng(0), (finished / "checkpoint.pt").read_bytes()
    good, told = as_bits(load(finished)), 0
    for i in range(150):
        damaged = damage(content, rng) if i else b""
        (tmp_path / "checkpoint.pt").write_bytes(damaged)
        try:
            assert as_bits(wpc.load_checkpoint(tmp_path)) == good
        except SystemExit as stop:
            told += 1
            assert "checkpoint.pt" in stop.code and "\n" not in stop.code
            assert "damaged" in stop.code or "can't be loaded" in stop.code
            assert "delete" not in stop.code
    assert told > 140


def test_a_damaged_checkpoint_stops_the_run(run_dir):
    content = (run_dir / "checkpoint.pt").read_bytes()[:-100]
    (run_dir / "checkpoint.pt").write_bytes(content)
    sentence = refusal(wpc, *command("wpc")[:2], "--run-dir", run_dir)
    assert "checkpoint.pt can't be loaded (BadZipFile" in sentence
    assert (run_dir / "checkpoint.pt").read_bytes() == content


def test_damaged_arguments_stop_the_run(run_dir):
    (run_dir / "args.json").write_text("{")
    sentence = refusal(wpc, *command("wpc")[:2], "--run-dir", run_dir)
    assert "args.json can't be read" in sentence


def test_the_true_reason_why_a_checkpoint_cannot_be_loaded(monkeypatch, run_dir):
    def refuse(*args, **kwargs):
        raise PermissionError(errno.EACCES, "Permission denied", "checkpoint.pt")

    monkeypatch.setattr(torch, "load", refuse)
    with pytest.raises(SystemExit, match="Permission denied") as stop:
        wpc.load_checkpoint(run_dir)
    assert "damaged" not in stop.value.code


def test_nothing_in_a_checkpoint_is_run(tmp_path):
    class Malicious:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harm"),)

    torch.save({"step": Malicious()}, tmp_path / "checkpoint.pt")
    with pytest.raises(SystemExit, match="can't be loaded"):
        wpc.load_checkpoint(tmp_path)
    assert not (tmp_path / "harm").exists()
    torch.load(tmp_path / "checkpoint.pt", weights_only=False)
    assert (tmp_path / "harm").exists()  # it would have been


# No space, no memory


@pytest.mark.parametrize("limit", [100, 20_000, 1_000_000])
def test_a_full_disk(run_dir, limit):
    before = result(run_dir)
    limits = (limit, limit)
    process = run(
        *command("wpc", "--run-dir", run_dir, "--max-timesteps", 80),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits),
    )
    assert_one_sentence(process, "the run folder can't be written ([Errno 27] File too")
    assert as_bits(load(run_dir)) == before[0]
    assert run(*command("wpc", "--run-dir", run_dir)).returncode == 0  # space again
    assert as_bits(load(run_dir)) == before[0]


@pytest.mark.parametrize("moment", ["write", "replace"])
def test_a_file_is_written_whole_or_not_at_all(monkeypatch, tmp_path, moment):
    path = tmp_path / "file"
    wpc.write_file(path, b"old")

    def fail(*args):
        raise OSError(errno.EIO, "broken")

    monkeypatch.setattr(os, {"write": "fsync", "replace": "replace"}[moment], fail)
    with pytest.raises(OSError, match="broken"):
        wpc.write_file(path, b"new")
    assert path.read_bytes() == b"old"
    monkeypatch.undo()
    wpc.write_file(path, b"new")
    assert path.read_bytes() == b"new"


def test_out_of_memory():
    """NumPy's error, PyTorch's on a GPU, and its own words on a CPU."""
    with pytest.raises(RuntimeError) as on_a_cpu:
        torch.empty(10**15)
    on_a_gpu = torch.OutOfMemoryError("CUDA out of memory")
    for error in (MemoryError(), on_a_gpu, on_a_cpu.value):
        with pytest.raises(SystemExit, match="out of memory"):
            run_main(error)


@pytest.mark.parametrize("error", [RuntimeError("a bug"), OSError("a bug"), KeyError()])
def test_our_own_mistakes_keep_their_traceback(error):
    with pytest.raises(type(error)):
        run_main(error)


def run_main(error):
    """wpc.main, in which training fails so."""

    def train(args):
        raise error

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wpc, "train", train)
        patch.setattr(wpc, "parse_args", lambda: None)
        patch.setattr("sys.stdout.reconfigure", lambda **_: None, raising=False)
        wpc.main()


# Divergence


def test_divergence_stops_the_run_and_keeps_the_last_checkpoint(tmp_path):
    arrays = d4rl_arrays(400)
    arrays["rewards"][300:] = 1e30  # rarely met at first
    path = write_hdf5(tmp_path / "huge.hdf5", arrays)
    line = ["--dataset", path, "--batch-size", 1, "--eval-freq", 1, "--seed", 1]
    process = run(*command("wpc", *line, "--run-dir", tmp_path / "run"))
    assert_one_sentence(process, "diverged by step")
    networks = load(tmp_path / "run")["networks"].values()
    assert all(parameter.isfinite().all() for parameter in networks)


def test_a_diverged_run_that_is_stopped_saves_nothing(tmp_path):
    arrays = d4rl_arrays(400)
    arrays["rewards"] = np.full(400, 1e30, np.float32)
    path = write_hdf5(tmp_path / "huge.hdf5", arrays)
    never = 1_000_000
    line = ["--eval-freq", never, "--log-freq", never, "--max-timesteps", never]
    line += ["--dataset", path, "--run-dir", tmp_path / "run"]
    process = start(*command("wpc", *line))
    wait_until((tmp_path / "run/args.json").exists, process)
    time.sleep(2)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate()
    assert process.returncode == 1 and errors.startswith("diverged by step"), errors
    assert not (tmp_path / "run/checkpoint.pt").exists()


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_metric_or_a_parameter_that_is_not_finite(script, number):
    agent = script.Agent(3, 1, 1.0, script.Args())
    wpc.check_finite(agent, {"q": torch.tensor(1.0)}, step=7)
    with pytest.raises(SystemExit, match="diverged by step 7"):
        wpc.check_finite(agent, {"q": torch.tensor(number)}, step=7)
    for name in ("actor", "critic_target"):
        agent = script.Agent(3, 1, 1.0, script.Args())
        next(getattr(agent, name).parameters()).data[0, 0] = number
        with pytest.raises(SystemExit, match="diverged by step 7"):
            wpc.check_finite(agent, {}, step=7)


@pytest.mark.parametrize(
    "best, q, away", [(10, 12.1, 1), (10, 11.9, 0), (-10, 12.1, 1)]
)
def test_q_runs_away_from_1_2_times_the_best_discounted_return_on(best, q, away):
    assert wpc.q_runs_away(q, best) == away


def test_a_run_tells_once_that_q_runs_away(tmp_path):
    arrays = d4rl_arrays(400)
    arrays["rewards"] = np.full(400, 1e-3, np.float32)  # Q starts far above that
    path = write_hdf5(tmp_path / "small.hdf5", arrays)
    line = ["--max-timesteps", 20, "--log-freq", 1, "--seed", 3, "--dataset", path]
    process = run(*command("wpc", *line, "--run-dir", tmp_path / "run"))
    curve = [q for _, q in read_curves(tmp_path / "run")["train/q"]]
    best = 1e-3 * sum(0.99**t for t in range(10))
    assert sum(q > 1.2 * best for q in curve) > 1
    warning = (
        f"the dataset's best discounted return, {best:.0f}, and may be running away"
    )
    assert process.stdout.count(warning) == 1
