# SPDX-License-Identifier: MIT
"""D4RL's physics: by hand, and against the transitions that D4RL recorded; and which
MuJoCo check_physics.py finds a file to be of."""

import re
import sys
import types
import zipfile
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from conftest import ROOT, wpc, write_hdf5
from packaging.version import Version

sys.path.insert(0, str(ROOT / "tests/tools"))
sys.path.insert(0, str(ROOT / "tests/data/eras"))
import check_physics
import eras
import make
import make_dataset
import play_zoo

DATA = ROOT / "tests/data/eras"
EPISODES = ROOT.parent / "shared/d4rl/episodes"

robots = pytest.mark.parametrize("robot", wpc.D4RL_ROBOTS)
gym_robots = [
    x
    for x, spec in gym.registry.items()
    if str(spec.entry_point).startswith("gymnasium.envs.mujoco")
    and x.endswith(("-v4", "-v5"))
    and "-before-" not in x
    and x != "Pusher-v4"  # which can't be made
]
needs_episodes = pytest.mark.skipif(
    not EPISODES.exists(), reason=f"D4RL's recorded transitions aren't in {EPISODES}"
)


def recorded(robot):
    """The first two episodes of D4RL's medium-v2 file, with qpos and qvel before each
    action."""
    return dict(np.load(EPISODES / f"{robot}_medium-v2.npz"))


# By hand


def cylinder(radius, half_length, density=1000):
    """Mass and inertia tensor of the cylinder that MuJoCo 2.0 took for a capsule along
    z: longer by half a radius at each end."""
    length = 2 * half_length + radius
    mass = density * np.pi * radius**2 * length
    across = mass * (3 * radius**2 + length**2) / 12
    return mass, np.diag([across, across, mass * radius**2 / 2])


def rotation(quaternion):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def by_hand(model, body):
    """Mass, center of mass and inertia tensor about it, of a body of the stock model
    whose capsules weigh as in MuJoCo 2.0."""
    parts = []
    for i in range(model.ngeom):
        if model.geom_bodyid[i] == body:
            assert model.geom_type[i] == mujoco.mjtGeom.mjGEOM_CAPSULE
            mass, inertia = cylinder(*model.geom_size[i, :2])
            turn = rotation(model.geom_quat[i])
            parts.append((mass, turn @ inertia @ turn.T, model.geom_pos[i]))
    total = sum(mass for mass, _, _ in parts)
    center = sum(mass * position for mass, _, position in parts) / total
    tensor = np.zeros((3, 3))
    for mass, inertia, position in parts:  # by the parallel axis theorem
        d = position - center
        tensor += inertia + mass * (d @ d * np.eye(3) - np.outer(d, d))
    return total, center, tensor


@robots
def test_masses_and_inertias_by_hand(script, robot):
    env_id, *_ = script.D4RL_ROBOTS[robot]
    stock = script.make_envs(env_id, 1).envs[0].unwrapped.model
    model = script.make_envs(robot, 1).envs[0].unwrapped.model
    bodies = [by_hand(stock, body) for body in range(1, stock.nbody)]  # not the world
    scale = 1.0
    if robot == "halfcheetah":  # whose model sets the total mass
        scale = 14 / sum(mass for mass, _, _ in bodies)
        assert model.body_mass.sum() == pytest.approx(14)
    for body, (mass, center, tensor) in enumerate(bodies, start=1):
        assert model.body_mass[body] == pytest.approx(scale * mass)
        assert model.body_ipos[body] == pytest.approx(center, abs=1e-9)
        turn = rotation(model.body_iquat[body])
        ours = turn @ np.diag(model.body_inertia[body]) @ turn.T
        assert ours == pytest.approx(scale * tensor, rel=1e-6, abs=1e-9)
    # what derives from the masses is computed again
    assert model.body_subtreemass[0] == pytest.approx(model.body_mass.sum())
    assert not np.allclose(model.dof_invweight0, stock.dof_invweight0, rtol=1e-3)


