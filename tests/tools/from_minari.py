# SPDX-License-Identifier: MIT
"""Turns a Minari dataset into an HDF5 file in D4RL's format, which the scripts read.

    python tests/tools/from_minari.py mujoco/hopper/medium-v0 --out hopper.hdf5

The scripts make no transition of a row with a timeout, nor of the last row. So where an
episode was cut off, its last observation gets a row of its own, without action and
reward, and marked as a timeout; and no transition of the dataset is lost. As such a row
has a return of 0, best_discounted_return is at least 0; and where all episodes ended in
a terminal state, the last row counts as an episode of return 0 for the static weight.

A policy is evaluated on the environment that Minari records for that. Where it has
arguments, a time limit or wrappers that its id alone does not give, --env must name one
that has them: register it, as Gymnasium's documentation says, in a module of your own.
Where MuJoCo has moved the environment since the data were recorded, the command names
it as it was then (see eras.py).
"""

import importlib.metadata
import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import minari
import numpy as np
import tyro
from packaging.requirements import InvalidRequirement, Requirement
from packaging.specifiers import SpecifierSet
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[2]))
import eras
from check_physics import which_physics
from make_dataset import print_command, reason, try_to_write, write_or_exit

import wpc

# MuJoCo's releases, and others that there are not
RELEASES = [f"{x}.{y}.{z}" for x in (2, 3, 4) for y in range(20) for z in range(10)]


@dataclass
class Args:
    dataset: Annotated[str, tyro.conf.Positional]
    """name of a Minari dataset, downloaded on first use, or the folder of one"""
    out: Path
    """HDF5 file to write"""
    env: str | None = None
    """Gymnasium id (MODULE:ID) to evaluate on; by default Minari's"""
    clip: bool = False
    """clip actions to the environment's bounds, as most environments do themselves"""


def open_dataset(name):
    """Minari's dataset; exits with a sentence if there is none of that name."""
    folder = Path(name)
    if (folder / "data").is_dir():
        folder = folder / "data"
    try:
        if folder.is_dir():
            return minari.MinariDataset(folder)
        return minari.load_dataset(name, download=True)
    except Exception as error:  # from Minari, Hugging Face's client, or the network
        sys.exit(f"{name} can't be opened or downloaded by Minari ({reason(error)})")


def check_spaces(dataset):
    """Exits with a sentence if the scripts can't learn from such data."""
    if dataset.total_steps == 0:
        sys.exit(f"{dataset.id} is empty")
    states, actions = dataset.observation_space, dataset.action_space
    if not isinstance(actions, gym.spaces.Box):
        sys.exit(
            f"{dataset.id} has actions in {actions}, and the policy's are continuous: "
            "they must be in a Box"
        )
    for name, space in {"observations": states, "actions": actions}.items():
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            sys.exit(
                f"{dataset.id} has {name} in {space}, not in a Box of one axis: make a "
                "dataset of them flattened (gymnasium.spaces.flatten), and name with "
                "--env an environment that is flattened likewise"
            )


def as_record(spec, states, actions):
    """What an environment has beside its id, {name: value}."""
    arguments = {k: v for k, v in spec.kwargs.items() if k != "render_mode"}
    wrappers = [[x.name, x.kwargs] for x in spec.additional_wrappers or ()]
    record = {"arguments": arguments, "wrappers": wrappers}
    record = json.loads(json.dumps(record, default=str))  # as Minari stores them
    record |= {"time limit": spec.max_episode_steps, "states": states.shape}
    if isinstance(actions, gym.spaces.Box):
        return record | {"actions": [actions.low.tolist(), actions.high.tolist()]}
    return record | {"actions": str(actions)}


def choose_env(dataset, env, actions):
    """The id to evaluate on.

    Exits with a sentence if that is another environment than the one that Minari
    records, as far as that can be seen.
    """
    spec = dataset._eval_env_spec or dataset.env_spec  # the former has no public name
    if not (env or spec):
        sys.exit(f"{dataset.id} records no environment: name it with --env")
    package = re.split("[.:]", str(spec and spec.entry_point))[0]  # that registers it
    name = env or (spec.id if package == "gymnasium" else f"{package}:{spec.id}")
    try:
        plain = gym.make(name)
    except Exception as error:  # the environment's own, or from an import
        sys.exit(
            f"{name} can't be made ({reason(error)}): install what it needs, or name "
            f"one with --env and its module (MODULE:ID); recorded is {spec}"
        )
    theirs = as_record(
        spec or plain.spec, dataset.observation_space, dataset.action_space
    )
    ours = as_record(plain.spec, plain.observation_space, plain.action_space)
    if spec and env and plain.spec.entry_point != spec.entry_point:
        # Arguments and wrappers inside the user's own entry point can't be seen here.
        for x in ("arguments", "wrappers"):
            print(f"{env} is taken to have the {x} of {spec.id}: {theirs.pop(x)}")
    if env and theirs["time limit"] is None:  # the scripts need one
        del theirs["time limit"]
    beyond = (np.abs(actions) > 1.001 * dataset.action_space.high).any()
    if env and beyond and plain.action_space.shape == dataset.action_space.shape:
        print(f"{env} is taken to clip actions to {theirs.pop('actions')}")
    differences = [
        f"{x} {value}, not {ours[x]}" for x, value in theirs.items() if value != ours[x]
    ]
    if differences:
        sys.exit(
            f"{dataset.id} is of another environment than {name}, with "
            f"{'; '.join(differences)}: register one like it, and name it with --env "
            "MODULE:ID"
        )
    wpc.make_envs(name, 1).close()  # exits if the scripts can't use it
    return name


