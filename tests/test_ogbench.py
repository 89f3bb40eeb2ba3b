# SPDX-License-Identifier: MIT
"""from_ogbench.py: OGBench's own transitions, and the environment of its task."""

import importlib.util
import sys

import gymnasium as gym
import h5py
import mujoco
import numpy as np
import pytest
from conftest import ROOT, read_rows, run, wpc

sys.path.insert(0, str(ROOT / "tests/tools"))
import from_ogbench

INSTALLED = importlib.util.find_spec("ogbench") is not None
needs_ogbench = pytest.mark.skipif(
    not INSTALLED, reason="OGBench, which requirements.txt leaves out, is not installed"
)
STEPS = 20
SOLVED = [3, 4, 10, STEPS - 1, STEPS, 2 * STEPS]  # rows, of STEPS + 1 a trajectory
SETS = {  # by the dataset: the environment's id, and what the printed command names
    "antmaze-medium-navigate-singletask-v0": (
        "antmaze-medium-singletask-v0",
        "eras:antmaze-medium-singletask-before-3.5-v0",
    ),
    "antmaze-large-stitch-singletask-task3-v0": (
        "antmaze-large-singletask-task3-v0",
        "eras:antmaze-large-singletask-task3-before-3.5-v0",
    ),
    "pointmaze-medium-navigate-singletask-task2-v0": (
        "pointmaze-medium-singletask-task2-v0",
        "ogbench:pointmaze-medium-singletask-task2-v0",
    ),
    "cube-single-play-singletask-v0": (
        "cube-single-singletask-v0",
        "ogbench:cube-single-singletask-v0",
    ),
}


def record(path, env_id):
    """Three trajectories of random actions, in OGBench's layout."""
    env = gym.make(f"ogbench:{env_id}").unwrapped
    rng = np.random.default_rng(0)
    rows = []
    for k in range(3):
        state, _ = env.reset(seed=k)
        for t in range(STEPS + 1):
            action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            next_state, *_, info = env.step(action)
            rows.append(
                (state, action, t == STEPS, info["prev_qpos"], info["prev_qvel"])
            )
            state = next_state
    names = ("observations", "actions", "terminals", "qpos", "qvel")
    columns = dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))
    columns["observations"] = columns["observations"].astype(np.float32)
    if "maze" in env_id:
        columns["qpos"][SOLVED, :2] = env.cur_goal_xy
    else:
        columns["qpos"][SOLVED, 14:17] = env.unwrapped._data.mocap_pos[0]
    np.savez(path, **columns)
    np.savez(str(path).replace(".npz", "-val.npz"), **columns)  # OGBench reads both


def refusal_of(*args, **options):
    with pytest.raises(SystemExit) as stop:
        from_ogbench.main(from_ogbench.Args(*args, **options))
    sentence = str(stop.value)
    assert sentence and "\n" not in sentence
    return sentence


@pytest.fixture(scope="module", params=SETS)
def made(request, tmp_path_factory):
    """Name of a dataset, its .npz file, and the file that from_ogbench.py wrote."""
    folder = tmp_path_factory.mktemp("ogbench")
    path, out = folder / "data.npz", folder / "data.hdf5"
    record(path, SETS[request.param][0])
    from_ogbench.main(from_ogbench.Args(request.param, out, path))
    return request.param, path, out


@needs_ogbench
def test_the_transitions_are_ogbenchs(made):
    import ogbench

    name, path, out = made
    env, theirs, _ = ogbench.make_env_and_datasets(name, dataset_path=str(path))
    assert env.spec.id == SETS[name][0]
    widths = env.observation_space.shape[0], env.action_space.shape[0]
    args = wpc.Args(discount=0.9)
    ours, mean, std, best_return = wpc.prepare_dataset(
        wpc.read_dataset(out, *widths, 1.0), args
    )
    for key in ("observations", "next_observations"):
        restored = (ours[key] * std + mean).numpy()
        assert restored == pytest.approx(theirs[key], abs=1e-4)
    assert np.array_equal(ours["actions"], theirs["actions"])
    assert np.array_equal(ours["rewards"].ravel(), theirs["rewards"])
    assert np.array_equal(ours["terminals"].ravel(), 1 - theirs["masks"])
    assert ours["terminals"].sum() == 5  # one of SOLVED has no transition
    assert best_return == 0

    # An episode begins after each end, so no return-to-go crosses one.
    with h5py.File(out) as file:
        ends = np.flatnonzero(file["terminals"][:] | file["timeouts"][:])
    trajectory_ends = [STEPS, 2 * STEPS + 1, 3 * STEPS + 2]
    assert ends.tolist() == sorted({*SOLVED, *trajectory_ends})


