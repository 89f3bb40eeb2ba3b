# SPDX-License-Identifier: MIT
"""Every mistake that the scripts tell a user of, with the sentence that tells it.

The sentences are as the user reads them, but for {path}, the dataset or the folder at
fault, and for "[...]", which stands for words of a library's own.
"""

import json
import re

import h5py
import numpy as np
import pytest
from conftest import (
    DATASET,
    SCRIPTS,
    command,
    d4rl_arrays,
    files,
    load,
    read_rows,
    refusal,
    run_here,
    wpc,
    write_hdf5,
)

# Arguments; tyro shows these in a box

TASKS = (
    "(halfcheetah|hopper|walker2d)-"
    "(random|medium-replay|full-replay|medium-expert|medium|expert)(-v2)?"
)
NUMBERS = (
    "eval_freq, eval_episodes, batch_size and policy_freq must be at least 1, discount "
    "and tau from 0 to 1"
)
ARGUMENTS = [
    (["--eval-freq", 0], NUMBERS),
    (["--eval-episodes", 0], NUMBERS),
    (["--batch-size", 0], NUMBERS),
    (["--policy-freq", -1], NUMBERS),
    (["--discount", 1.1], NUMBERS),
    (["--discount", -0.1], NUMBERS),
    (["--discount", "nan"], NUMBERS),
    (["--tau", 1.5], NUMBERS),
    (["--tau", -0.5], NUMBERS),
    (["--device", "cuda:77"], "no --device cuda:77 here; cpu works"),
    (["--device", "gpu"], "no --device gpu here; cpu works"),
]


