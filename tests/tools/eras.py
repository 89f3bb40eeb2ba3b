# SPDX-License-Identifier: MIT
"""Environments as MuJoCo's earlier releases moved them, by names of their own.

    PYTHONPATH=tests/tools python wpc.py --env eras:Hopper-before-3.5-v5 --dataset FILE

Three of MuJoCo's defaults have changed, so that data recorded with an older release and
a policy evaluated on today's may be of two dynamics. Importing this module registers
the environments that moved, of Gymnasium and, where they are installed, of
gymnasium-robotics and OGBench, with the old defaults. How far each has moved was
measured by stepping the same states on the releases from 2.3.3 to 4.0.0.
"""

import importlib.util
import re

import gymnasium as gym
import mujoco
from gymnasium.envs.registration import WrapperSpec
from packaging.version import Version

for package in ("gymnasium_robotics", "ogbench"):
    if importlib.util.find_spec(package):
        importlib.import_module(package)  # registers its environments

INSTALLED = Version(mujoco.__version__)
ERAS = ("3.3", "3.5", "3.8")  # the releases that changed a default
MOVED = {  # the environments, and by which of these releases they were moved
    "(Hopper|Ant|Humanoid|HumanoidStandup)-v[45]|Pusher-v5": ("3.5",),
    "(AntMaze|PointMaze)_.*": ("3.5",),
    "AdroitHand(Hammer|Pen).*": ("3.3", "3.5", "3.8"),
    "AdroitHand(Door|Relocate).*": ("3.3", "3.5"),
    "(antmaze|antsoccer)-.*": ("3.5",),  # OGBench's, as are the lower-case names below
}
STAYED = (  # those that no release has moved
    "(HalfCheetah|Walker2d|Swimmer|Reacher|InvertedPendulum|InvertedDoublePendulum)"
    "-v[45]|(pointmaze|humanoidmaze)-.*"
)
NO_SWITCH = (  # changes that can't be undone: the environments, since when, until when
    (".*", "2.1.2", "1000"),  # the masses of capsules
    ("(AntMaze|PointMaze)_.*|HumanoidStandup-.*", "2.3.3", "3"),
    ("(cube|scene|puzzle)-.*", "3.3", "1000"),
    ("FrankaKitchen-.*", "3.4", "1000"),
    ("FrankaKitchen-.*", "3.5", "1000"),
    ("Fetch.*|(cube|scene|puzzle)-.*", "3.7", "1000"),
    ("(Ant|Humanoid|AntMaze|antmaze|antsoccer).*", "4.0.0", "4.0.1"),  # a bug
)


class NotHere(Exception):
    """The installed MuJoCo can't move an environment as another did."""


def use_era(env, before):
    """Makes `env` move as it did before MuJoCo's release `before`, one of ERAS."""
    model, flags = env.unwrapped.model, mujoco.mjtDisableBit
    changed = [x for x in ERAS if Version(before) <= Version(x) <= INSTALLED]
    if "3.3" in changed:  # the collisions of meshes, ellipsoids, cylinders
        model.opt.disableflags |= flags.mjDSBL_NATIVECCD
    if "3.5" in changed:  # a contact's margins are added; the larger one counted
        model.geom_margin /= 2  # exact where all are equal
    if "3.8" in changed:  # two convex geoms meet in several points, not in one
        model.opt.disableflags |= flags.mjDSBL_MULTICCD
    return env


def moved_by(name):
    """Those of ERAS that moved the environment of this name."""
    return next((x for names, x in MOVED.items() if re.fullmatch(names, name)), ())


def era_name(name, before):
    return re.sub(r"(-v\d+)$", rf"-before-{before}\1", name)


def era_of(env_id, version):
    """The id that moves on the installed MuJoCo as `env_id` did on MuJoCo `version`.

    That is `env_id` itself where no release between the two moved it. Raises NotHere,
    with a sentence, where no switch brings the old one back, or where we don't know.
    """
    name, version = env_id.split(":")[-1], Version(str(version))
    advice = f"evaluate in an environment of its own with mujoco=={version}"
    apart = f"{name} moves otherwise on the installed mujoco {INSTALLED} than on"
    for names, *period in NO_SWITCH:
        since, until = map(Version, period)
        if re.fullmatch(names, name) and (
            (since <= version < until) != (since <= INSTALLED < until)
        ):
            raise NotHere(f"{apart} {version}, and no switch undoes that: {advice}")
    older, newer = sorted([version, INSTALLED])
    between = [x for x in moved_by(name) if older < Version(x) <= newer]
    if between and newer == version:
        raise NotHere(f"{apart} {version}, which is newer: {advice}")
    known = [*MOVED, STAYED, *(names for names, *_ in NO_SWITCH[1:])]
    if version.release[:2] != INSTALLED.release[:2] and not any(
        re.fullmatch(names, name) for names in known
    ):
        raise NotHere(
            f"we don't know whether {name} moves on the installed mujoco {INSTALLED} "
            f"as on {version}: if it is one of MuJoCo's, {advice}"
        )
    return f"eras:{era_name(name, between[0])}" if between else env_id


for spec in list(gym.registry.values()):
    for before in moved_by(spec.id):
        wrapper = WrapperSpec("use_era", "eras:use_era", {"before": before})
        gym.register(
            id=era_name(spec.id, before),
            entry_point=spec.entry_point,
            reward_threshold=spec.reward_threshold,
            max_episode_steps=spec.max_episode_steps,
            kwargs=spec.kwargs,
            additional_wrappers=(*spec.additional_wrappers, wrapper),
        )
