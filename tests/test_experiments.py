# SPDX-License-Identifier: MIT
"""tests/tools/experiments.py from the list of commands to the report on the runs."""

import csv
import itertools
import json
import re
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import DATASET, ROOT, assert_one_sentence, run, wpc

sys.path.insert(0, str(ROOT / "tests/tools"))
import experiments
import runaway

PROGRAM = [sys.executable, ROOT / "tests/tools/experiments.py"]
TASK = "halfcheetah-medium-replay-v2"


def listed(*arguments):
    process = run(*PROGRAM, "list", *arguments)
    assert process.returncode == 0, process.stderr
    return process.stdout.splitlines()


def test_the_lists_are_the_papers():
    assert len(listed("table1")) == 12 * 3 * 5
    assert len(listed("table2")) == 12 * 4 * 5
    figure4 = listed("figure4")
    assert len(figure4) == 10
    assert all("--env walker2d-medium-v2 --seed" in line for line in figure4)
    assert sum("wpc.py" in line and "--weight static" in line for line in figure4) == 5
    assert all("--max-timesteps 1000000" in line for line in figure4)
    assert not any("--dataset" in line for line in figure4)
    assert len({line.split("--run-dir ")[1] for line in listed("table1")}) == 180


def test_folders_with_spaces_are_quoted():
    line = listed("figure4", "--runs", "my runs", "--datasets", "my data")[0]
    words = shlex.split(line)
    assert words[words.index("--dataset") + 1] == "my data/walker2d_medium.hdf5"
    assert words[words.index("--run-dir") + 1].startswith("my runs/wpc__")


def test_list_run_and_report(tmp_path):
    data, runs, out = tmp_path / "data", tmp_path / "runs", tmp_path / "report"
    data.mkdir()
    shutil.copy(DATASET, data / "halfcheetah_medium_replay.hdf5")
    choice = ["--tasks", TASK, "--max-timesteps", 40, "--datasets", data]
    choice += ["--runs", runs, "--extra=--eval-freq 20 --eval-episodes 1"]
    lines = listed("table1", *choice, "--systems", "wpc", "--seeds", 0, 1)
    others = ["--systems", "td3_bc", "wpc-random", "--seeds", 0]
    lines += listed("table2", *choice, *others)
    assert len(lines) == 4
    for again in (lines, lines[:1]):  # the second time, it is finished
        process = subprocess.run(
            ["xargs", "-I{}", "sh", "-c", "{}"],
            input="\n".join(again),
            text=True,
            cwd=ROOT,
            capture_output=True,
        )
        assert process.returncode == 0, process.stderr
        assert process.stdout.count("finished at step 40") == len(again)

    unfinished = runs / f"wbc__{TASK}__0"
    unfinished.mkdir()
    (unfinished / "evaluations.csv").write_text("step\n")
    process = run(*PROGRAM, "report", "--runs", runs, "--out", out)
    assert process.returncode == 0, process.stderr
    assert f"wbc__{TASK}__0 has no evaluation yet" in process.stdout
    figures = sorted(path.name for path in out.glob("*.png"))
    assert figures == ["figure2.png", "figure3.png", "figure5.png"]
    for name in figures:
        assert (out / name).stat().st_size > 10_000

    text = (out / "tables.md").read_text().splitlines()
    name = "| halfcheetah-medium-replay (not D4RL's file)"
    cells = [line.split(" | ") for line in text if line.startswith(name)]
    scores = []
    for seed in (0, 1):
        rows = csv.DictReader((runs / f"wpc__{TASK}__{seed}/evaluations.csv").open())
        scores.append([float(row["normalized_score"]) for row in rows])
    assert [len(row) for row in cells] == [5, 3, 6, 4]  # Tables 1 and 2
    table1, difference = cells[:2]
    assert table1[1] == "40" and table1[4].strip(" |") == "missing"  # wBC
    mean, _, std, seeds = table1[2].split()
    low, high = np.array(scores).mean(axis=1)
    assert float(mean) == pytest.approx((low + high) / 2, abs=0.051)
    assert float(std) == pytest.approx(abs(low - high) / 2**0.5, abs=0.051)
    assert seeds == "(2)" and table1[3].endswith(" (1)")
    assert difference[1:] == ["-", "- |"]  # TD3+BC has one seed
    assert "| halfcheetah-medium-replay-v2 | 48.3 | 44.6 | 41.1 |" in text


def test_scores_and_differences_by_hand():
    three, two = np.array([1.0, 2.0, 3.0]), np.array([5.0, 7.0])
    assert experiments.mean_and_std(three) == "2.0 ± 1.0 (3)"
    assert experiments.mean_and_std(three[:1]) == "1.0 (1)"
    assert experiments.mean_and_std(three[:0]) == "missing"
    # Standard errors 1 / sqrt(3) and 1, together 1.155
    assert experiments.difference(three, two) == "**-4.0 ± 1.2**"
    assert experiments.difference(two, three) == "**4.0 ± 1.2**"
    assert experiments.difference(two - 2, three) == "2.0 ± 1.2"
    assert experiments.difference(three, two[:1]) == "-"


