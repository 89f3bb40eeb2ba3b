# SPDX-License-Identifier: MIT
"""tests/tools/experiments.py from the list of commands to the report on the runs."""

import csv
import itertools
import json
import math
import shlex
import sys
from dataclasses import asdict

import numpy as np
import pytest
import tyro
from conftest import ROOT, SCRIPTS, assert_one_sentence, run, wpc_with
from scipy import stats

sys.path.insert(0, str(ROOT / "tests/tools"))
import experiments

STEPS = range(10, 130, 10)  # twelve evaluations
WEIGHTS = ("exponential", "random", "static")
MODULES = SCRIPTS | {f"wpc_{weight}": wpc_with(weight) for weight in WEIGHTS}


def make_run(folder, script, dataset, seed, scores, q=5.0, steps=STEPS, **arguments):
    """A run folder as the scripts leave it, with best_discounted_return 10."""
    args = MODULES[script].Args(
        env="hopper", dataset=f"data/{dataset}.hdf5", seed=seed, **arguments
    )
    folder.mkdir(parents=True)
    (folder / "args.json").write_text(json.dumps(asdict(args) | {"torch": "2"}))
    steps, count = [0, *steps], len(steps)
    columns = {
        "step": steps,
        "mean_return": [3.0] * (count + 1),
        "normalized_score": [0.0, *np.broadcast_to(scores, count)],
        "best_discounted_return": [10.0] * (count + 1),
        "q": ["", *np.broadcast_to(q, count)],
    }
    with (folder / "evaluations.csv").open("w") as file:
        csv.writer(file).writerows([columns, *zip(*columns.values(), strict=True)])
    return folder


@pytest.fixture
def tool(capsys):
    """The tool in this process: what it prints on stdout."""

    def call(*arguments):
        experiments.main([str(x) for x in arguments])
        return capsys.readouterr().out

    return call


def report(tool, runs, out):
    """What the report prints, and the cells of its tables by title."""
    printed = tool("report", "--runs", runs, "--out", out)
    sections = (out / "tables.md").read_text().split("\n## ")[1:]
    tables = {}
    for section in sections:
        title, *lines = section.splitlines()
        lines = [line[2:-2].split(" | ") for line in lines if line.startswith("| ")]
        header, _, *rows = lines
        tables[title] = [dict(zip(header, row, strict=True)) for row in rows]
    return printed, tables


def with_runs(table):
    """The rows of Table 1 on tasks that a system has runs on."""
    return [
        row
        for row in table
        if {row[x] for x in ("wPC", "TD3+BC", "wBC", "BC")} != {"-"}
    ]


def catch_figures(monkeypatch):
    """The panels of each figure by its name, in place of the pictures."""
    drawn = {}

    def draw(path, panels):
        drawn[path.stem] = panels

    monkeypatch.setattr(experiments, "draw", draw)
    return drawn


def figures(out):
    return {path.stem for path in out.glob("*.png")}


# --- The list -------------------------------------------------------------------------


def listed(tool, *arguments):
    return [shlex.split(line) for line in tool("list", *arguments).splitlines()]


@pytest.mark.parametrize(
    ("experiment", "runs"),
    [("table1", 12 * 3), ("table2", 12 * 4), ("figure4", 2), ("runaway", 4)],
)
def test_the_scripts_take_the_commands(tool, experiment, runs):
    lines = listed(
        tool, experiment, "--runs", "my runs", "--datasets", "data", "--seeds", 2
    )
    assert len(lines) == 2 * runs
    folders = set()
    for python, script, *words in lines:
        args = tyro.cli(MODULES[script.removesuffix(".py")].Args, args=words)
        assert python == "python"
        assert (args.max_timesteps, args.eval_freq) == (1_000_000, 10_000)
        folder, name = args.run_dir.split("/")
        task = name.split("__")[0]
        assert folder == "my runs" and args.env == f"{task}-v2"
        assert args.dataset == f"data/{task.replace('-', '_')}.hdf5"
        folders.add(args.run_dir)
    assert len(folders) == 2 * runs


