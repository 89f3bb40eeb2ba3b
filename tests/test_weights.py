# SPDX-License-Identifier: MIT
"""tests/tools/weights.py as a user runs it; what the weights are, test_update.py and
test_data.py test."""

import json
import sys

import pytest
import torch
from conftest import ROOT, assert_one_sentence, command, load, run, weights


def test_a_copy_is_a_script_of_its_own(tmp_path):
    tool, copy = ROOT / "tests/tools/weights.py", tmp_path / "wpc_random.py"
    process = run(sys.executable, tool, "random", "--out", copy)
    shown = f"to train: {sys.executable} {copy} --env hopper-medium-v2\n"
    assert (process.stdout, process.stderr) == (shown, "")
    line, run_dir = command("wpc", "--run-dir", tmp_path / "run"), tmp_path / "run"
    line[1] = copy
    assert run(*line).returncode == 0
    assert json.loads((run_dir / "args.json").read_text())["weight"] == "random"
    assert load(run_dir)["args"]["weight"] == "random"
    process = run(*command("wpc", "--run-dir", run_dir))  # a run of another weight
    assert_one_sentence(process, "has another weight: choose another --run-dir")


def test_where_it_cannot_write(tmp_path):
    tool, out = ROOT / "tests/tools/weights.py", tmp_path / "no" / "wpc_random.py"
    process = run(sys.executable, tool, "random", "--out", out)
    assert_one_sentence(process, "--out can't be written: ")


def test_a_change_of_wpc_that_hides_a_line_is_noticed(tmp_path, monkeypatch):
    changed = tmp_path / "wpc.py"
    changed.write_text((ROOT / "wpc.py").read_text().replace("(advantage > 0)", "w"))
    monkeypatch.setattr(weights, "WPC", changed)
    with pytest.raises(AssertionError, match=r"not once in wpc\.py"):
        weights.with_weight("static")


def test_the_shuffled_weights_are_those_of_indexing_by_randperm():
    """`gather` is the same, and torch.compile can take it."""
    weight = torch.rand(50, 1)
    torch.manual_seed(0)
    ours = weight.gather(0, torch.randperm(len(weight))[:, None])
    torch.manual_seed(0)
    assert torch.equal(ours, weight[torch.randperm(len(weight))])
