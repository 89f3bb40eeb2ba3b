# SPDX-License-Identifier: MIT
"""Environments as MuJoCo's earlier releases moved them: by hand, and against files that
were recorded with MuJoCo 3.2.3."""

import importlib.util
import sys

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from conftest import ROOT, run, wpc
from packaging.version import Version

sys.path.insert(0, str(ROOT / "tests/tools"))
import check_physics
import eras

DATA = ROOT / "tests/data/eras"
PEN = ROOT.parent / "shared/adroit/pen_expert.npz"


def needs(package):
    return pytest.mark.skipif(
        not importlib.util.find_spec(package), reason=f"{package} isn't installed"
    )


def make(env_id):
    """The environment that the scripts evaluate on."""
    return wpc.make_envs(env_id, 1).envs[0]


# Names


def registered(package):
    """The names of this package's environments of old, without eras."""
    specs = gym.registry.values()
    return {x.id for x in specs if "-before-" in x.id and package in x.entry_point}


def test_gymnasiums_robots_that_moved_are_registered():
    robots = ("Hopper", "Ant", "Humanoid", "HumanoidStandup")
    names = {f"{x}-before-3.5-v{n}" for x in robots for n in (4, 5)}
    assert registered("gymnasium.envs") == names | {"Pusher-before-3.5-v5"}


@needs("gymnasium_robotics")
def test_the_hand_and_the_mazes_are_registered():
    names = registered("gymnasium_robotics")
    hammer = {x for x in names if x.startswith("AdroitHandHammer-")}
    door = {x for x in names if x.startswith("AdroitHandDoorSparse-")}
    assert hammer == {f"AdroitHandHammer-before-{x}-v1" for x in ("3.3", "3.5", "3.8")}
    assert door == {f"AdroitHandDoorSparse-before-{x}-v1" for x in ("3.3", "3.5")}
    assert {"AntMaze_UMaze-before-3.5-v5", "PointMaze_Large-before-3.5-v3"} < names
    assert not any(x.startswith(("Fetch", "Franka", "HandReach")) for x in names)


@needs("ogbench")
def test_ogbenchs_ants_are_registered():
    names = registered("ogbench")
    assert "antmaze-large-singletask-task1-before-3.5-v0" in names
    assert "antsoccer-arena-before-3.5-v0" in names
    assert all(x.startswith("ant") for x in names)


def test_they_are_the_installed_ones_but_for_the_switches():
    for spec in list(gym.registry.values()):
        name, _, rest = spec.id.partition("-before-")
        if rest:
            stock = gym.spec(f"{name}-{rest.split('-')[-1]}")
            for key in ("entry_point", "max_episode_steps", "kwargs"):
                assert getattr(spec, key) == getattr(stock, key)
    env, stock = make("eras:Hopper-before-3.5-v5"), make("Hopper-v5")
    assert np.array_equal(env.reset(seed=3)[0], stock.reset(seed=3)[0])
    assert env.spec.max_episode_steps == 1000 and env.spec.kwargs == stock.spec.kwargs


OF_DATA = (  # environment, MuJoCo of the data, what to evaluate on with MuJoCo 3.15.0
    ("Hopper-v5", "2.3.3", "eras:Hopper-before-3.5-v5"),
    ("Hopper-v4", "3.4.0", "eras:Hopper-before-3.5-v4"),
    ("Hopper-v5", "3.5.0", "Hopper-v5"),
    ("Hopper-v5", "3.17", "Hopper-v5"),
    ("Ant-v5", Version("3.2.3"), "eras:Ant-before-3.5-v5"),
    ("Walker2d-v5", "2.3.3", "Walker2d-v5"),
    ("Pusher-v5", "3.2.3", "eras:Pusher-before-3.5-v5"),
    ("gymnasium_robotics:AdroitHandPen-v1", "3.2", "eras:AdroitHandPen-before-3.3-v1"),
    ("AdroitHandPen-v1", "3.4", "eras:AdroitHandPen-before-3.5-v1"),
    ("AdroitHandPen-v1", "3.7.0", "eras:AdroitHandPen-before-3.8-v1"),
    ("AdroitHandDoor-v1", "3.7.0", "AdroitHandDoor-v1"),
    ("AntMaze_UMaze-v5", "3.1", "eras:AntMaze_UMaze-before-3.5-v5"),
    ("ogbench:antmaze-large-v0", "3.2", "eras:antmaze-large-before-3.5-v0"),
    ("ogbench:pointmaze-large-v0", "3.2", "ogbench:pointmaze-large-v0"),
    ("FetchPush-v4", "3.7.0", "FetchPush-v4"),
    ("Pendulum-v1", "3.15.0", "Pendulum-v1"),
)
NOT_HERE = (
    ("FetchPush-v4", "3.6"),
    ("FrankaKitchen-v1", "3.4.0"),
    ("ogbench:cube-single-v0", "3.2.3"),
    ("scene-singletask-v0", "3.6.0"),
    ("puzzle-3x3-v0", "3.2.3"),
    ("PointMaze_UMaze-v3", "2.3.7"),
    ("HumanoidStandup-v5", "2.3.3"),
    ("Ant-v5", "4.0.0"),
    ("Hopper-v2", "2.1.0"),
)