def test_the_list_says_what_the_paper_compared(tool):
    lines = listed(tool, "table1", "--seeds", 1)
    assert sorted(line[1] for line in lines) == sorted(
        ["wpc.py", "td3_bc.py", "wbc.py"] * 12
    )
    lines = [" ".join(line) for line in listed(tool, "table2")]
    assert sum("wpc_exponential.py" in line for line in lines) == 12 * 5
    assert sum("wpc_random.py" in line for line in lines) == 12 * 5
    assert (
        sum("td3_bc.py --env hopper-medium-v2 --seed 4" in line for line in lines) == 1
    )
    assert not any("--dataset" in line for line in lines)
    first, second = (" ".join(line) for line in listed(tool, "figure4", "--seeds", 1))
    assert "--env walker2d-medium-v2" in first and "wpc_static.py" in second
    lines = [
        " ".join(line) for line in listed(tool, "runaway", "--seeds", 1, "--compiled")
    ]
    assert len(lines) == 4
    assert all(x.startswith("python tests/tools/compiled.py wpc.py") for x in lines)
    assert [line.count("--alpha=") for line in lines] == [0, 1, 1, 1]


# --- The report -----------------------------------------------------------------------


def test_a_report_by_hand(tool, tmp_path):
    """Two tasks of three seeds; a run's last ten scores are the same, the first two
    are not."""

    def scores(last):
        return [100, 100, *[last] * 10]

    for task, shift in (("hopper_medium", 0), ("walker2d_medium-v2", 10)):
        for seed, score in enumerate((1, 2, 3)):
            last = score + shift
            args = task, seed, scores(last)
            make_run(tmp_path / f"a/{task}__wpc__{seed}__now", "wpc", *args)
            args = task, seed, scores(2 * last)
            make_run(tmp_path / f"b/{task}/{seed}", "td3_bc", *args)
            make_run(tmp_path / f"c/{task}/{seed}", "wbc", *args)
    path, q = tmp_path / "d", [5, 20, 30, *[4] * 9]
    make_run(path / "0", "wpc", "hopper_medium", 0, scores(7), q=q, alpha=1.0)
    make_run(path / "1", "wpc", "hopper_medium", 1, scores(8), q=11, alpha=1.0)
    make_run(path / "2", "wpc", "hopper_medium", 2, scores(9), q=11, alpha=1.0)
    make_run(path / "3", "td3_bc", "hopper_medium", 0, 4, alpha=0.0)
    make_run(path / "4", "wpc_static", "hopper_medium", 0, 6)
    out, tables = report(tool, tmp_path, tmp_path / "report")
    assert "passed over" not in out

    tasks = [row["task"] for row in tables["Table 1"]]
    assert tasks == experiments.TASKS
    assert tables["Table 1"][0]["wPC, paper"] == "19.6"  # also where there are no runs
    hopper, walker = with_runs(tables["Table 1"])
    # It is not our data, whose best return is another.
    assert hopper["data's score"] == "-"
    assert hopper["task"] == "hopper-medium" and walker["task"] == "walker2d-medium"
    assert hopper["wPC"] == "2.0 ± 1.0 (3; 0.12k)"
    assert hopper["TD3+BC"] == hopper["wBC"] == "4.0 ± 2.0 (3; 0.12k)"
    assert walker["wPC"] == "12.0 ± 1.0 (3; 0.12k)"
    assert hopper["BC"] == "4.0 (1; 0.12k)" and walker["BC"] == "-"
    assert hopper["wPC, paper"] == "86.5" and hopper["TD3+BC, paper"] == "57.7"
    assert hopper["TD3+BC, CORL"] == "60.4" and walker["BC, CORL"] == "63.2"

    # Welch's t test: variances 1/3 and 4/3, so the standard error is sqrt(5/3) and the
    # degrees of freedom are (5/3)^2 / ((1/3)^2 / 2 + (4/3)^2 / 2) = 50/17.
    error, freedom = math.sqrt(5 / 3), 50 / 17
    half = stats.t.ppf(0.975, freedom) * error
    p = 2 * stats.t.sf(2 / error, freedom)
    expected = f"-2.0 [{-2 - half:.1f}, {-2 + half:.1f}], p = {p:.2g} (3, 3; 0.12k)"
    hopper, _ = tables["Differences"]
    assert hopper["wPC - TD3+BC"] == hopper["wPC - wBC"] == expected

    totals = [list(row.values()) for row in tables["Totals"]]
    assert totals == [  # the paper's on the same two tasks, CORL's, the paper's in all
        ["wPC", "2", "14.0", "172.5", "-", "800.7"],
        ["TD3+BC", "2", "28.0", "140.9", "143.1", "712.9"],
        ["wBC", "2", "28.0", "145.2", "-", "712.7"],
        ["BC", "1", "4.0", "52.9", "53.5", "475.5"],
    ]

    (row,) = tables["Other weights (Table 2, Figure 4)"]
    assert row["static weight"] == "6.0 (1; 0.12k)" and row["wPC-e, paper"] == "67.0"
    assert row["wPC"] == "2.0 ± 1.0 (3; 0.12k)"

    rows = tables["When does Q run away?"]
    assert len(rows) == 9
    (row,) = (row for row in rows if row["arguments"] == "alpha 1.0")
    assert row["system"] == "wPC" and row["seeds; steps"] == "3; 0.12k"
    assert row["score"] == "8.0 ± 1.0"
    # The last ten of q are 30 and nine times 4.
    assert row["Q at the end"] == "0.66 to 1.10" and row["largest Q"] == "1.10 to 3.00"
    assert row["at step"] == "10 to 30"
    assert row["seeds over 1"] == "3" and row["back"] == "1"

    assert figures(tmp_path / "report") == {"figure2", "figure3", "figure4"}