def test_the_interquartile_mean_and_its_interval():
    """By hand, and by going through all that the bootstrap could draw."""
    tasks = np.array([[0.0, 4, 1], [43, 40, 41], [80, 87, 82]])
    # Of nine scores, the two lowest and the two highest are left out.
    assert experiments.interquartile_mean(*tasks) == (4 + 40 + 41 + 43 + 80) / 5
    draws = [list(itertools.product(task, repeat=3)) for task in tasks]
    middles = [
        sorted(itertools.chain(*drawn))[2:-2] for drawn in itertools.product(*draws)
    ]
    low, high = np.percentile(np.mean(middles, axis=1), [2.5, 97.5])
    text = experiments.interquartile_mean_and_interval(tasks)
    assert text.startswith("41.6 [")
    bounds = [float(number) for number in text[6:-1].split(", ")]
    assert bounds == pytest.approx([low, high], abs=0.25)


def test_scripts_of_different_content_are_told_apart(tmp_path):
    """Two seeds of each system: wBC's runs are of one script, wPC's are of two."""
    runs = ROOT / "tests/results"
    for system, hashes in (("wbc", ["aa", "aa"]), ("wpc", ["aa", "bb"])):
        for seed, sha256 in enumerate(hashes):
            run_dir = tmp_path / f"{system}__{TASK}__{seed}"
            shutil.copytree(runs / f"{system}__{TASK}__{seed}", run_dir)
            line = json.dumps({"script_sha256": sha256})
            (run_dir / "provenance.jsonl").write_text(f"{line}\n{line}\n")
    process = run(*PROGRAM, "report", "--runs", tmp_path, "--out", tmp_path)
    assert process.returncode == 0, process.stderr
    notes = [x for x in process.stdout.splitlines() if "versions of the script" in x]
    assert len(notes) == 1 and notes[0].startswith("wPC on halfcheetah-medium-replay")
    assert "of 2 different versions" in notes[0]
    text = (tmp_path / "tables.md").read_text()
    assert notes[0] in text
    for row in ("wBC | aa", "wPC | aa", "wPC | bb"):
        assert f"| {row} | {TASK} |" in text


def test_a_report_without_runs(tmp_path):
    process = run(*PROGRAM, "report", "--runs", tmp_path)
    assert_one_sentence(process, "holds no run folders")


def test_the_report_on_the_results(tmp_path):
    """What is stored in tests/results is what the report makes of the runs there, and
    the README has its scores."""
    results = ROOT / "tests/results"
    process = run(*PROGRAM, "report", "--runs", results, "--out", tmp_path)
    assert process.returncode == 0, process.stderr
    made = (tmp_path / "tables.md").read_text()
    assert made == (results / "tables.md").read_text()
    readme = (ROOT / "README.md").read_text()
    scores, *_ = made.split("## Table 1\n\n")[1].split("\n\n")
    for row in scores.splitlines()[2:]:
        assert row.replace(" (not D4RL's file)", "") in readme
    results_section = readme.split("\n## Results")[1].split("\n## ")[0]
    with_error = re.compile(r"-?\d+\.\d ± \d+\.\d")
    numbers = with_error.findall(results_section)
    assert len(numbers) > 10
    for number in numbers:
        assert number in with_error.findall(made), number


RUNAWAY = [sys.executable, ROOT / "tests/tools/runaway.py"]


@pytest.mark.parametrize("folder", ["runaway", "runaway_later"])
def test_the_stored_tables_of_runs_that_run_away(tmp_path, folder):
    stored = ROOT / "tests/results" / folder
    copy = shutil.copytree(stored, tmp_path / "copy")
    (copy / "table.md").unlink()
    (copy / "figure.png").unlink()
    process = run(*RUNAWAY, "--runs", copy)
    assert process.returncode == 0, process.stderr
    assert (copy / "table.md").read_text() == (stored / "table.md").read_text()
    assert (copy / "figure.png").stat().st_size > 10_000


def test_the_tables_threshold_is_the_scripts():
    assert wpc.q_runs_away(runaway.THRESHOLD * 10 + 0.01, 10)
    assert not wpc.q_runs_away(runaway.THRESHOLD * 10 - 0.01, 10)


def test_a_table_of_runs_that_run_away_by_hand(tmp_path):
    """Two seeds of alpha 2.5, of which one runs away, and one seed of alpha 10."""
    for name, alpha, q in (("0", 2.5, 11), ("1", 2.5, 25), ("2", 10.0, 13)):
        run_dir = tmp_path / f"data/{alpha}/wpc__task__{name}"
        run_dir.mkdir(parents=True)
        rows = f"step,q,normalized_score\n1000,5,0\n2000,{q},{q + 1}\n"
        (run_dir / "evaluations.csv").write_text(rows)
        (run_dir / "args.json").write_text(json.dumps({"alpha": alpha}))
        line = json.dumps({"best_discounted_return": 10})
        (run_dir / "provenance.jsonl").write_text(f"{line}\n{line}\n")
    process = run(*RUNAWAY, "--runs", tmp_path)
    assert process.returncode == 0, process.stderr
    assert process.stdout.splitlines()[2:] == [
        "| data | 2.5 | 2,000 | 1.10, 2.50 | never; 2,000 | 12.0, 26.0 | 6.0, 13.0 |",
        "| data | 10.0 | 2,000 | 1.30 | 2,000 | 14.0 | 7.0 |",
    ]
    (tmp_path / "none").mkdir()
    process = run(*RUNAWAY, "--runs", tmp_path / "none")
    assert_one_sentence(process, "holds no run folders")