def test_a_capsule_that_is_given_by_its_ends(script, tmp_path):
    """As HalfCheetah's torso is, but neither centred nor along an axis."""
    (tmp_path / "model.xml").write_text("""<mujoco><worldbody><body><freejoint/>
        <geom name="arm" type="capsule" fromto="0 0.1 0 0.3 0.2 0.6" size="0.05"/>
        <geom name="leg" type="capsule" pos="0 0 -0.3" size="0.04 0.2"/>
        </body></worldbody></mujoco>""")
    stock, model = (
        mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml")) for _ in range(2)
    )
    env = types.SimpleNamespace(model=model, data=mujoco.MjData(model))
    env.fullpath, env.unwrapped = str(tmp_path / "model.xml"), env
    script.use_d4rl_physics(env)
    mass, center, tensor = by_hand(stock, 1)
    assert model.body_mass[1] == pytest.approx(mass)
    assert model.body_ipos[1] == pytest.approx(center)
    turn = rotation(model.body_iquat[1])
    ours = turn @ np.diag(model.body_inertia[1]) @ turn.T
    assert ours == pytest.approx(tensor, rel=1e-6, abs=1e-9)


@robots
def test_margins_are_halved_and_collisions_keep_the_capsules(robot):
    stock = wpc.make_envs(wpc.D4RL_ROBOTS[robot][0], 1).envs[0].unwrapped.model
    model = wpc.make_envs(robot, 1).envs[0].unwrapped.model
    assert np.array_equal(model.geom_margin, stock.geom_margin / 2)
    assert (stock.geom_margin.max() > 0) == (robot == "hopper")
    for name in ("geom_type", "geom_size", "geom_pos", "geom_quat"):
        assert np.array_equal(getattr(model, name), getattr(stock, name))


@pytest.mark.parametrize(("version", "divisor"), [(340, 1), (3005000, 2), (3015000, 2)])
def test_margins_are_halved_where_mujoco_adds_them(
    script, version, divisor, monkeypatch
):
    """`mj_version` of MuJoCo 3.4.0 is 340, that of 3.15.0 is 3015000."""
    env = script.make_envs("Hopper-v4", 1).envs[0]
    stock = env.unwrapped.model.geom_margin.copy()
    monkeypatch.setattr(mujoco, "mj_version", lambda: version)
    script.use_d4rl_physics(env)
    assert np.array_equal(env.unwrapped.model.geom_margin, stock / divisor)


# Against D4RL


def repeat(env, d4rl):
    """The largest errors of next observation and reward, and the number of rows whose
    termination differs, with every row's recorded qpos and qvel set."""
    states, rewards, differ = [], [], 0
    for i, action in enumerate(d4rl["actions"]):
        env.unwrapped.set_state(d4rl["qpos"][i], d4rl["qvel"][i])
        state, reward, terminated, _, _ = env.unwrapped.step(action)
        states.append(state)
        rewards.append(reward)
        differ += terminated != d4rl["terminals"][i]
    state_errors = np.abs(np.array(states) - d4rl["next_observations"])
    return state_errors.max(), np.abs(rewards - d4rl["rewards"]).max(), differ


@needs_episodes
@robots
def test_recorded_transitions(script, robot):
    """They are repeated in D4RL's physics, and are not in the stock environment."""
    d4rl = recorded(robot)
    state_error, reward_error, differ = repeat(script.make_envs(robot, 1).envs[0], d4rl)
    assert state_error < 1e-4 and reward_error < 2e-6 and differ == 0
    env_id, *_ = script.D4RL_ROBOTS[robot]
    state_error, reward_error, _ = repeat(script.make_envs(env_id, 1).envs[0], d4rl)
    assert state_error > 0.1 and reward_error > 0.01


# The tools

D4RL = "D4RL's, MuJoCo 2.0"
STOCK = f"mujoco=={mujoco.__version__}"
ERAS = ["mujoco>=2.1.2,<3.3", "mujoco>=3.3,<3.5", "mujoco>=3.5,<3.8"]