def test_q_that_rises_at_the_last_step_is_not_back(tool, tmp_path):
    make_run(tmp_path / "0", "wpc", "hopper_medium", 0, 10, q=[4.0] * 11 + [11.0])
    _, tables = report(tool, tmp_path, tmp_path / "report")
    (row,) = tables["When does Q run away?"]
    assert (row["seeds over 1"], row["back"]) == ("1", "0")


def test_where_all_returns_are_negative_q_has_no_measure(tool, tmp_path):
    path = make_run(tmp_path / "0", "wpc", "mine", 0, 10, batch_size=16)
    table = (path / "evaluations.csv").read_text().replace("10.0,", "-1.0,")
    (path / "evaluations.csv").write_text(table)
    _, tables = report(tool, tmp_path, tmp_path / "report")
    (row,) = tables["When does Q run away?"]
    assert row["arguments"] == "batch_size 16" and row["largest Q"] == "-"


def test_runs_of_unequal_length(tool, tmp_path):
    """A cell counts to where its shortest run ends, a difference to where both do."""
    shorter, longer = range(10, 110, 10), range(5, 205, 5)
    for seed in (0, 1):
        path, rise = tmp_path / f"wpc{seed}", np.arange(5, 205, 5) + seed
        make_run(path, "wpc", "hopper_medium", seed, rise, steps=longer)
        steps = (shorter, longer)[seed]
        path = tmp_path / f"td3_bc{seed}"
        make_run(path, "td3_bc", "hopper_medium", seed, seed, steps=steps)
    _, tables = report(tool, tmp_path, tmp_path / "report")
    (row,) = with_runs(tables["Table 1"])
    # Steps 155, 160, ..., 200; seed 1 scores one more
    assert row["wPC"] == "178.0 ± 0.7 (2; 0.2k)"
    assert row["TD3+BC"] == "0.5 ± 0.7 (2; 0.1k)"
    (row,) = tables["Differences"]  # steps 10, 20, ..., 100: 55.5 - 0.5
    assert row["wPC - TD3+BC"].startswith("55.0 [")
    assert row["wPC - TD3+BC"].endswith("(2, 2; 0.1k)") and row["wPC - wBC"] == "-"
    assert figures(tmp_path / "report") == {"figure2", "figure3"}


def test_runs_evaluated_at_other_steps(tmp_path, tool):
    """Neither a mean over seeds nor a difference is of evaluations that none shares."""
    for i, (script, seed) in enumerate(itertools.product(SCRIPTS, (0, 1))):
        steps = np.array(STEPS) + {"wpc": 0, "td3_bc": 1, "wbc": 2 * seed}[script]
        make_run(tmp_path / str(i), script, "hopper_medium", seed, 50, steps=steps)
    out, tables = report(tool, tmp_path, tmp_path / "report")
    assert "passed over: ('hopper-medium', 'wBC', '') (its runs share 0" in out
    (row,) = with_runs(tables["Table 1"])
    assert row["TD3+BC"] == "50.0 ± 0.0 (2; 0.121k)" and row["wBC"] == "-"
    assert "Differences" not in tables


