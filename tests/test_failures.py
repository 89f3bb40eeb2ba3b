# SPDX-License-Identifier: MIT
"""What goes wrong gets one sentence that is true, and destroys nothing."""

import errno
import os
import resource
import subprocess
import sys

import gymnasium as gym
import pytest
import torch
from conftest import (
    ROOT,
    as_bits,
    assert_one_sentence,
    command,
    environment,
    files,
    load,
    refusal,
    result,
    run,
    run_here,
    wpc,
)

from wpc import UserError

# Arguments


def test_the_bounds_themselves_are_fine(script):
    script.Args(discount=0, tau=0, max_timesteps=0, eval_episodes=1)
    script.Args(discount=1, tau=1, eval_freq=1, batch_size=1, policy_freq=1)
    for env in ("hopper-medium-v2", "hopper-full-replay", "walker2d-medium-expert-v2"):
        script.Args(env=env)
    for env in ("hopper", "halfcheetah", "Hopper-v4", "Ant-v5", "my_envs:hopper-v0"):
        script.Args(env=env, dataset="data.hdf5")


def test_a_notebooks_cell_and_another_machines_mujoco_gl(script):
    """A cell has no __file__; training draws nothing, so it needs no such library."""
    code = (ROOT / f"{script.SCRIPT.stem}.py").read_text()
    code = "__name__ = 'cell'\n" + code + "\nprint(Args().run_dir)"
    options = {"capture_output": True, "text": True, "check": True}
    variables = environment() | {"MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "osmesa"}
    line = [sys.executable, "-c", "import sys; exec(sys.stdin.read(), {})"]
    process = subprocess.run(line, input=code, env=variables, **options)
    assert process.stdout.startswith("runs/hopper-medium-v2__null__0__20")


# Damage


def test_nothing_in_a_checkpoint_is_run(tmp_path):
    class Malicious:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harm"),)

    torch.save({"step": Malicious()}, tmp_path / "checkpoint.pt")
    assert "checkpoint.pt can't be read" in refusal(
        wpc, *command("wpc", "--run-dir", tmp_path)
    )
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
    script.main()


@pytest.mark.parametrize("error", [RuntimeError("a bug"), ValueError(), KeyError()])
def test_mistakes_in_the_code_keep_their_traceback(monkeypatch, script, error):
    with pytest.raises(type(error)):
        run_main(monkeypatch, script, error)


@pytest.mark.parametrize(
    "error",
    [
        OSError("a sentence"),
        gym.error.Error("a sentence"),
        ImportError("a sentence"),
        UserError("a sentence"),
    ],
)
def test_others_get_their_sentence(monkeypatch, script, error):
    if isinstance(error, UserError):
        error = script.UserError(*error.args)  # each script has its own
    with pytest.raises(SystemExit, match="a sentence") as stop:
        run_main(monkeypatch, script, error)
    assert stop.value.code  # no success


def test_ctrl_c_ends_without_a_traceback(monkeypatch, capsys, script):
    with pytest.raises((SystemExit, KeyboardInterrupt)) as stop:
        run_main(monkeypatch, script, KeyboardInterrupt())
    assert stop.value.code == "stopped"
    run_dir = "runs/hopper-medium-v2__"
    assert capsys.readouterr().out.startswith(f"to continue, add --run-dir '{run_dir}")