def check(capsys, path, **options):
    """What the tool prints: (rows compared, passed over), the numbers of each row of
    the table, {name: list}, and the sentence on the file."""
    check_physics.main(check_physics.Args(path, **options))
    text = capsys.readouterr().out
    counts = [int(x) for x in re.findall(r"(\d+) rows compared, (\d+)", text)[0]]
    rows = [line.split("|")[1:-1] for line in text.splitlines() if "|" in line]
    number = r"[\d.]+(?:e[-+]\d+)?"
    table = {
        name.strip(): [float(x) for x in re.findall(number, " ".join(cells))]
        for name, *cells in rows[2:]
    }
    return counts, table, text.splitlines()[-1]


def refusal(function, *arguments):
    with pytest.raises((SystemExit, wpc.UserError)) as stop:
        function(*arguments)
    return str(stop.value)


def own(robot, steps):
    """Random episodes of at most so many steps in the form of a file, {name: array}."""
    env = wpc.make_envs(robot, 1).envs[0]
    data = make_dataset.make_columns(steps, env)
    args = make_dataset.Args(robot, steps, Path("unused"))
    list(make_dataset.collect(args, env, data))
    *_, end = np.flatnonzero(data["terminals"] | data["timeouts"])
    return {name: column[: end + 1] for name, column in data.items()}


def test_check_physics_on_transitions_of_our_own(tmp_path, capsys):
    """In D4RL's physics, one of them as if D4RL had clipped it, one wrong."""
    data = own("hopper", 100)
    data["observations"][0, 8] = 10
    data["timeouts"] = data["terminals"]  # such rows stay
    rows = len(data["rewards"])
    for key in ("", "next_observations"):
        data.pop(key, None)
        path = write_hdf5(tmp_path / "hopper.hdf5", data)
        counts, table, sentence = check(capsys, path)
        assert counts == [rows - 1, 1] and list(table) == [D4RL, *ERAS, STOCK]
        ours, stock = table[D4RL], table[STOCK]
        assert ours[1] < 1e-4 and ours[3] < 1e-4 and ours[4] == 0 and stock[1] > 0.01
        assert sentence == (
            f"The file is of {D4RL} (100% of the next states are right): --env hopper"
        )
    data["rewards"][3] += 0.25
    data["terminals"][1] ^= True
    _, table, _ = check(capsys, write_hdf5(path, data))
    ours = table[D4RL]
    assert ours[3] == pytest.approx(0.25, abs=0.01) and ours[4] == 1


@needs_episodes
@robots
def test_check_physics_on_a_file(tmp_path, capsys, robot):
    """Of the recorded episodes, with their next observations and without."""
    arrays = recorded(robot)
    timeouts = (arrays["timeouts"] & ~arrays["terminals"]).sum()
    with_next = write_hdf5(tmp_path / "named_otherwise.hdf5", arrays)
    arrays.pop("next_observations")
    without = write_hdf5(tmp_path / f"{robot}_medium-v2.hdf5", arrays)
    for path, options in ((with_next, {"env": robot}), (without, {})):
        (rows, passed_over), table, sentence = check(capsys, path, **options)
        assert rows + passed_over == len(arrays["rewards"])
        clipped = {"hopper": 150, "walker2d": 581}.get(robot, 0)
        assert clipped <= passed_over <= clipped + timeouts
        ours, stock = table[D4RL], table[STOCK]
        assert ours[0] <= ours[1] < 1e-4 and ours[2] <= ours[3] < 2e-6 and ours[4] == 0
        assert stock[1] > 0.1 and stock[3] > 0.01
        assert f"is of {D4RL} (" in sentence and sentence.endswith(f"--env {robot}")
    # What follows the last row isn't known, if its episode goes on.
    write_hdf5(without, {key: x[:400] for key, x in arrays.items()})
    _, table, _ = check(capsys, without)
    assert table[D4RL][1] < 1e-4


@needs_episodes
def test_check_physics_with_qpos_and_qvel(tmp_path, capsys):
    """Where these are in the file, no velocity is clipped. D4RL's first x of an episode
    doesn't fit its second, which is one row in a thousand here."""
    arrays = recorded("walker2d")
    arrays |= {f"infos/{name}": arrays.pop(name) for name in ("qpos", "qvel")}
    timeouts = (arrays["timeouts"] & ~arrays["terminals"]).sum()
    path = write_hdf5(tmp_path / "walker2d.hdf5", arrays)
    counts, table, sentence = check(capsys, path)
    assert counts == [len(arrays["rewards"]) - timeouts, timeouts]
    assert table[D4RL][0] < 1e-6 and table[STOCK][0] > 0.1
    assert f"is of {D4RL} (99.9% of" in sentence