def test_runs_that_are_of_no_use_are_passed_over(tool, tmp_path):
    runs = tmp_path / "runs"
    good = make_run(runs / "good", "wpc", "hopper_medium", 0, 50)
    twin = make_run(runs / "twin", "wpc", "hopper_medium", 0, 9, steps=range(1, 11))
    short = make_run(runs / "short", "wpc", "hopper_medium", 1, 50, steps=range(1, 10))
    table = (good / "evaluations.csv").read_text()
    bad = {
        "empty": "",
        "header": "step,normalized_score\n",
        "cut": table.removesuffix("0,10.0,5.0\n"),
        "text": "this is no table\n" * 12,
        "nan": table.replace("50", "nan", 1),
        "twice": table + table.split("\n", 1)[1],
    }
    assert bad["cut"].endswith("\n120,3.0,5")
    for name, text in bad.items():
        path = make_run(runs / name, "wpc", "hopper_medium", 2, 50)
        (path / "evaluations.csv").write_text(text)
    for name, text in (("no args", None), ("args", "{"), ("other", '{"lr": 1}')):
        path = make_run(runs / name, "wpc", "hopper_medium", 3, 50)
        (path / "args.json").unlink()
        if text:
            (path / "args.json").write_text(text)
    (make_run(runs / "new", "wpc", "x", 4, 1) / "evaluations.csv").unlink()
    out, tables = report(tool, runs, tmp_path / "report")
    (row,) = with_runs(tables["Table 1"])
    assert row["wPC"] == "50.0 (1; 0.12k)"
    lines = [line for line in out.splitlines() if line.startswith("passed over: ")]
    for name in (*bad, "no args", "args", "other", twin.name, short.name):
        assert sum(f"{runs / name} (" in line for line in lines) == 1, name
    assert len(lines) == len(bad) + 5 and "9 evaluations, ten are needed" in out


def test_runs_on_different_data_are_no_seeds_of_one_system(tool, tmp_path):
    for seed in (0, 1):
        make_run(tmp_path / f"wpc{seed}", "wpc", "hopper_medium", seed, 10)
        path = make_run(tmp_path / f"wbc{seed}", "wbc", "hopper_medium", seed, 10)
        path /= "evaluations.csv"
        path.write_text(path.read_text().replace("10.0,5.0\n", f"1{seed}.0,5.0\n"))
    printed, tables = report(tool, tmp_path, tmp_path / "report")
    (row,) = with_runs(tables["Table 1"])
    assert row["wPC"] == "10.0 ± 0.0 (2; 0.12k)" and row["wBC"] == "-"
    assert "'wBC', '') (its runs share 12 evaluations, on data with" in printed
    assert "best returns of 10.0 and 11.0)" in printed


def test_systems_on_different_data_are_not_compared(tmp_path):
    for seed, task in itertools.product((0, 1), ("hopper_medium", "walker2d_medium")):
        for script in ("wpc", "td3_bc", "wbc"):
            folder = tmp_path / f"{script}{task}{seed}"
            make_run(folder, script, task, seed, 10 + seed)
            if script == "wbc":
                path = folder / "evaluations.csv"
                path.write_text(path.read_text().replace("10.0,5.0\n", "11.0,5.0\n"))
    groups = experiments.read_groups(tmp_path)
    systems = {system: groups["hopper-medium", system, ""] for _, system, _ in groups}
    assert experiments.difference(systems["wPC"], systems["TD3+BC"]).startswith("0.0 [")
    assert experiments.difference(systems["wPC"], systems["wBC"]) == "-"


def test_q_is_drawn_where_returns_are_negative(tmp_path, monkeypatch):
    scales, plain = [], experiments.plt.close
    monkeypatch.setattr(
        experiments.plt,
        "close",
        lambda figure: plain(scales.append(figure.axes[0].get_yscale()) or figure),
    )
    steps = np.arange(10)
    for best, q in ((-0.3, -1.0), (0.3, 1.0), (0.3, 9.0)):
        curve = "wPC", ("black", "-"), steps, np.full((3, 10), q)
        draw = [("pendulum", "Q", [curve], [(best, "black", "--")])]
        experiments.draw(tmp_path / "q.png", draw)
    assert scales == ["linear", "linear", "log"]


