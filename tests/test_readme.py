# SPDX-License-Identifier: MIT
"""What the README shows is what the code does: arguments, the diff, the snippet."""

import re
import subprocess

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import ROOT, command, run, wpc

README = (ROOT / "README.md").read_text()


def test_arguments():
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*?) \| ", README, re.M))
    for name, field in wpc.Args.__dataclass_fields__.items():
        shown = rows[name].replace(",", "")
        assert shown == str(field.default) or field.default is None and shown == "" or float(shown) == field.default, name


def test_the_diff_is_real():
    shown = README.split("```diff\n")[1].split("```")[0].splitlines()
    lines = subprocess.run(["diff", "-U9", "td3_bc.py", "wpc.py"], cwd=ROOT, capture_output=True, text=True).stdout.splitlines()
    assert len(shown) > 8 and set(shown) <= {line.rstrip() for line in lines}


def test_the_snippet_acts_and_evaluates(tmp_path):
    assert run(*command("wpc", "--max-timesteps", 1, "--eval-episodes", 10, "--run-dir", tmp_path)).returncode == 0
    snippet = README.split("```python\n")[1].split("```")[0]
    variables = {"observation": np.zeros(17)}
    gym.logger.min_level = gym.logger.ERROR
    exec(snippet.replace("runs/DIR", str(tmp_path)), variables)
    assert variables["action"].shape == (6,) and abs(variables["action"]).max() <= 1
    checkpoint = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    again = variables["actor"]((torch.zeros(1, 17) - checkpoint["mean"]) / checkpoint["std"])
    assert variables["action"] == pytest.approx(again[0].detach().numpy(), abs=1e-6)
    assert " ".join(f"{x:.2f}" for x in variables["returns"]) == checkpoint["rows"][-1]["returns"]