@needs_ogbench
def test_rows_say_where_they_are_from(made):
    _, path, out = made
    raw = np.load(path)
    with h5py.File(out) as file:
        assert np.array_equal(file["timeouts"], raw["terminals"])
        assert np.array_equal(file["infos/qpos"], raw["qpos"])
        assert np.array_equal(file["infos/qvel"], raw["qvel"])
        ends = file["timeouts"][:]
        assert np.array_equal(
            file["next_observations"][ends], raw["observations"][ends]
        )
        assert not file["terminals"][ends].any()
        assert file["rewards"][ends].tolist() == [0, -1, -1]  # one is solved there


@needs_ogbench
@pytest.mark.parametrize("name", list(SETS)[::2])
def test_the_printed_command_trains(tmp_path, name):
    env_id, env = SETS[name]
    record(tmp_path / "data.npz", env_id)
    line = [sys.executable, "tests/tools/from_ogbench.py", name, "--out"]
    line += [tmp_path / "my data.hdf5", "--dataset-path", tmp_path / "data.npz"]
    printed = run(*line, cwd=ROOT).stdout
    assert "60 transitions in 3 trajectories; in 5 the task is solved" in printed
    command = printed.splitlines()[-1].removeprefix("to train: ")
    assert f" --env {env} " in command
    command += (
        f" --max-timesteps 2 --eval-freq 2 --eval-episodes 1 --run-dir {tmp_path}/r"
    )
    training = run("bash", "-c", command, cwd=ROOT)
    assert training.returncode == 0, training.stderr
    assert len(read_rows(tmp_path / "r")) == 2


@needs_ogbench
def test_what_no_switch_brings_back_is_said(tmp_path, capsys):
    name = "cube-single-play-singletask-v0"
    record(tmp_path / "data.npz", SETS[name][0])
    out = tmp_path / "data.hdf5"
    from_ogbench.main(from_ogbench.Args(name, out, tmp_path / "data.npz"))
    *_, sentence, command = capsys.readouterr().out.splitlines()
    assert "mujoco==3.1.6" in sentence and " --env ogbench:cube-single-s" in command


@needs_ogbench
def test_files_that_can_not_be_used(tmp_path):
    name, out = "antmaze-medium-navigate-singletask-v0", tmp_path / "data.hdf5"
    path = tmp_path / "data.npz"
    assert "(FileNotFoundError: " in refusal_of(name, out, path)
    path.write_text("<html>")
    assert "can't be had from OGBench's files (" in refusal_of(name, out, path)
    record(path, SETS[name][0])
    arrays = dict(np.load(path))
    del arrays["qpos"]
    np.savez(path, **arrays)
    assert "(KeyError: 'qpos')" in refusal_of(name, out, path)
    sentence = refusal_of("antmaze-small-navigate-singletask-v0", out, path)
    assert "antmaze-small-navigate-singletask-v0 can't be had" in sentence
    assert not out.exists()


@needs_ogbench
def test_a_dataset_is_downloaded(tmp_path, monkeypatch):
    name = "antmaze-medium-navigate-singletask-v0"
    monkeypatch.setenv("HOME", str(tmp_path))
    asked = []

    def download(names):
        asked.extend(names)
        (tmp_path / ".ogbench/data").mkdir(parents=True)
        record(tmp_path / ".ogbench/data" / f"{names[0]}.npz", SETS[name][0])

    monkeypatch.setattr("ogbench.utils.download_datasets", download)
    from_ogbench.main(from_ogbench.Args(name, tmp_path / "data.hdf5"))
    assert asked == ["antmaze-medium-navigate-v0"]
    assert (tmp_path / "data.hdf5").exists()


@pytest.mark.parametrize(
    "name, sentence",
    {
        "visual-antmaze-medium-navigate-singletask-v0": "has pictures",
        "visual-cube-single-play-v0": "has pictures",
        "powderworld-easy-play-v0": "has pictures or discrete actions",
        "antmaze-medium-navigate-v0": "is no single-task dataset of OGBench",
        "antmaze-medium-navigate-oraclerep-v0": "so it has no rewards",
        "hopper-medium-v2": "name one such as antmaze-large-navigate-singletask-v0",
    }.items(),
)
def test_sets_that_the_scripts_can_not_use(tmp_path, name, sentence):
    assert sentence in refusal_of(name, tmp_path / "data.hdf5")
    assert not list(tmp_path.iterdir())


def test_without_ogbench(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    sentence = refusal_of("cube-single-play-singletask-v0", tmp_path / "data.hdf5")
    assert f"pip install ogbench==1.2.2 mujoco=={mujoco.__version__} (" in sentence