def test_the_environment_of_data(monkeypatch):
    monkeypatch.setattr(eras, "INSTALLED", Version("3.15.0"))
    for env_id, version, expected in OF_DATA:
        assert eras.era_of(env_id, version) == expected
    for env_id, version in NOT_HERE:
        sentence = rf"no switch undoes that: .* with mujoco=={version}$"
        with pytest.raises(eras.NotHere, match=sentence):
            eras.era_of(env_id, version)
    sentence = "we don't know whether Mine-v0 moves .* 3.15.0 as on 3.2.3"
    with pytest.raises(eras.NotHere, match=sentence):
        eras.era_of("mine:Mine-v0", "3.2.3")


def test_the_environment_of_data_on_other_releases(monkeypatch):
    def install(version):
        monkeypatch.setattr(eras, "INSTALLED", Version(version))

    install("3.3.0")
    with pytest.raises(eras.NotHere, match="no switch"):
        eras.era_of("cube-single-v0", "3.2.3")
    install("3.4.0")
    for env_id in ("Hopper-v5", "FetchPush-v4"):
        assert eras.era_of(env_id, "3.2.3") == env_id
    with pytest.raises(eras.NotHere, match="no switch"):
        eras.era_of("FrankaKitchen-v1", "3.3.0")
    with pytest.raises(eras.NotHere, match=r"which is newer: .* mujoco==3.15.0$"):
        eras.era_of("Hopper-v5", "3.15.0")
    install("3.5.0")
    assert eras.era_of("Hopper-v5", "3.4.0") == "eras:Hopper-before-3.5-v5"
    install("4.0.0")
    with pytest.raises(eras.NotHere, match="no switch"):
        eras.era_of("AntMaze_UMaze-v5", "3.2.3")
    assert eras.era_of("Hopper-v5", "3.17.0") == "Hopper-v5"


# Switches


def switches(env, stock):
    """Which collisions are switched off, and what the margins were divided by."""
    off = mujoco.mjtDisableBit
    flags = env.model.opt.disableflags
    ours = [bool(flags & x) for x in (off.mjDSBL_NATIVECCD, off.mjDSBL_MULTICCD)]
    divisor = np.unique(stock.model.geom_margin / env.model.geom_margin)
    return *ours, *divisor


@pytest.mark.parametrize(
    ("installed", "before", "expected"),
    [
        ("3.15.0", "3.3", (True, True, 2)),
        ("3.15.0", "3.5", (False, True, 2)),
        ("3.15.0", "3.8", (False, True, 1)),
        ("3.7.0", "3.3", (True, False, 2)),
        ("3.5.0", "3.5", (False, False, 2)),
        ("3.4.0", "3.3", (True, False, 1)),
        ("3.4.0", "3.5", (False, False, 1)),
        ("3.2.3", "3.3", (False, False, 1)),
    ],
)
def test_switches_are_set_where_mujoco_needs_them(
    monkeypatch, installed, before, expected
):
    monkeypatch.setattr(eras, "INSTALLED", Version(installed))
    env, stock = make("Hopper-v5").unwrapped, make("Hopper-v5").unwrapped
    assert eras.use_era(env, before) is env
    assert switches(env, stock) == expected


@needs("gymnasium_robotics")
def test_the_model_that_steps_is_switched_in_the_mazes():
    for name, inner in (("AntMaze_UMaze", "ant_env"), ("PointMaze_UMaze", "point_env")):
        version = "v5" if name.startswith("Ant") else "v3"
        env, stock = (
            getattr(gym.make(x).unwrapped, inner)
            for x in (f"{name}-before-3.5-{version}", f"{name}-{version}")
        )
        ball = stock.model.geom_margin > 0
        halves = env.model.geom_margin[ball] * 2 == stock.model.geom_margin[ball]
        assert ball.any() and halves.all()


@needs("ogbench")
def test_the_model_that_steps_is_switched_in_ogbenchs_mazes():
    env = make("eras:antmaze-medium-singletask-before-3.5-v0")
    env.reset(seed=0)
    assert env.unwrapped.model.geom_margin.max() == 0.01 / 2


