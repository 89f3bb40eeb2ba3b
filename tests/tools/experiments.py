# SPDX-License-Identifier: MIT
"""The paper's experiments: the commands to run, and a report on what they left.

    python tests/tools/experiments.py list table1 --runs runs/paper > commands.txt
    xargs -P 2 -I{} sh -c "{}" < commands.txt
    python tests/tools/experiments.py report --runs runs/paper --out report

`list` starts nothing. Run its lines again, and what was interrupted is continued.
`report` writes tables.md and those of Figures 2 to 5 that the runs can show.
"""

import csv
import json
import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro

TASKS = [
    f"{robot}-{kind}-v2"
    for kind in ("random", "medium", "medium-replay", "medium-expert")
    for robot in ("halfcheetah", "hopper", "walker2d")
]
PAPER = {
    # Tables 1 and 2 of the paper, task by task: 5 seeds, 1,000,000 steps, D4RL's files
    "td3_bc": "11.7 8.6 0.9 48.2 57.7 83.2 44.6 67.4 83.7 90.7 106.1 110.1",
    "wbc": "2.2 10.5 12.1 45.6 64.2 81.0 41.1 86.6 61.2 92.5 105.8 109.9",
    "wpc-exponential": "16.0 9.1 4.4 48.6 67.0 83.8 44.6 88.9 85.6 91.5 103.0 110.2",
    "wpc-random": "15.5 7.9 0.2 50.5 66.5 59.3 47.0 78.5 77.1 75.0 59.6 103.1",
    "wpc": "19.6 19.9 0.7 53.3 86.5 86.0 48.3 97.0 89.9 93.7 95.7 110.1",
}
EXPERIMENTS = {  # systems and tasks
    "table1": (["wpc", "td3_bc", "wbc"], TASKS),
    "table2": (["wpc", "td3_bc", "wpc-exponential", "wpc-random"], TASKS),
    "figure4": (["wpc", "wpc-static"], ["walker2d-medium-v2"]),
}
STYLES = {
    # How each system is called and drawn: colours that the colour-blind can tell apart
    # (Okabe and Ito, 2008), and line styles for print.
    "wpc": ("wPC", "#0072B2", "-"),
    "td3_bc": ("TD3+BC", "#E69F00", "--"),
    "wbc": ("wBC", "#009E73", "-."),
    "wpc-exponential": ("wPC-e", "#CC79A7", (0, (6, 1, 1, 1, 1, 1))),
    "wpc-random": ("wPC-rnd", "#56B4E9", ":"),
    "wpc-static": ("static weight", "#D55E00", (0, (8, 2))),
}


@dataclass
class List:
    """Print the commands of an experiment, one a line."""

    experiment: Annotated[Literal["table1", "table2", "figure4"], tyro.conf.Positional]
    systems: list[str] = field(default_factory=list)
    """only these: wpc, td3_bc, wbc, wpc-exponential, wpc-random, wpc-static"""
    tasks: list[str] = field(default_factory=list)
    """only these, or others than the experiment's"""
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])
    """seeds of the runs"""
    max_timesteps: int = 1_000_000
    """training steps of a run"""
    runs: Path = Path("runs")
    """folder of the run folders, <system>__<task>__<seed>"""
    datasets: Path | None = None
    """folder with files such as halfcheetah_medium.hdf5, to be used for D4RL's"""
    extra: str = ""
    """further arguments of every command, such as --extra="--eval-freq 10000" """


@dataclass
class Report:
    """Write tables.md and figures from the run folders."""

    runs: Path = Path("runs")
    """folder of the run folders"""
    out: Path = Path("report")
    """folder to write to"""
    tasks: list[str] = field(default_factory=list)
    """only these"""


def list_commands(args):
    systems, tasks = EXPERIMENTS[args.experiment]
    unknown = set(args.systems) - set(STYLES)
    if unknown:
        names = ", ".join(sorted(unknown))
        sys.exit(f"unknown systems {names}, choose from {', '.join(STYLES)}")
    for task in args.tasks or tasks:
        for system in args.systems or systems:
            for seed in args.seeds:
                print(command(args, system, task, seed))


