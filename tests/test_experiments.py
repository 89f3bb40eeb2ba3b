# SPDX-License-Identifier: MIT
"""The paper's experiments from the list of commands over the runs to the report, in a few hundred steps."""

import csv
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import DATASET, ROOT, run

PROGRAM = [sys.executable, str(ROOT / "tests/experiments.py")]
TASK = "halfcheetah-medium-replay-v2"


def listed(*arguments):
    return run(*PROGRAM, "list", *map(str, arguments)).stdout.splitlines()


def test_the_lists_are_the_paper_s():
    assert len(listed("table1")) == 12 * 3 * 5
    assert len(listed("table2")) == 12 * 4 * 5
    figure4 = listed("figure4")
    assert len(figure4) == 10 and all("--env walker2d-medium-v2 --seed" in line for line in figure4)
    assert sum("wpc.py" in line and "--weight static" in line for line in figure4) == 5
    assert all("--max-timesteps 1000000" in line and "--dataset" not in line for line in figure4)
    assert len({line.split("--run-dir ")[1] for line in listed("table1")}) == 180


def test_list_run_and_report(tmp_path):
    (tmp_path / "data").mkdir()
    shutil.copy(DATASET, tmp_path / f"data/{TASK[:-3].replace('-', '_')}.hdf5")
    choice = ["--tasks", TASK, "--max-timesteps", 200, "--datasets", tmp_path / "data", "--runs", tmp_path / "runs"]
    choice += ["--extra=--eval-freq 100 --eval-episodes 2"]
    lines = listed("table1", *choice, "--systems", "wpc", "td3_bc", "--seeds", 0, 1)
    lines += listed("table2", *choice, "--systems", "wpc-exponential", "wpc-random", "--seeds", 0)
    assert len(lines) == 6
    commands = "\n".join(lines)
    for _ in range(2):  # the second time all is finished
        process = subprocess.run(
            ["xargs", "-P", "2", "-I{}", "sh", "-c", "{}"], input=commands, text=True, cwd=ROOT, capture_output=True, timeout=300
        )
        assert process.returncode == 0 and process.stdout.count("finished step 200") == 6, process.stderr

    process = run(*PROGRAM, "report", "--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "report"))
    assert process.returncode == 0, process.stderr
    for figure in (2, 3, 5):
        content = (tmp_path / f"report/figure{figure}.png").read_bytes()
        assert content.startswith(b"\x89PNG") and len(content) > 10_000
    assert not (tmp_path / "report/figure4.png").exists()  # nothing ran for it
    text = (tmp_path / "report/tables.md").read_text()
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith(f"| {TASK[:-3]} (not D4RL's file)")]
    last, ten = [], []
    for seed in (0, 1):
        scores = [float(r["score"]) for r in csv.DictReader(open(tmp_path / f"runs/wpc__{TASK}__{seed}/evaluations.csv"))]
        assert len(scores) == 3
        last.append(scores[-1])
        ten.append(sum(scores) / 3)
    assert [row[1] for row in rows] == ["200", "200"]
    for shown, values in zip(rows[0][2:4], (last, ten)):
        mean, spread = map(float, shown.split(" ± "))
        assert mean == pytest.approx(np.mean(values), abs=0.051)
        assert spread == pytest.approx(abs(values[0] - values[1]) / 2**0.5, abs=0.051)  # ddof = 1
    assert rows[0][4:6] == ["2", "48.3"] and rows[0][9] == "44.6"
    assert rows[0][10:12] == ["missing", "missing"]  # wBC


def test_report_without_runs(tmp_path):
    process = run(*PROGRAM, "report", "--runs", str(tmp_path))
    assert process.returncode == 1 and "holds no run folders" in process.stderr and process.stderr.count("\n") == 1
