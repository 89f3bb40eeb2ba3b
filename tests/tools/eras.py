# SPDX-License-Identifier: MIT
"""Environments as MuJoCo's earlier releases had them, by names of their own.

    PYTHONPATH=tests/tools python wpc.py --env eras:Hopper-before-3.5-v5 --dataset FILE

Data recorded with an older MuJoCo and a policy evaluated on today's are often of two
dynamics, as three of MuJoCo's defaults have changed. Each can be switched back, and
importing this module registers the environments that moved, of Gymnasium and, where
they are installed, of gymnasium-robotics and OGBench, with the switches set.
"""

import importlib.util
import re

import gymnasium as gym
import mujoco
from gymnasium.envs.registration import WrapperSpec
from packaging.version import Version

for package in ("gymnasium_robotics", "ogbench"):
    if importlib.util.find_spec(package):
        importlib.import_module(package)  # which registers its environments

INSTALLED = Version(mujoco.__version__)
ERAS = ("3.3", "3.5", "3.8")  # the releases that changed a default
MOVED = {  # which environments, by id without version, and with which releases
    "(Hopper|Ant|Humanoid|HumanoidStandup|Pusher)-v[45]": ("3.5",),
    "(AntMaze|PointMaze)_.*": ("3.5",),
    "AdroitHand(Hammer|Pen).*": ("3.3", "3.5", "3.8"),
    "AdroitHand(Door|Relocate).*": ("3.3", "3.5"),
    "(antmaze|antsoccer)-.*": ("3.5",),  # OGBench's
}
# Changes that no switch undoes: the environments, and since when and until when.
NO_SWITCH = (
    ("Fetch.*|(cube|scene|puzzle)-.*", "3.7", None),
    ("(cube|scene|puzzle)-.*", "3.3", None),
    ("FrankaKitchen-.*", "3.4", None),
    ("FrankaKitchen-.*", "3.5", None),
    ("(AntMaze|PointMaze)_.*|HumanoidStandup-.*", "2.3.3", "3.0"),
    (r"Ant-.*|Humanoid.*|AntMaze_.*|(antmaze|antsoccer)-.*", "4.0.0", "4.0.1"),
)
NEVER_MOVED = (
    "(Walker2d|HalfCheetah|Swimmer|Reacher|Inverted(Double)?Pendulum)-.*"
    "|(pointmaze|humanoidmaze)-.*"
)


class NotHere(Exception):
    """What an environment needs, said in a sentence."""


def use_era(env, before):
    """Sets the switches with which `env` moves as before that release ("3.5")."""
    model = env.unwrapped.model
    disable = mujoco.mjtDisableBit
    changed = [x for x in ERAS if Version(before) <= Version(x) <= INSTALLED]
    if "3.3" in changed:  # the native convex collision became the default
        model.opt.disableflags |= disable.mjDSBL_NATIVECCD
    if "3.5" in changed:  # a contact's margins are added; the larger one counted
        model.geom_margin /= 2  # exact where they are all equal
    if "3.8" in changed:  # two convex geoms have several contacts by default
        model.opt.disableflags |= disable.mjDSBL_MULTICCD
    return env


def era_id(env_id, before):
    name, version = re.fullmatch(r"(.*)(-v\d+)", env_id).groups()
    return f"{name}-before-{before}{version}"


def moved(env_id):
    """The releases that moved this environment and that switches undo."""
    return next((x for ids, x in MOVED.items() if re.fullmatch(ids, env_id)), ())


def era_of(env_id, version):
    """The id that moves on the installed MuJoCo as `env_id` did on MuJoCo `version`.

    That is `env_id` itself where nothing between the two moved it. Raises NotHere with
    a sentence where no switch brings it back, or where nothing is known of it.
    """
    version, (*_, name) = Version(str(version)), env_id.split(":")
    needs = (
        f"{name} moves otherwise on the installed mujoco {INSTALLED} than on {version}"
        f"{{}}: evaluate in an environment of its own with mujoco=={version}"
    )
    for ids, *limits in NO_SWITCH:
        since, until = (Version(x or "1000") for x in limits)
        if re.fullmatch(ids, name) and (
            (since <= version < until) != (since <= INSTALLED < until)
        ):
            raise NotHere(needs.format(", and no switch brings that back"))
    low, high = sorted([version, INSTALLED])
    between = [x for x in moved(name) if low < Version(x) <= high]
    if not between:
        return env_id
    if version > INSTALLED:
        raise NotHere(needs.format(""))
    return f"eras:{era_id(name, between[0])}"


def register():
    for spec in list(gym.registry.values()):
        for before in moved(spec.id):
            wrapper = WrapperSpec("use_era", "eras:use_era", {"before": before})
            gym.register(
                id=era_id(spec.id, before),
                entry_point=spec.entry_point,
                reward_threshold=spec.reward_threshold,
                max_episode_steps=spec.max_episode_steps,
                kwargs=spec.kwargs,
                additional_wrappers=(*spec.additional_wrappers, wrapper),
            )


register()