def command(args, system, task, seed):
    script, _, weight = system.partition("-")
    line = [sys.executable, f"{script}.py", "--env", task, "--seed", str(seed)]
    line += ["--max-timesteps", str(args.max_timesteps)]
    if args.datasets:
        name = task.removesuffix("-v2").replace("-", "_")
        line += ["--dataset", f"{args.datasets}/{name}.hdf5"]
    if weight:
        line += ["--weight", weight]
    line += [
        *shlex.split(args.extra),
        "--run-dir",
        f"{args.runs}/{system}__{task}__{seed}",
    ]
    return f"OMP_NUM_THREADS=1 {shlex.join(line)}"


def script_versions(run_dir):
    """The SHA-256 of each version of the script that a run was started with."""
    path = run_dir / "provenance.jsonl"
    if not path.exists():
        return {"unknown"}
    lines = path.read_text().splitlines()
    return {json.loads(line)["script_sha256"] for line in lines}


def read_runs(folder):
    """The columns of the run folders' evaluations.csv, arrays over evaluations, as
    {(system, task): {seed: {column: array}}}, the versions of the script that made them
    as {(system, task): {SHA-256}}, and what to call each task."""
    runs, versions, names = {}, {}, {}
    for path in sorted(folder.glob("*__*__*/evaluations.csv")):
        system, task, seed = path.parent.name.split("__")
        rows = list(csv.DictReader(path.open()))
        if not rows:
            print(f"{path.parent} has no evaluation yet and is left out")
            continue
        columns = {
            key: np.array([float(row[key] or "nan") for row in rows])
            for key in ("step", "normalized_score", "q")
        }
        runs.setdefault((system, task), {})[int(seed)] = columns
        versions.setdefault((system, task), set()).update(script_versions(path.parent))
        own_dataset = json.loads((path.parent / "args.json").read_text())["dataset"]
        short = task.removesuffix("-v2")
        names[task] = f"{short} (not D4RL's file)" if own_dataset else task
    return runs, versions, names


def mean_and_std(values):
    if not values:
        return "missing"
    if len(values) == 1:
        return f"{values[0]:.1f}"
    return f"{np.mean(values):.1f} ± {np.std(values, ddof=1):.1f}"


def paper_value(system, task):
    if system not in PAPER or task not in TASKS:
        return "-"
    return PAPER[system].split()[TASKS.index(task)]


def table(runs, names, systems, tasks):
    """A Markdown table: for each system its last evaluation, the mean of its last ten,
    the number of seeds and the paper's value."""
    header = ["task", "steps"]
    for system in systems:
        header += [f"{STYLES[system][0]}: last", "last ten", "seeds", "paper"]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for task in tasks:
        cells, steps = [], set()
        for system in systems:
            seeds = runs.get((system, task), {}).values()
            steps |= {int(columns["step"][-1]) for columns in seeds}
            scores = [columns["normalized_score"] for columns in seeds]
            cells += [mean_and_std([score[-1] for score in scores])]
            cells += [mean_and_std([score[-10:].mean() for score in scores])]
            cells += [str(len(scores)), paper_value(system, task)]
        steps = " to ".join(f"{step:,}" for step in sorted({min(steps), max(steps)}))
        lines.append("| " + " | ".join([names[task], steps, *cells]) + " |")
    return "\n".join([*lines, ""])


