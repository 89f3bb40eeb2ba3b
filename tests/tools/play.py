# SPDX-License-Identifier: MIT
"""Films the beginning of an episode of a trained policy; no display is needed.

python tests/tools/play.py runs/RUN --out policy.gif
"""

import importlib.util
import math
import os
import re
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import torch
import tyro
from PIL import Image
from tqdm import tqdm

# MuJoCo can't be imported if the library that this names is missing; `start` sets it
# again, where what is missing can be said in a sentence.
MUJOCO_GL = os.environ.pop("MUJOCO_GL", None)
sys.path.insert(0, str(Path(__file__).parents[2]))
import mujoco  # noqa: E402
from make_dataset import reason, try_to_write  # noqa: E402

import wpc  # noqa: E402


@dataclass
class Args:
    run_dir: Annotated[Path, tyro.conf.Positional]
    """folder of a run of any of the scripts"""
    out: Path
    """a GIF, an MP4, PNG frames (FOLDER/%04d.png), or just a folder for these"""
    seed: int = 0
    """seed of the episode"""
    fps: int = 30
    """frames a second at most, in the environment's time"""
    frames: int = 100
    """number of frames at most"""
    size: int = 240
    """width and height of the picture"""

    def __post_init__(self):
        if min(self.fps, self.frames, self.size) < 1:
            raise ValueError("fps, frames and size must be >= 1")


def frame_path(out):
    """The path to write to, with %d for PNG frames; exits if that is not possible."""
    if out.suffix == "":
        out /= "%04d.png"
    film = out.suffix in (".gif", ".mp4") and "%" not in out.name
    frames = re.fullmatch(r"[^%]*%\d*d[^%]*\.png", out.name)
    if not (film or frames):
        sys.exit(f"--out {out} must end in .gif, .mp4 or %04d.png, or be a folder")
    if out.suffix == ".mp4" and not importlib.util.find_spec("imageio_ffmpeg"):
        sys.exit("an MP4 needs a further package: pip install imageio-ffmpeg")
    if out.suffix == ".png":
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            sys.exit(f"--out can't be written: {error}")
    try_to_write(out)
    return out


def load(run_dir):
    """The checkpoint of a run, and its policy as a function of raw observations."""
    path = run_dir / "checkpoint.pt"
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        weights = checkpoint["agent"]["actor"]
        dims = weights["net.0.weight"].shape[1], len(weights["net.4.weight"])
        actor = wpc.Actor(*dims, checkpoint["max_action"])
        actor.load_state_dict(weights)
    except Exception as error:  # of as many types as there are kinds of damage
        sys.exit(f"{path} can't be read ({reason(error)})")

    @torch.no_grad()
    def policy(observation):
        s = torch.as_tensor(observation, dtype=torch.float32)
        return actor((s - checkpoint["mean"]) / checkpoint["std"]).numpy()

    return checkpoint, policy


def make_env(env):
    """The environment that the scripts evaluate on, with pictures."""
    warnings.filterwarnings("ignore", ".*out of date")
    robot = wpc.d4rl_robot(env)
    env = gym.make(robot[0] if robot else env, render_mode="rgb_array")
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer:  # the camera that follows the robot, or -1, which stands still
        camera = mujoco.mjtObj.mjOBJ_CAMERA
        renderer.camera_id = mujoco.mj_name2id(env.unwrapped.model, camera, "track")
    return wpc.use_d4rl_physics(env) if robot else env


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


def write(path, images, fps):
    if path.suffix == ".gif":
        images = [image.quantize(64, dither=Image.Dither.NONE) for image in images]
        options = {"save_all": True, "append_images": images[1:], "loop": 0}
        images[0].save(path, duration=1000 / fps, **options)
    elif path.suffix == ".mp4":
        imageio.mimsave(path, [np.asarray(image) for image in images], fps=fps)
    else:
        for i, image in enumerate(images):
            image.save(path.with_name(path.name % i))


def main(args):
    path = frame_path(args.out)
    checkpoint, policy = load(args.run_dir)
    name = checkpoint["args"]["env"]
    env, observation = start(args, name)
    steps_per_second = env.metadata.get("render_fps", 30)
    every = math.ceil(steps_per_second / args.fps)
    images, episode_return, step, over = [], 0.0, 0, False
    progress = tqdm(total=env.spec.max_episode_steps, disable=None)
    while not over:
        if step % every == 0 and len(images) < args.frames:
            image = Image.fromarray(env.render())
            images.append(image.resize((args.size, args.size)))
        observation, reward, terminated, truncated, _ = env.step(policy(observation))
        episode_return += reward
        step += 1
        over = terminated or truncated
        progress.update()
    progress.close()
    env.close()
    try:
        write(path, images, steps_per_second / every)
    except OSError as error:
        sys.exit(f"--out {args.out} can't be written: {error}")
    line = f"{args.out}: {step:,} steps, return {episode_return:.1f}"
    if robot := wpc.d4rl_robot(name):
        _, low, high = robot
        line += f", D4RL's score {100 * (episode_return - low) / (high - low):.1f}"
    print(line)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except KeyboardInterrupt:
        sys.exit("stopped; nothing was written")