@needs_episodes
def test_check_physics_finds_what_differs(tmp_path, capsys):
    """One wrong number of each kind, and rows taken from the whole file."""
    arrays = recorded("hopper")
    seen = np.flatnonzero((np.abs(arrays["observations"]) < 10).all(axis=1))
    arrays["next_observations"][seen[7], 3] += 0.5
    arrays["rewards"][seen[8]] -= 0.25
    arrays["terminals"][seen[-1]] ^= True
    path = write_hdf5(tmp_path / "hopper.hdf5", arrays)
    _, table, sentence = check(capsys, path)
    ours = table[D4RL]
    assert ours[0] < 1e-6 and ours[1] == pytest.approx(0.5, abs=0.01)
    assert ours[2] < 1e-6 and ours[3] == pytest.approx(0.25, abs=0.01) and ours[4] == 1
    assert f"is of {D4RL} (99.87% of" in sentence  # all but one of 761
    assert seen[-1] == len(arrays["rewards"]) - 1
    counts, table, _ = check(capsys, path, rows=2)  # the first and the last
    assert counts == [2, 0] and table[D4RL][4] == 1
    arrays["next_observations"][seen[:9], 3] += 0.5  # more than one in a hundred
    _, _, sentence = check(capsys, write_hdf5(path, arrays))
    assert "is of none of these, or its states are more than qpos and qvel" in sentence
    assert f": in {D4RL}, the nearest, 98.8" in sentence


@pytest.mark.parametrize("env_id", ["Hopper-v5", "Ant-v5"])
def test_check_physics_on_files_of_other_releases(capsys, tmp_path, env_id):
    """Of MuJoCo 3.2.3, and of the installed one, recorded in the same way."""
    _, table, sentence = check(capsys, DATA / f"{env_id}_3.2.3.hdf5", env=env_id)
    old = eras.era_of(env_id, "3.2.3")
    assert table[ERAS[0]][1] < 1e-5 and table[STOCK][1] > 0.1
    assert table[ERAS[0]][2] < 1e-3  # Ant's reward is of a substep before, so not 1e-6
    assert f"is of {ERAS[0]} or {ERAS[1]}, which are alike here (100% of" in sentence
    assert sentence.endswith(f": --env {old}")
    columns = make.record(env_id, 150, "f4", True)
    path = write_hdf5(tmp_path / "new.hdf5", columns)
    for name in (env_id, old):  # the file's environment is named either way
        _, table, sentence = check(capsys, path, env=name)
        assert table[STOCK][1] < 1e-4 and table[ERAS[0]][1] > 0.05
        assert f"is of {ERAS[2]} or {STOCK}, which are alike" in sentence
        assert sentence.endswith(f"--env {env_id}")
    assert check_physics.which_physics(columns, env_id)[0] == env_id


def test_a_robot_that_no_release_moved():
    env_id, sentence = check_physics.which_physics(
        own("Walker2d-v5", 60), "Walker2d-v5"
    )
    alike = " or ".join([*ERAS, STOCK])
    assert env_id == "Walker2d-v5" and f"is of {alike}, which are alike" in sentence


def test_rows_that_are_alike_in_all():
    """No need then for another name: the pusher's arm hasn't met the object yet."""
    columns = make.record("Pusher-v5", 10, "f8", True)
    env_id, sentence = check_physics.which_physics(columns, "Pusher-v5")
    assert env_id == "Pusher-v5" and "which are alike here (100% of" in sentence
    assert sentence.endswith(": --env Pusher-v5")


def test_releases_after_the_installed_one_are_not_tried(monkeypatch):
    monkeypatch.setattr(eras, "INSTALLED", Version("3.4.0"))
    physics, _ = check_physics.try_physics(own("Ant-v5", 1000), "Ant-v5", 10)
    assert [name for name, *_ in physics] == [ERAS[0], "mujoco==3.4.0"]