def draw_panel(axis, runs, systems, task, column):
    """The mean over seeds of a column, with a standard deviation on each side. Dotted:
    the score that the paper ends with."""
    for system in systems:
        seeds = list(runs.get((system, task), {}).values())
        if not seeds:
            continue
        label, color, line = STYLES[system]
        length = min(len(columns["step"]) for columns in seeds)
        steps = seeds[0]["step"][:length] / 1000
        values = np.stack([columns[column][:length] for columns in seeds])
        mean = values.mean(axis=0)
        axis.plot(
            steps, mean, linestyle=line, color=color, label=f"{label} ({len(seeds)})"
        )
        if len(seeds) > 1:
            std = values.std(axis=0, ddof=1)
            area = {"color": color, "alpha": 0.2, "linewidth": 0}
            axis.fill_between(steps, mean - std, mean + std, **area)
        if column == "q" and np.nanmax(mean) > 10_000:  # Q runs away
            axis.set_yscale("log")
        paper = paper_value(system, task)
        if column == "normalized_score" and paper != "-":
            axis.axhline(float(paper), linestyle=":", color=color, linewidth=1)
    axis.set_xlabel("training steps (thousands)")
    axis.grid(alpha=0.3)


def draw_figure(path, runs, names, systems, tasks, columns):
    """A panel for each task and column; nothing if no task has two of the systems."""
    tasks = [t for t in tasks if sum((s, t) in runs for s in systems) > 1]
    panels = [(task, column) for task in tasks for column in columns]
    if not panels:
        return
    labels = {"normalized_score": "normalized score", "q": "Q(s, a), mean over a batch"}
    width = min(len(panels), 3)
    height = -(-len(panels) // width)
    figure, axes = plt.subplots(
        height,
        width,
        figsize=(4.2 * width, 3.2 * height),
        squeeze=False,
        layout="constrained",
    )
    for axis, (task, column) in zip(axes.flat, panels, strict=False):
        draw_panel(axis, runs, systems, task, column)
        axis.set_title(names[task], fontsize="medium")
        axis.set_ylabel(labels[column])
        axis.legend(title="system (seeds)", fontsize="small", title_fontsize="small")
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def report(args):
    runs, versions, names = read_runs(args.runs)
    if args.tasks:
        names = {task: name for task, name in names.items() if task in args.tasks}
    if not names:
        sys.exit(
            f"{args.runs} holds no run folders <system>__<task>__<seed> with "
            "evaluations: run what `list` prints"
        )
    args.out.mkdir(parents=True, exist_ok=True)
    known = [task for task in TASKS if task in names]
    tasks = known + sorted(names.keys() - set(TASKS))
    text = [
        "Normalized scores, mean ± sample standard deviation (ddof = 1) over seeds: "
        "the last evaluation, and the mean of the last ten. The paper's values are "
        "from 5 seeds and 1,000,000 steps on D4RL's files.\n",
    ]
    for title in ("table1", "table2", "figure4"):
        systems, own_tasks = EXPERIMENTS[title]
        shown = [task for task in tasks if any((s, task) in runs for s in systems)]
        if title == "figure4":
            shown = [task for task in shown if task in own_tasks]
        if shown:
            heading = title.replace("e", "e ", 1).capitalize()
            text += [f"## {heading}\n", table(runs, names, systems, shown)]
    for (system, task), scripts in versions.items():
        if task in names and len(scripts) > 1:
            text.append(
                f"{STYLES[system][0]} on {names[task]}: its runs are of {len(scripts)} "
                "different versions of the script.\n"
            )
    (args.out / "tables.md").write_text("\n".join(text))

    def draw(name, systems, tasks, columns):
        draw_figure(args.out / name, runs, names, systems, tasks, columns)

    draw("figure2.png", EXPERIMENTS["table1"][0], tasks, ["normalized_score"])
    draw("figure3.png", EXPERIMENTS["table1"][0], tasks, ["q"])
    systems, own_tasks = EXPERIMENTS["figure4"]
    shown = [task for task in tasks if task in own_tasks]
    draw("figure4.png", systems, shown, ["q", "normalized_score"])
    others = {"wpc-exponential", "wpc-random"}
    shown = [task for task in tasks if any((s, task) in runs for s in others)]
    draw("figure5.png", EXPERIMENTS["table2"][0], shown, ["normalized_score"])
    print("\n".join(text) + f"\nwritten to {args.out}/")


if __name__ == "__main__":
    commands = {"list": List, "report": Report}
    args = tyro.extras.subcommand_cli_from_dict(commands, description=__doc__)
    list_commands(args) if isinstance(args, List) else report(args)
