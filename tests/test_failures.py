# SPDX-License-Identifier: MIT
"""What goes wrong gets one sentence that is true, and destroys nothing."""

import errno
import os
import resource
import sys

import gymnasium as gym
import pytest
import torch
from conftest import (
    as_bits,
    assert_one_sentence,
    command,
    files,
    load,
    refusal,
    result,
    run,
    run_here,
    wpc,
)

# Wrong arguments

MISTAKES = [
    (["--env", "NoRobot-v4"], "Environment `NoRobot` doesn't exist"),
    (["--env", "hopper"], "observations must be finite, in shape (90000, 11)"),
    (["--dataset", "nowhere.hdf5"], "nowhere.hdf5 can't be read: "),
]


@pytest.mark.parametrize("arguments, sentence", MISTAKES)
def test_mistakes_get_one_sentence(monkeypatch, tmp_path, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    assert sentence in refusal(wpc, *command("wpc", *arguments))
    assert not (tmp_path / "runs").exists()


OUT_OF_BOUNDS = {
    "steps, frequencies, episodes and batch_size must be >= 1": [
        {"max_timesteps": 0},
        {"eval_freq": 0},
        {"eval_episodes": 0},
        {"batch_size": 0},
        {"policy_freq": -1},
    ],
    "discount and tau must be between 0 and 1": [
        {"discount": 1.1},
        {"discount": -0.1},
        {"discount": float("nan")},
        {"tau": 1.5},
        {"tau": -0.5},
    ],
    "HalfCheetah-v4 can't be downloaded: it needs --dataset": [
        {"env": "HalfCheetah-v4"}
    ],
    "ant-medium-v2 can't be downloaded: it needs --dataset": [{"env": "ant-medium-v2"}],
}
CASES = [(options, text) for text, cases in OUT_OF_BOUNDS.items() for options in cases]


@pytest.mark.parametrize("options, sentence", CASES)
def test_arguments_out_of_bounds(script, options, sentence):
    with pytest.raises(ValueError, match=sentence):
        script.Args(**options)


def test_the_bounds_themselves_are_fine(script):
    script.Args(discount=0, tau=0, max_timesteps=1, eval_episodes=1)
    script.Args(discount=1, tau=1, eval_freq=1, batch_size=1, policy_freq=1)


def test_a_mistake_ends_the_process_with_that_sentence(tmp_path):
    """tyro puts it into a box."""
    process = run(*command("wpc")[:2], "--env", "ant-medium-v2", cwd=tmp_path)
    assert "ant-medium-v2 can't be downloaded: it needs --dataset" in process.stderr
    assert process.returncode == 2 and "Traceback" not in process.stderr
    assert list(tmp_path.iterdir()) == []


def test_run_folders_that_cannot_be(tmp_path):
    (tmp_path / "file").write_text("content")
    for run_dir in (tmp_path / "file", tmp_path / "file/run"):
        assert str(run_dir) in refusal(wpc, *command("wpc", "--run-dir", run_dir))
    assert (tmp_path / "file").read_text() == "content"


# Damage


def damaged(content, kind):
    half = len(content) // 2
    damages = {"empty": b"", "cut short": content[:half], "another's": b"text" * half}
    return damages[kind]


@pytest.mark.parametrize("kind", ["empty", "cut short", "another's"])
def test_a_damaged_checkpoint_stops_the_run_and_stays(run_dir, kind):
    content = (run_dir / "checkpoint.pt").read_bytes()
    (run_dir / "checkpoint.pt").write_bytes(damaged(content, kind))
    before = files(run_dir)
    with pytest.raises(Exception) as error:  # PyTorch's own, with its traceback
        run_here(wpc, *command("wpc", "--run-dir", run_dir, "--max-timesteps", 80))
    assert not isinstance(error.value, KeyError), error.value
    assert files(run_dir) == before


def test_nothing_in_a_checkpoint_is_run(tmp_path):
    class Malicious:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harm"),)

    torch.save({"step": Malicious()}, tmp_path / "checkpoint.pt")
    with pytest.raises(Exception, match="weights_only"):
        run_here(wpc, *command("wpc", "--run-dir", tmp_path))
    assert not (tmp_path / "harm").exists()
    torch.load(tmp_path / "checkpoint.pt", weights_only=False)
    assert (tmp_path / "harm").exists()  # it would have been


# No space


def test_a_full_disk(run_dir):
    """Its room ends in the midst of the checkpoint."""
    before, line = result(run_dir), command("wpc", "--run-dir", run_dir)
    limits = (1_000_000, 1_000_000)
    process = run(
        *line,
        "--max-timesteps",
        80,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits),
    )
    assert_one_sentence(process, "[Errno 27] File too large")
    assert as_bits(load(run_dir)) == before[0]
    run_here(wpc, *line)  # space again
    assert result(run_dir) == before


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
    assert files(tmp_path) == {"file": b"new"}


# Errors


def run_main(monkeypatch, script, error):
    """The main function of a script in which training fails so."""

    def train(args):
        raise error

    monkeypatch.setattr(script, "train", train)
    monkeypatch.setattr(sys, "argv", ["script.py"])
    monkeypatch.setattr(sys, "orig_argv", ["python", "script.py"])
    script.main()


@pytest.mark.parametrize("error", [RuntimeError("a bug"), ValueError(), KeyError()])
def test_mistakes_in_the_code_keep_their_traceback(monkeypatch, script, error):
    with pytest.raises(type(error)):
        run_main(monkeypatch, script, error)


@pytest.mark.parametrize(
    "error", [OSError("a sentence"), gym.error.Error("a sentence")]
)
def test_others_get_their_sentence(monkeypatch, script, error):
    with pytest.raises(SystemExit, match="a sentence") as stop:
        run_main(monkeypatch, script, error)
    assert stop.value.code  # no success


def test_ctrl_c_ends_with_the_command_to_continue(monkeypatch, capsys, script):
    with pytest.raises((SystemExit, KeyboardInterrupt)) as stop:
        run_main(monkeypatch, script, KeyboardInterrupt())
    shown = stop.value.code.removeprefix("stopped; to continue: ")
    assert shown.startswith("python script.py --run-dir runs/hopper-medium-v2__")
    assert capsys.readouterr().out == f"to continue: {shown}\n"


# Divergence


def test_a_diverged_run_keeps_the_last_checkpoint(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)  # where MuJoCo logs that the actions are NaN
    line = command("wpc", "--critic-lr", "1e30", "--run-dir", tmp_path / "run")
    sentence = refusal(wpc, *line)
    assert sentence.startswith("diverged by step 30: ") and "'q': nan" in sentence
    checkpoint = load(tmp_path / "run")
    assert checkpoint["step"] == 0 and len(checkpoint["evaluations"]) == 1
    for network in ("actor", "critic", "value"):
        parameters = checkpoint["agent"][network].values()
        assert all(parameter.isfinite().all() for parameter in parameters)
    assert "step 30" not in capsys.readouterr().out