def test_what_is_kept_apart(tool, tmp_path):
    """Other arguments, weights of one's own, and returns that are no scores."""
    task, expert = "hopper_medium", "hopper_medium_expert"
    make_run(tmp_path / "0", "wpc", task, 0, 10)
    make_run(tmp_path / "1", "wpc", task, 1, 20, actor_lr=1e-3)
    make_run(tmp_path / "2", "wpc", expert, 0, 30, alpha=0.1)
    make_run(tmp_path / "3", "wpc", expert, 0, 40, alpha=2.5)
    path = make_run(tmp_path / "4", "wpc", task, 1, 50)
    args = json.loads((path / "args.json").read_text())
    (path / "args.json").write_text(json.dumps(args | {"weight": "mine"}))
    path = make_run(tmp_path / "5", "wbc", task, 1, 60) / "evaluations.csv"
    path.write_text(path.read_text().replace("normalized_score", "other"))
    _, tables = report(tool, tmp_path, tmp_path / "report")
    scores = {
        row["task"]: (row["wPC"], row["wBC"]) for row in with_runs(tables["Table 1"])
    }
    assert scores == {
        "hopper-medium": ("10.0 (1; 0.12k)", "-"),
        "hopper-medium-expert": ("30.0 (1; 0.12k)", "-"),
        "hopper-medium (mean return)": ("-", "3.0 (1; 0.12k)"),
    }
    assert figures(tmp_path / "report") == {"figure2"}
    rows = tables["When does Q run away?"]
    assert {(row["arguments"], row["score"]) for row in rows} == {
        ("alpha 2.5", "10.0"),
        ("actor_lr 0.001", "20.0"),
        ("alpha 0.1", "30.0"),
        ("alpha 2.5", "40.0"),
        ("weight mine", "50.0"),
        ("", "3.0"),
    }


def test_the_data_have_a_score_of_their_own(tmp_path, monkeypatch):
    """Where the runs' best return is that of the data whose score is known."""
    for task in ("hopper_medium", "walker2d_medium"):
        make_run(tmp_path / task, "wpc", task, 0, 3)
    path = make_run(tmp_path / "x", "wpc", "hopper_medium", 0, 3, discount=0.9)
    path /= "evaluations.csv"  # of other arguments, with which returns differ
    path.write_text(path.read_text().replace("10.0,5.0\n", "11.0,5.0\n"))
    groups = experiments.read_groups(tmp_path)
    assert len(groups) == 3
    monkeypatch.setattr(experiments, "ROOT", tmp_path)
    path = tmp_path / "tests/results/datasets.csv"
    path.parent.mkdir(parents=True)
    path.write_text(
        "task,transitions,mean_score,best_return\nhopper-medium,1000,44.2,10.0\n"
        "walker2d-medium,2000,9,11.0\n"
    )
    table = experiments.score_table(groups, ["hopper-medium", "walker2d-medium"], [])
    rows = ["| hopper-medium | 44.2 | 1,000, of D4RL's policy |"]
    rows.append("| walker2d-medium | - | - |")
    assert table.splitlines()[2:] == rows


def test_a_report_on_tasks_of_ones_own(tool, tmp_path):
    """It has no rows and no panels for the paper's twelve."""
    make_run(tmp_path / "0", "td3_bc", "mine", 0, 10, alpha=0.0)
    _, tables = report(tool, tmp_path, tmp_path / "report")
    (row,) = tables["Table 1"]
    assert row["task"] == "mine" and row["BC"] == "10.0 (1; 0.12k)"
    assert "Totals" not in tables and figures(tmp_path / "report") == set()


def test_a_report_without_runs(tmp_path):
    program = [sys.executable, ROOT / "tests/tools/experiments.py"]
    process = run(*program, "report", "--runs", tmp_path)
    assert_one_sentence(process, "holds no run with ten evaluations")


def test_a_report_that_can_not_be_written(tmp_path):
    make_run(tmp_path / "0", "wpc", "hopper_medium", 0, 10)
    program = [sys.executable, ROOT / "tests/tools/experiments.py"]
    (tmp_path / "file").touch()
    out = tmp_path / "file/report"
    process = run(*program, "report", "--runs", tmp_path, "--out", out)
    assert_one_sentence(process, "--out can't be written: [Errno 20]")