def d4rl_rows(episode, extra):
    """The rows of an episode of T steps, {key: array}: T, or with `extra` T + 1."""
    steps, states = len(episode.actions), np.float32(episode.observations)
    rows = {
        "observations": states[:-1],
        "actions": episode.actions,
        "rewards": np.float32(episode.rewards),
        "next_observations": states[1:],
        "terminals": episode.terminations,
        "timeouts": np.zeros(steps, dtype=bool),
    }
    if extra:
        rows = {k: np.concatenate([x, np.zeros_like(x[:1])]) for k, x in rows.items()}
        rows["observations"][-1] = rows["next_observations"][-1] = states[-1]
        rows["timeouts"][-1] = True
    for key in ("qpos", "qvel"):  # for check_physics.py
        values = (episode.infos or {}).get(key, ())
        if len(values) == steps + 1:
            rows[f"infos/{key}"] = values[: steps + extra]
    return rows


def convert(dataset):
    """The columns of the file, {key: array}."""
    episodes = []
    progress = tqdm(total=dataset.total_episodes, disable=None)
    for episode in dataset.iterate_episodes():
        progress.update()
        steps, states = len(episode.actions), len(episode.observations)
        if states != steps + 1:
            sys.exit(
                f"{dataset.id}: episode {episode.id} has {steps} actions and {states} "
                f"observations, not {steps + 1}; look for a later version of the "
                "dataset, or make one without this episode"
            )
        if steps:
            episodes.append(episode)
    # The last row is lost to the scripts. Where there is an episode that was cut off,
    # that is its extra row, and else the file needs one that belongs to no episode.
    episodes.sort(key=lambda x: not x.terminations[-1])
    parts = [
        d4rl_rows(x, not x.terminations[-1] or x is episodes[-1]) for x in episodes
    ]
    keys = [key for key in parts[0] if all(key in part for part in parts)]
    return {key: np.concatenate([part[key] for part in parts]) for key in keys}


def clip(actions, env, allowed):
    """The actions within the bounds; exits with a sentence if it may not clip them."""
    high = wpc.make_envs(env, 1).single_action_space.high
    beyond = (np.abs(actions) > 1.001 * high).any(axis=1).sum()  # as the scripts count
    if not beyond:
        return actions
    line = f"{beyond:,} actions are beyond the bounds of {env}, -{high[0]:g} and "
    line += f"{high[0]:g}, and the largest is {np.abs(actions).max():g}"
    if not allowed:
        sys.exit(f"{line}: add --clip, or name with --env an environment that clips")
    print(f"{line}: clipped")
    return actions.clip(-high, high)


def check_requirements(dataset):
    """Says which requirements are not met; returns those on MuJoCo, a SpecifierSet."""
    of_mujoco = SpecifierSet()
    for text in np.atleast_1d(dataset.storage.metadata.get("requirements") or []):
        try:
            requirement = Requirement(text)
            installed = importlib.metadata.version(requirement.name)
        except InvalidRequirement:
            print(f"{dataset.id} requires {text}, which pip would not understand")
        except importlib.metadata.PackageNotFoundError:
            print(f'{dataset.id} requires {text}: pip install "{text}"')
        else:
            if requirement.name == "mujoco":
                of_mujoco &= requirement.specifier
            elif not requirement.specifier.contains(installed, prereleases=True):
                print(f"{dataset.id} requires {text}, and {installed} is installed")
    return of_mujoco


def choose_era(dataset, env, columns):
    """The id that moves on the installed MuJoCo as `env` did on that of the data.

    The requirements decide, or where they leave it open the transitions.
    """
    allowed, found = check_requirements(dataset), {}
    is_mujoco = allowed or hasattr(gym.make(env).unwrapped, "model")
    if not is_mujoco or env.startswith("eras:"):
        return env
    for version in allowed.filter(RELEASES):
        try:
            found[eras.era_of(env, version)] = (
                f"{dataset.id} requires mujoco{allowed}, and {env} moves otherwise on "
                f"the installed {eras.INSTALLED}: the command evaluates it as it was"
            )
        except eras.NotHere as error:
            found.setdefault(None, str(error))
    if len(found) != 1:
        if re.fullmatch(eras.STAYED, env):
            return env
        try:
            found = dict([which_physics(columns, env)])
        except wpc.UserError as error:
            found = {None: f"nothing is known of the MuJoCo of {dataset.id}: {error}"}
    ((name, why),) = found.items()
    if name != env:
        print(why)
    return name or env


def main(args):
    try_to_write(args.out)
    dataset = open_dataset(args.dataset)
    check_spaces(dataset)
    columns = convert(dataset)
    for name, column in columns.items():
        if not np.isfinite(column).all():
            sys.exit(
                f"{dataset.id} has {name} that are not finite, which can't be used"
            )
    env = choose_env(dataset, args.env, columns["actions"])
    columns["actions"] = clip(columns["actions"], env, args.clip)
    write_or_exit(args.out, columns)
    print(
        f"{args.out}: {dataset.total_steps:,} transitions in "
        f"{dataset.total_episodes:,} episodes of {env}"
    )
    metadata = dataset.storage.metadata
    if metadata.get("ref_max_score") is not None:
        low, high = metadata["ref_min_score"], metadata["ref_max_score"]
        print(f"Minari's scores 0 and 100 are returns of {low} and {high}")
    print_command(choose_era(dataset, env, columns), args.out)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except wpc.UserError as error:
        sys.exit(str(error))
