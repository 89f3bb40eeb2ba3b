# SPDX-License-Identifier: MIT
"""Films an episode of one or more trained policies, side by side; no display is needed.

    python tests/tools/play.py runs/wPC runs/TD3+BC --out policies.gif

All episodes begin with the same seed. Above each stands the name of its folder.
"""

import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image, ImageDraw, ImageEnhance, ImageFont

# MuJoCo can't be imported if the library that this names is missing; `start` sets it
# again, where what is missing can be said in a sentence.
MUJOCO_GL = os.environ.pop("MUJOCO_GL", None)
sys.path.insert(0, str(Path(__file__).parents[2]))
import mujoco  # noqa: E402
from make_dataset import reason, score, try_to_write  # noqa: E402

import wpc  # noqa: E402


@dataclass
class Args:
    run_dirs: tyro.conf.Positional[list[Path]]
    """folders of runs of any of the scripts"""
    out: Path
    """the GIF to write"""
    seed: int = 0
    """seed of the episodes"""
    fps: int = 30
    """frames a second at most, in the environment's time"""
    frames: int = 100
    """number of frames at most"""
    size: int = 240
    """width and height of each policy's picture"""

    def __post_init__(self):
        if min(self.fps, self.frames, self.size, len(self.run_dirs)) < 1:
            raise ValueError("name a run; fps, frames and size must be >= 1")
        if self.out.suffix != ".gif":
            raise ValueError(f"--out {self.out} must end in .gif")


def load(run_dir):
    """The checkpoint of a run, and its policy as a function of raw observations."""
    path = run_dir / "checkpoint.pt"
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        weights = checkpoint["agent"]["actor"]
        dims = weights["0.weight"].shape[1], len(weights["4.weight"])
        actor = wpc.Actor(*dims, checkpoint["max_action"])
        actor.load_state_dict(weights)
    except Exception as error:  # of as many types as there are kinds of damage
        sys.exit(f"{path} can't be read ({reason(error)})")

    @torch.no_grad()
    def policy(observation):
        s = torch.as_tensor(observation, dtype=torch.float32)
        return actor((s - checkpoint["mean"]) / checkpoint["std"]).numpy()

    return checkpoint, policy


def make_env(name):
    """The environment that the scripts evaluate on, with pictures."""
    env = wpc.make_envs(name, 1).envs[0]
    env.unwrapped.render_mode = "rgb_array"
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer:  # the camera that follows the robot, or -1, which stands still
        camera = mujoco.mjtObj.mjOBJ_CAMERA
        renderer.camera_id = mujoco.mj_name2id(env.unwrapped.model, camera, "track")
    return env


def start(args, name):
    """The environment after its reset, with the first observation.

    Exits with a sentence if there is no picture of it.
    """
    if MUJOCO_GL or (sys.platform == "linux" and "DISPLAY" not in os.environ):
        os.environ["MUJOCO_GL"] = MUJOCO_GL or "egl"
    env = None
    try:
        env = make_env(name)
        observation, _ = env.reset(seed=args.seed)
        np.asarray(env.render(), dtype=np.uint8).reshape(-1, 3)
    except Exception as error:  # of the graphics libraries, of many types
        sys.unraisablehook = lambda _: None  # what is half made can't be freed
        advice = (
            "; MuJoCo needs EGL or OSMesa (on Debian, apt install libegl1 or "
            "libosmesa6), which MUJOCO_GL=egl or MUJOCO_GL=osmesa chooses"
        )
        if not (env and hasattr(env.unwrapped, "mujoco_renderer")):
            advice = ""
        sys.exit(f"{name} can't be filmed ({reason(error)}){advice}")
    return env, observation


def picture(env, size, text, dimmed=False):
    """What the environment looks like, with text above."""
    image = Image.fromarray(env.render()).resize((size, size))
    if dimmed:
        image = ImageEnhance.Brightness(image).enhance(0.5)
    font = ImageFont.load_default(size / 18)
    ImageDraw.Draw(image).text((size / 40, size / 60), text, "white", font)
    return image


def film(run_dir, args):
    """An episode's pictures and their number a second; prints how it went."""
    checkpoint, policy = load(run_dir)
    name, seed = checkpoint["args"]["env"], checkpoint["args"]["seed"]
    trained = checkpoint["evaluations"][-1]["step"]
    title = f"{run_dir.resolve().name}\n{trained:,} training steps, seed {seed}\n"
    env, observation = start(args, name)
    fps = env.metadata.get("render_fps", 30)
    every = math.ceil(fps / args.fps)
    images, episode_return, step, over = [], 0.0, 0, False
    while not over:
        if step % every == 0 and len(images) < args.frames:
            text = f"{title}step {step:,}, return {episode_return:,.0f}"
            images.append(picture(env, args.size, text))
        observation, reward, terminated, truncated, _ = env.step(policy(observation))
        episode_return += reward
        step += 1
        over = terminated or truncated
    end = f"{step:,} steps, return {episode_return:,.0f}"
    if len(images) * every >= step:  # the end is in the film
        images.append(picture(env, args.size, f"{title}ended: {end}", dimmed=True))
    env.close()
    print(f"{run_dir}: {end}{score(name, episode_return)}")
    return images, fps / every


def write(path, films, fps):
    """Writes a GIF of films side by side, in which the shorter wait for the longest."""
    frames = []
    for i in range(max(map(len, films))):
        row = [np.asarray(images[min(i, len(images) - 1)]) for images in films]
        frames.append(Image.fromarray(np.hstack(row)))
    # One palette for all, so that what doesn't move need not be written again
    some = [*frames[:: len(frames) // 4 + 1], frames[-1]]
    palette = Image.fromarray(np.hstack(some)).quantize(64)
    frames = [x.quantize(palette=palette, dither=Image.Dither.NONE) for x in frames]
    durations = [1000 / fps] * (len(frames) - 1) + [3000]
    options = {"save_all": True, "append_images": frames[1:], "loop": 0}
    frames[0].save(path, duration=durations, **options)


def main(args):
    try_to_write(args.out)
    films, fps = zip(*(film(run_dir, args) for run_dir in args.run_dirs), strict=True)
    if len(set(fps)) > 1:
        sys.exit("the runs must be of environments with the same render_fps")
    try:
        write(args.out, films, fps[0])
    except OSError as error:
        sys.exit(f"--out {args.out} can't be written: {error}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except KeyboardInterrupt:
        sys.exit("stopped; nothing was written")