def test_environments_of_a_users_own(monkeypatch):
    """They have no name of old, but the switches can be set."""
    spec = gym.spec("Ant-v5")
    gym.register("Own-v0", spec.entry_point, max_episode_steps=50)
    columns = check_physics.read_columns(DATA / "Ant-v5_3.2.3.hdf5")
    env_id, sentence = check_physics.which_physics(columns, "Own-v0")
    assert env_id is None and sentence.endswith("register it with eras.use_era")
    monkeypatch.delitem(gym.registry, "Own-v0")


@pytest.mark.parametrize("env_id", gym_robots)
def test_whose_states_can_be_set(env_id):
    size = {"Ant": 27, "HalfCheetah": 17, "Hopper": 11, "Humanoid": 45}
    size |= {"HumanoidStandup": 45, "Swimmer": 8, "InvertedPendulum": 4, "Walker2d": 17}
    env, robot = wpc.make_envs(env_id, 1).envs[0], env_id.split("-")[0]
    if robot in size:
        assert check_physics.state_size(env) == size[robot]
    else:
        sentence = f"{env_id}'s states can't be set: .* no infos/qpos and infos/qvel"
        assert re.search(sentence, refusal(check_physics.state_size, env))


def test_what_check_physics_refuses(tmp_path, capsys):
    def refused(path, **options):
        return refusal(check_physics.main, check_physics.Args(path, **options))

    path, arrays = tmp_path / "hopper.hdf5", {"observations": np.zeros((3, 5))}
    arrays |= dict.fromkeys(("actions", "rewards", "terminals"), np.zeros(3))
    write_hdf5(path, arrays)
    assert re.search(r"hopper.hdf5: .*timeouts", refused(path))
    arrays["timeouts"] = np.zeros(3)
    write_hdf5(path, arrays)
    assert "has observations (3, 5): it isn't hopper's" in refused(path)
    assert "Pendulum-v1 is none of MuJoCo's" in refused(path, env="Pendulum-v1")
    assert "No such file" in refused(tmp_path / "hopper_none.hdf5")
    assert "as in --env Ant-v5" in refused(tmp_path / "ant.hdf5")
    arrays["observations"], arrays["timeouts"] = np.zeros((3, 11)), np.ones(3)
    write_hdf5(path, arrays)
    assert "no transition that can be compared" in refused(path)


def test_play_zoo_plays_the_policy_of_the_zip(tmp_path, capsys):
    """Here those of an Actor, under the names that rl-baselines3-zoo gives them."""
    torch.manual_seed(0)
    actor = wpc.Actor(11, 3, 1.0)
    layers = ("latent_pi.0", 0), ("latent_pi.2", 2), ("mu", 4), ("log_std", 0)
    policy = {
        f"actor.{name}.{x}": getattr(actor[i], x).detach()
        for name, i in layers
        for x in ("weight", "bias")
    }
    torch.save(policy, tmp_path / "policy.pth")
    path = tmp_path / "sac/Hopper-v3_1/Hopper-v3.zip"
    path.parent.mkdir(parents=True)
    with zipfile.ZipFile(path, "w") as file:
        file.write(tmp_path / "policy.pth", "policy.pth")
    play_zoo.main(play_zoo.Args([path], episodes=3))
    printed = capsys.readouterr().out.splitlines()[-1]
    cells = ["sac Hopper-v3"]
    for env in ("hopper", "Hopper-v4"):
        args, envs = wpc.Args(env=env, dataset="none"), wpc.make_envs(env, 3)
        row = wpc.evaluate(envs, actor, torch.zeros(11), torch.ones(11), args)
        cells.append(f"{row['mean_return']:.0f} +- {row['std_return']:.0f}")
    assert cells[1] != cells[2]
    assert printed == f"| {' | '.join(cells)} |"

    for name in ("none/Hopper-v3.zip", "Ant-v3.zip"):
        with pytest.raises(SystemExit, match=name):
            play_zoo.main(play_zoo.Args([tmp_path / name]))