@pytest.mark.parametrize("arguments, sentence", ARGUMENTS)
def test_arguments(script, monkeypatch, capsys, arguments, sentence):
    monkeypatch.setattr(script, "train", pytest.fail)
    monkeypatch.setattr("sys.argv", ["script.py", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        script.main()
    shown = re.sub(r"[^!-~]+", "", capsys.readouterr().err)  # the box and its breaks
    assert stop.value.code == 2 and sentence.replace(" ", "") in shown


# Tasks

NO_TASKS = [
    "hopper",
    "hopper-v2",
    "hopper-medium-v0",
    "walker2d-medum-v2",
    "hopper-medium-v2-v2",
    "hopper-",
    "ant-medium-v2",
    "HalfCheetah-v4",
]


@pytest.mark.parametrize("env", NO_TASKS)
def test_tasks(script, monkeypatch, tmp_path, env):
    """They are refused before a server is asked."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(script, "urlopen", pytest.fail)
    shown = refusal(script, "python", "script.py", "--env", env, "--device", "cpu")
    assert shown == f"without --dataset, --env must be {TASKS}"
    assert not list(tmp_path.iterdir())


# What doesn't fit or is not there, found before the first step

STARTS = [
    (["--env", "NoRobot-v4"], "Environment `NoRobot` doesn't exist."),
    (["--env", "hopper-mixed-v9"], "Environment `hopper-mixed` doesn't exist."),
    (["--env", "hopper-v4"], "Environment `hopper` doesn't exist. [...]"),
    (["--env", "nowhere:Robot-v0"], "No module named 'nowhere'. [...]"),
    (["--env", "HalfCheetah-v3"], "The mujoco v2 and v3 [...]"),
    (["--env", "Hopper-v2"], "The mujoco v2 and v3 [...]"),
    (["--env", "CartPole-v1"], "--env CartPole-v1 needs one-dimensional Boxes [...]"),
    (["--dataset", "no.hdf5"], "no.hdf5 can't be read: [...]"),
    (["--run-dir", "file"], "[...]file[...]"),
    (["--run-dir", "file/run"], "[...]file/run[...]"),
]


def matches(sentence, shown, **names):
    """The sentence is what is shown, a single line."""
    words = sentence.format(**names) if names else sentence
    pattern = ".*".join(re.escape(part) for part in words.split("[...]"))
    return re.fullmatch(pattern, shown) and "\n" not in shown


@pytest.mark.parametrize("arguments, sentence", STARTS)
def test_starts(monkeypatch, tmp_path, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("content")
    shown = refusal(wpc, *command("wpc", *arguments))
    assert matches(sentence, shown), shown
    assert files(tmp_path) == {"file": b"content"}


# Datasets


def without(key):
    return lambda arrays: arrays.pop(key)


def replaced(key, change):
    return lambda arrays: arrays.update({key: change(arrays[key])})


def with_value(key, value, row=7):
    def change(array):
        array = array.astype(np.float64)
        array[row] = value
        return array

    return replaced(key, change)


def every(change):
    return lambda arrays: arrays.update({k: change(v) for k, v in arrays.items()})


UNREADABLE = (
    "{path} can't be read: [...]; D4RL's format has arrays of observations, actions, "
    "rewards, terminals and timeouts (1 where an episode was cut off)"
)
SHAPE = "not ({}, {}) as rewards and --env require; MATLAB reverses axes"
WRONG = (
    "{path}: {key} is wrong in {count} row(s), first in row 7 ({value}): numbers must "
    "be finite, terminals and timeouts 0 or 1, and actions within +-1.0"
)
NO_TRANSITIONS = "the dataset has 0 transitions: it needs rows with no timeout"
DATASETS = [
    *[
        (without(key), UNREADABLE.replace("[...]", f"[...]'{key}' doesn't exist[...]"))
        for key in ("observations", "actions", "rewards", "terminals", "timeouts")
    ],
    (
        lambda a: a.update({"actions/arm": a.pop("actions"), "actions/leg": 1}),
        UNREADABLE.replace("[...]", "actions is a group of ['arm', 'leg']"),
    ),
    (
        lambda a: a.update({"rewards": 1.0}),
        UNREADABLE.replace("[...]", "Illegal slicing argument for scalar dataspace"),
    ),
    (
        replaced("actions", lambda x: x[:-1]),
        "{path}: actions has shape (39, 6), " + SHAPE.format(40, 6),
    ),
    (
        replaced("timeouts", lambda x: x[:-2]),
        "{path}: timeouts has shape (38, 1), " + SHAPE.format(40, 1),
    ),
    (
        replaced("observations", lambda x: x[:, :11]),
        "{path}: observations has shape (40, 11), " + SHAPE.format(40, 17),
    ),
    (
        replaced("actions", lambda x: x.T),
        "{path}: actions has shape (6, 40), " + SHAPE.format(40, 6),
    ),
    (
        every(lambda x: np.atleast_2d(x.T)),
        "{path}: observations has shape (17, 40), " + SHAPE.format(1, 17),
    ),
    (
        replaced("rewards", lambda x: x[:-1]),
        "{path}: observations has shape (40, 17), " + SHAPE.format(39, 17),
    ),
    (
        replaced("rewards", lambda x: np.stack([x, x], 1)),
        "{path}: rewards has shape (40, 2), " + SHAPE.format(40, 1),
    ),
    (
        lambda a: a.update(next_observations=a["observations"][:-1]),
        "{path}: next_observations has shape (39, 17), " + SHAPE.format(40, 17),
    ),
    *[
        (with_value(key, value), WRONG.replace("{key}", key).replace("{value}", shown))
        for key, value, shown in [
            ("observations", np.nan, "nan"),
            ("actions", -np.inf, "-inf"),
            ("rewards", np.inf, "inf"),
            ("terminals", np.nan, "nan"),
            ("actions", 1.1, "1.1"),
            ("actions", -5, "-5"),
            ("terminals", 255, "255"),
            ("terminals", -1, "-1"),
            ("terminals", 0.5, "0.5"),
            ("timeouts", 2, "2"),
        ]
    ],
    (
        with_value("observations", np.nan, row=slice(7, 40)),
        WRONG.replace("{key}", "observations")
        .replace("{count}", "33")
        .replace("{value}", "nan"),
    ),
    (every(lambda x: x[:0]), NO_TRANSITIONS),
    (every(lambda x: x[:1]), NO_TRANSITIONS),
    (
        lambda a: a.update(timeouts=np.ones(40, bool), terminals=np.zeros(40, bool)),
        NO_TRANSITIONS,
    ),
]


@pytest.mark.filterwarnings("error")  # and no warning stands before the sentence
@pytest.mark.parametrize("spoil, sentence", DATASETS)
def test_datasets(tmp_path, capsys, spoil, sentence):
    arrays = d4rl_arrays(40)
    spoil(arrays)
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    args = wpc.Args(env="halfcheetah", dataset=str(path), device="cpu")
    with pytest.raises(wpc.UserError) as stop:
        wpc.prepare_dataset(wpc.read_dataset(path, 17, 6, 1.0), args)
    assert matches(sentence, str(stop.value), path=path, count=1), stop.value
    assert capsys.readouterr() == ("", "")


FILES = {
    "empty": b"",
    "a web page": b"<html>Please sign in</html>",
    "cut short": (lambda content: content[:100_000]),
}


@pytest.mark.parametrize("kind", FILES)
def test_files_that_are_no_datasets(tmp_path, kind):
    content, path = FILES[kind], tmp_path / "data.hdf5"
    if callable(content):
        write_hdf5(path, d4rl_arrays(4000))
        content = content(path.read_bytes())
    path.write_bytes(content)
    shown = refusal(wpc, *command("wpc", "--dataset", path, "--run-dir", tmp_path))
    assert matches(UNREADABLE, shown, path=path), shown
    assert files(tmp_path) == {"data.hdf5": content}


def test_a_download_that_fails(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path))
    monkeypatch.setattr(wpc, "D4RL_SERVERS", ["http://127.0.0.1:9/"])
    shown = refusal(wpc, "python", "wpc.py", "--env", "hopper-medium-v2")
    assert shown == (
        f"{tmp_path}/hopper_medium-v2.hdf5 is missing: give a --dataset, or set "
        "D4RL_DATASET_DIR"
    )
    assert "Connection refused" in capsys.readouterr().out


# Run folders

ANOTHER = "{path} has another {name}: choose another --run-dir"
RUNS = [
    ("wpc", ["--seed", 1], "seed"),
    ("wpc", ["--alpha", 1.0], "alpha"),
    ("wpc", ["--batch-size", 32], "batch_size"),
    ("td3_bc", [], "value_lr"),
    ("wbc", [], "alpha"),
    ("wpc", ["--dataset", "other.hdf5"], "dataset_contents"),
]


@pytest.mark.parametrize("name, arguments, differs", RUNS)
def test_runs_that_differ(monkeypatch, run_dir, tmp_path, name, arguments, differs):
    monkeypatch.chdir(tmp_path)
    with h5py.File(DATASET) as file:
        arrays = {key: file[key][:-1000] for key in file if key != "metadata"}
    write_hdf5("other.hdf5", arrays)
    before, line = files(run_dir), command(name, "--run-dir", run_dir, *arguments)
    shown = refusal(SCRIPTS[name], *line)
    path = run_dir / "checkpoint.pt"
    assert matches(ANOTHER, shown, path=path, name=differs), shown
    assert files(run_dir) == before


def damaged(content, kind):
    half = len(content) // 2
    damages = {"empty": b"", "cut short": content[:half], "another's": b"text" * half}
    return damages[kind]


@pytest.mark.parametrize("kind", ["empty", "cut short", "another's"])
def test_a_damaged_checkpoint_stops_the_run_and_stays(run_dir, kind):
    content = (run_dir / "checkpoint.pt").read_bytes()
    (run_dir / "checkpoint.pt").write_bytes(damaged(content, kind))
    before = files(run_dir)
    line = command("wpc", "--run-dir", run_dir, "--max-timesteps", 80)
    sentence = f"{run_dir / 'checkpoint.pt'} can't be read: choose another --run-dir"
    assert refusal(wpc, *line) == sentence
    assert files(run_dir) == before


def test_two_processes_in_one_folder(tmp_path, monkeypatch):
    """The second to save finds the other's checkpoint, and leaves all as it is."""
    real_evaluate, line = wpc.evaluate, command("wpc", "--run-dir", tmp_path)

    def evaluate(*arguments):
        monkeypatch.setattr(wpc, "evaluate", real_evaluate)
        run_here(wpc, *line, "--seed", 1)
        return real_evaluate(*arguments)

    monkeypatch.setattr(wpc, "evaluate", evaluate)
    shown = refusal(wpc, *line)
    assert shown == f"{tmp_path} is used by another process too"
    assert load(tmp_path)["args"]["seed"] == 1 and load(tmp_path)["step"] == 60
    assert json.loads((tmp_path / "args.json").read_text())["seed"] == 1
    assert len(read_rows(tmp_path)) == 3


def test_a_finished_run(run_dir, capsys):
    run_here(wpc, *command("wpc", "--run-dir", run_dir))
    line = f"{run_dir} is finished; raise --max-timesteps to train longer"
    assert line in capsys.readouterr().out.splitlines()


def test_a_diverged_run_keeps_the_last_checkpoint(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)  # where MuJoCo logs that the actions are NaN
    line = command("wpc", "--critic-lr", "1e30", "--run-dir", tmp_path / "run")
    sentence = refusal(wpc, *line)
    expected = "diverged by step 30, which isn't saved: {[...]'q': nan[...]}"
    assert matches(expected, sentence), sentence
    checkpoint = load(tmp_path / "run")
    assert checkpoint["step"] == 0 and len(checkpoint["evaluations"]) == 1
    for network in ("actor", "critic", "value"):
        parameters = checkpoint["agent"][network].values()
        assert all(parameter.isfinite().all() for parameter in parameters)
    assert "step 30" not in capsys.readouterr().out