# Against recorded data


def errors(env, name):
    """The largest error of each row's next state, of a file in tests/data/eras."""
    path = DATA / f"{name}_3.2.3.hdf5"
    rows, _ = check_physics.read_rows(check_physics.read_columns(path), env, 1000)
    next_errors, *_ = check_physics.repeat(env, *rows)
    return next_errors[np.isfinite(next_errors)]


def test_hopper_in_contact():
    ours = errors(make("eras:Hopper-before-3.5-v5"), "Hopper-v5")
    stock = errors(make("Hopper-v5"), "Hopper-v5")
    assert ours.max() < 1e-9 and len(ours) > 250
    in_contact = stock > 1e-3
    assert in_contact.mean() > 0.5 and stock[~in_contact].max() < 1e-9


def test_ant():
    """Recorded in float32, which is where its errors are from."""
    ours = errors(make("eras:Ant-before-3.5-v5"), "Ant-v5")
    stock = errors(make("Ant-v5"), "Ant-v5")
    assert ours.max() < 1e-5 and len(ours) > 150 and np.median(stock) > 0.01


@needs("gymnasium_robotics")
def test_the_hand_needs_all_three_switches():
    pen = "AdroitHandPen-v1"
    ours = errors(make("eras:AdroitHandPen-before-3.3-v1"), pen)
    assert ours.max() < 1e-4 and len(ours) > 50
    off = mujoco.mjtDisableBit
    for flag in (off.mjDSBL_NATIVECCD, off.mjDSBL_MULTICCD, None):
        env = make("eras:AdroitHandPen-before-3.3-v1")
        if flag is None:
            env.unwrapped.model.geom_margin *= 2
        else:
            env.unwrapped.model.opt.disableflags &= ~int(flag)
        assert errors(env, pen).max() > 0.01
    assert errors(make("eras:AdroitHandPen-v1"), pen).max() > 0.01


def expert(path):
    """The published policy, a function of observations."""
    arrays = np.load(path)
    shift, scale = arrays["in_shift"], arrays["in_scale"] + 1e-8
    layers = [
        (arrays[f"fc_layers.{i}.weight"], arrays[f"fc_layers.{i}.bias"])
        for i in range(3)
    ]

    def act(observation):
        x = (observation - shift) / scale
        for i, (weight, bias) in enumerate(layers):
            x = weight @ x + bias
            x = np.tanh(x) if i < 2 else x
        return np.clip(x * arrays["out_scale"] + arrays["out_shift"], -1, 1)

    return act


@needs("gymnasium_robotics")
@pytest.mark.skipif(not PEN.exists(), reason=f"the expert isn't in {PEN.parent}")
def test_the_return_of_the_pens_expert():
    """On MuJoCo 3.2.3 it is 3480, and on stock 3.15.0 it was 2854."""
    act = expert(PEN)
    for env_id, expected in (
        ("eras:AdroitHandPen-before-3.3-v1", 3480),
        ("eras:AdroitHandPen-v1", 2854),
    ):
        env, total = make(env_id), 0.0
        for seed in range(20):
            observation, _ = env.reset(seed=seed)
            for _ in range(100):
                observation, reward, *_ = env.step(act(observation))
                total += reward
        assert total / 20 == pytest.approx(expected, abs=1)


# Scripts and tools


def test_scripts_and_tools_find_them_from_another_folder(tmp_path, monkeypatch):
    env, path = "eras:Hopper-before-3.5-v5", tmp_path / "hopper.hdf5"
    tools = ROOT / "tests/tools"
    line = [sys.executable, tools / "make_dataset.py", "--env", env, "--random"]
    process = run(*line, "--steps", 60, "--out", path, cwd=tmp_path)
    assert process.returncode == 0 and f"--env {env}" in process.stdout, process.stderr
    line = [sys.executable, ROOT / "wpc.py", "--env", env, "--dataset", path]
    line += ["--max-timesteps", 2, "--eval-episodes", 2, "--run-dir", "run"]
    monkeypatch.setenv("PYTHONPATH", str(tools))
    process = run(*line, cwd=tmp_path)
    assert process.returncode == 0 and "step 2: mean_return" in process.stdout
    monkeypatch.delenv("PYTHONPATH")
    line = [sys.executable, tools / "play.py", "run", "--out", "film.gif", "--size", 60]
    process = run(*line, cwd=tmp_path)
    if "needs EGL" in process.stderr:
        pytest.skip("EGL does not work here, so that nothing was filmed")
    assert process.returncode == 0 and (tmp_path / "film.gif").exists()