def test_other_weights_and_what_is_drawn(tool, tmp_path, monkeypatch):
    """Each system's two runs have scores of their own, and Q is half a point higher."""
    drawn = catch_figures(monkeypatch)
    systems = {
        "wPC": "wpc",
        "TD3+BC": "td3_bc",
        "wPC-e": "wpc_exponential",
        "wPC-rnd": "wpc_random",
        "static weight": "wpc_static",
    }
    for i, script in enumerate(systems.values()):
        for seed in (0, 2):
            run = script, "hopper_medium", seed, 10 * i + seed
            make_run(tmp_path / f"{i}/{seed}", *run, q=run[-1] + 0.5)
    _, tables = report(tool, tmp_path, tmp_path / "report")
    (row,) = tables["Other weights (Table 2, Figure 4)"]
    names = list(systems)
    assert [float(row[name].split()[0]) for name in names] == [1, 11, 21, 31, 41]
    (row,) = tables["Differences to other weights"]
    differences = [row[f"wPC - {name}"].split(" [")[0] for name in names[2:]]
    assert differences == ["-20.0", "-30.0", "-40.0"]

    def curves(panel):
        """Lowest, mean and highest of each curve, all of which are constant."""
        _, _, shown, _ = panel
        return {name: [x.mean() for x in band] for name, _, _, band in shown}

    expected = {name: [10 * i, 10 * i + 1, 10 * i + 2] for i, name in enumerate(names)}
    (panel,) = drawn["figure2"]
    assert panel[0] == "hopper-medium" and curves(panel) == {
        name: expected[name] for name in names[:2]
    }
    (panel,) = drawn["figure3"]
    assert curves(panel)["TD3+BC"] == [10.5, 11.5, 12.5] and panel[3][0][0] == 10
    q, scores = drawn["figure4"]
    assert curves(q)["static weight"] == [40.5, 41.5, 42.5]
    assert curves(scores)["static weight"] == expected["static weight"]
    (panel,) = drawn["figure5"]
    assert curves(panel) == {name: expected[name] for name in names[:4]}
    assert [level for level, *_ in panel[3]] == [86.5, 57.7, 67.0, 66.5]  # the paper's


# --- What is stored -------------------------------------------------------------------


def test_our_td3_bc_is_compared_with_the_published_curves(tool, tmp_path, monkeypatch):
    """Their numbers at the steps of ours, from the stored file."""
    path = ROOT / "tests/results/td3_bc_on_d4rl.csv"
    lines = [x for x in path.read_text().splitlines() if not x.startswith("#")]
    rows = [row for row in csv.DictReader(lines) if row["task"] == "hopper-medium"]
    means = [float(row["mean"]) for row in rows]
    steps = range(10_000, 210_000, 10_000)
    shifts = np.array([1, 2, 3])
    for seed, shift in enumerate(shifts):
        scores = np.array(means[:20]) + shift
        path = tmp_path / str(seed)
        make_run(path, "td3_bc", "hopper_medium", seed, scores, steps=steps)
    drawn = catch_figures(monkeypatch)
    _, tables = report(tool, tmp_path, tmp_path / "report")
    (row,) = tables["TD3+BC here and on D4RL's files"]
    theirs, std = np.mean(means[:20]), float(rows[19]["average_std"])
    assert row["these runs"] == f"{theirs + 2:.1f} ± 1.0 (3; 200k)"
    assert row["on D4RL's files"] == f"{theirs:.1f} ± {std:.1f} (5)"
    (panel,) = drawn["reproduction"]
    (_, _, steps, theirs), (_, _, _, ours) = panel[2]
    assert len(steps) > 20 and [x[0] for x in ours] == pytest.approx(means[0] + shifts)
    assert [x[0] for x in theirs] == [float(rows[0][x]) for x in ("min", "mean", "max")]
    variances = np.array([1 / 3, std**2 / 5])
    freedom = variances.sum() ** 2 / (variances**2 / [2, 4]).sum()
    p = 2 * stats.t.sf(2 / math.sqrt(variances.sum()), freedom)
    assert row["p"] == f"{p:.2g}"


def test_the_published_curves_are_those_of_their_source():
    source = ROOT.parent / "shared/d4rl/td3_bc_curves.csv"
    if not source.exists():
        pytest.skip(f"{source}, which they were made from, is not here")
    scores = {}
    for row in csv.DictReader(source.open()):
        key = row["dataset"].removesuffix("-v2"), int(row["step"])
        scores.setdefault(key, []).append(float(row["normalized_score"]))
    lines = (ROOT / "tests/results/td3_bc_on_d4rl.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert len(rows) == 12 * 100
    sums = dict.fromkeys(experiments.TASKS, 0)
    for row in rows:
        task, step = row["task"], int(row["step"])
        five = np.array(scores[task, step])
        sums[task] += five
        averages = sums[task] / (step / 10_000)
        values = five.mean(), five.min(), five.max(), averages.std(ddof=1)
        stored = [float(row[name]) for name in ("mean", "min", "max", "average_std")]
        assert len(five) == 5 and stored == pytest.approx(values, abs=0.001)


def test_the_report_on_the_results(tool, tmp_path):
    """What is stored in tests/results is what the report makes of the runs there."""
    results = ROOT / "tests/results"
    report(tool, results / "runs", tmp_path)
    assert (tmp_path / "tables.md").read_text() == (results / "tables.md").read_text()
    assert figures(tmp_path) == figures(results)
