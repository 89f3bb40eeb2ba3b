# SPDX-License-Identifier: MIT
"""The paper's experiments: lists the commands of one, which a scheduler runs, and reports what they left.

    python tests/experiments.py list table1 --runs runs/paper | xargs -P 2 -I{} sh -c "{}"
    python tests/experiments.py report --runs runs/paper --out report

`list` prints a command a line and starts nothing; run the list again and what was interrupted goes on. `report` writes
tables.md (mean and sample standard deviation, ddof = 1, over seeds) and the Figures 2 to 5 that the runs can show.
"""

import csv
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

ROBOTS, KINDS = ("halfcheetah", "hopper", "walker2d"), ("random", "medium", "medium-replay", "medium-expert")
TASKS = [f"{robot}-{kind}-v2" for kind in KINDS for robot in ROBOTS]
# Table 1 and Table 2 of the paper, 5 seeds of 1,000,000 steps on D4RL's own files
PAPER = {
    "td3_bc": [11.7, 8.6, 0.9, 48.2, 57.7, 83.2, 44.6, 67.4, 83.7, 90.7, 106.1, 110.1],
    "wbc": [2.2, 10.5, 12.1, 45.6, 64.2, 81.0, 41.1, 86.6, 61.2, 92.5, 105.8, 109.9],
    "wpc-exponential": [16.0, 9.1, 4.4, 48.6, 67.0, 83.8, 44.6, 88.9, 85.6, 91.5, 103.0, 110.2],
    "wpc-random": [15.5, 7.9, 0.2, 50.5, 66.5, 59.3, 47.0, 78.5, 77.1, 75.0, 59.6, 103.1],
    "wpc": [19.6, 19.9, 0.7, 53.3, 86.5, 86.0, 48.3, 97.0, 89.9, 93.7, 95.7, 110.1],
}
EXPERIMENTS = {  # systems, tasks
    "table1": (["wpc", "td3_bc", "wbc"], TASKS),
    "table2": (["wpc", "td3_bc", "wpc-exponential", "wpc-random"], TASKS),
    "figure4": (["wpc", "wpc-static"], ["walker2d-medium-v2"]),
}
LABELS = {
    "wpc": "wPC",
    "td3_bc": "TD3+BC",
    "wbc": "wBC",
    "wpc-exponential": "wPC-e",
    "wpc-random": "wPC-rnd",
    "wpc-static": "static weight",
}
# Colours that the colour-blind tell apart (Okabe and Ito, 2008), and line styles for print
COLORS, LINES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00"), ("-", "--", "-.", (0, (6, 1, 1, 1, 1, 1)), ":", (0, (8, 2)))
STYLES = dict(zip(LABELS, zip(COLORS, LINES)))


@dataclass
class List:
    """Print the commands of an experiment, one a line."""

    experiment: Annotated[Literal["table1", "table2", "figure4"], tyro.conf.Positional]
    systems: list[str] = field(default_factory=list)  # only these: wpc, td3_bc, wbc, wpc-exponential, ...
    tasks: list[str] = field(default_factory=list)  # only these, or others than the experiment's
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])
    max_timesteps: int = 1_000_000
    runs: Path = Path("runs")  # folder of the run folders, <system>__<task>__<seed>
    datasets: Path | None = None  # folder of <task>.hdf5 files to use for D4RL's, such as halfcheetah_medium.hdf5
    extra: str = ""  # further arguments of every command, such as --extra="--eval-freq 10000"


@dataclass
class Report:
    """Write tables.md and figures from the run folders."""

    runs: Path = Path("runs")  # folder of the run folders
    out: Path = Path("report")  # folder to write to


def list_commands(args):
    systems, tasks = EXPERIMENTS[args.experiment]
    if unknown := set(args.systems) - set(LABELS):
        sys.exit(f"unknown systems {', '.join(sorted(unknown))}, choose from {', '.join(LABELS)}")
    for task in args.tasks or tasks:
        for system in args.systems or systems:
            for seed in args.seeds:
                script, _, weight = system.partition("-")
                line = f"OMP_NUM_THREADS=1 {sys.executable} {script}.py --env {task} --seed {seed} --max-timesteps {args.max_timesteps}"
                if args.datasets:
                    line += f" --dataset {args.datasets}/{task.removesuffix('-v2').replace('-', '_')}.hdf5"
                line += f" --weight {weight}" if weight else ""
                line += f" {args.extra}" if args.extra else ""
                print(f"{line} --run-dir {args.runs}/{system}__{task}__{seed}")


def read_runs(folder):
    """{(system, task): {seed: {column: array over evaluations}}} of all run folders, and {task: what to call it}."""
    runs, names = {}, {}
    for path in sorted(folder.glob("*__*__*/evaluations.csv")):
        system, task, seed = path.parent.name.split("__")
        rows = list(csv.DictReader(path.open()))
        columns = {key: np.array([float(row[key] or "nan") for row in rows]) for key in rows[0] if key != "returns"}
        runs.setdefault((system, task), {})[int(seed)] = columns
        own = json.loads((path.parent / "args.json").read_text())["dataset"]
        names[task] = f"{task.removesuffix('-v2')} (not D4RL's file)" if own else task
    return runs, names


def cell(values):
    return f"{np.mean(values):.1f}" + (f" ± {np.std(values, ddof=1):.1f}" if len(values) > 1 else "")


def table(runs, names, systems, tasks):
    """A Markdown table: steps, and for each system the last evaluation, the mean of the last ten, seeds, the paper's value."""
    lines = ["| task | steps | " + " | ".join(f"{LABELS[s]}: last | last ten | seeds | paper" for s in systems) + " |"]
    lines.append("|" + "---|" * (2 + 4 * len(systems)))
    sums = {}
    for task in tasks:
        steps = {int(c["step"][-1]) for system in systems for c in runs.get((system, task), {}).values()}
        cells = [names[task], " to ".join(f"{step:,}" for step in sorted({min(steps), max(steps)}))]
        for system in systems:
            seeds = runs.get((system, task), {}).values()
            paper = PAPER[system][TASKS.index(task)] if system in PAPER and task in TASKS else None
            last, ten = [c["score"][-1] for c in seeds], [c["score"][-10:].mean() for c in seeds]
            cells += [cell(last), cell(ten)] if last else ["missing", "missing"]
            cells += [str(len(last)), "–" if paper is None else str(paper)]
            for i, values in enumerate((last, ten, [] if paper is None else [paper])):
                sums.setdefault((system, i), []).append(np.mean(values) if values else np.nan)
        lines.append("| " + " | ".join(cells) + " |")
    total = ["total", ""]
    for system in systems:
        values = ["missing" if np.isnan(sums[system, i]).any() else f"{sum(sums[system, i]):.1f}" for i in range(3)]
        total += [values[0], values[1], "", values[2]]
    return "\n".join([*lines, "| " + " | ".join(total) + " |", ""])


def panel(axis, runs, systems, task, column):
    """The mean over seeds of one quantity, with one standard deviation, against training steps in thousands."""
    for system in systems:
        if seeds := list(runs.get((system, task), {}).values()):
            length = min(len(c["step"]) for c in seeds)
            steps, values = seeds[0]["step"][:length] / 1000, np.stack([c[column][:length] for c in seeds])
            mean, (color, line) = values.mean(0), STYLES[system]
            axis.plot(steps, mean, linestyle=line, color=color, label=f"{LABELS[system]} ({len(seeds)})")
            if len(seeds) > 1:
                spread = values.std(0, ddof=1)
                axis.fill_between(steps, mean - spread, mean + spread, color=color, alpha=0.2, linewidth=0)
            if column == "q" and np.nanmax(mean) > 10_000:  # Q runs away
                axis.set_yscale("log")
    axis.set_xlabel("training steps (thousands)")
    axis.grid(alpha=0.3)


def figure(path, runs, names, systems, tasks, columns):
    """One panel a task and column; nothing where no two of the systems have run on one of the tasks."""
    tasks = [t for t in tasks if sum((s, t) in runs for s in systems) > 1]
    if not tasks:
        return
    labels = {"score": "normalized score", "q": "Q1(s, a), mean over the batch"}
    panels = [(task, column) for task in tasks for column in columns]
    width = min(len(panels), 3)
    height = -(-len(panels) // width)
    fig, axes = plt.subplots(height, width, figsize=(4.2 * width, 3.2 * height), squeeze=False, layout="constrained")
    for axis, (task, column) in zip(axes.flat, panels):
        panel(axis, runs, systems, task, column)
        axis.set_title(names[task], fontsize="medium")
        axis.set_ylabel(labels[column])
        axis.legend(title="system (seeds)", fontsize="small", title_fontsize="small")
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    fig.savefig(path, dpi=130)
    plt.close(fig)


def report(args):
    runs, names = read_runs(args.runs)
    if not runs:
        sys.exit(f"{args.runs} holds no run folders named <system>__<task>__<seed>: run what `list` prints")
    args.out.mkdir(parents=True, exist_ok=True)
    tasks = [task for task in TASKS if task in names] + sorted(names.keys() - set(TASKS))
    text = [
        "Normalized scores, mean ± sample standard deviation (ddof = 1) over seeds: the last evaluation, and the mean of the "
        "last ten. Steps are those that each run has done. The paper's values: 5 seeds, 1,000,000 steps, D4RL's files.\n"
    ]
    for title, experiment in (("Table 1", "table1"), ("Table 2", "table2"), ("Figure 4", "figure4")):
        systems, own = EXPERIMENTS[experiment]
        shown = [t for t in tasks if any((s, t) in runs for s in systems) and (t in own or experiment != "figure4")]
        text += [f"## {title}\n", table(runs, names, systems, shown)] if shown else []
    (args.out / "tables.md").write_text("\n".join(text))
    figure(args.out / "figure2.png", runs, names, EXPERIMENTS["table1"][0], tasks, ["score"])
    figure(args.out / "figure3.png", runs, names, EXPERIMENTS["table1"][0], tasks, ["q"])
    figure(args.out / "figure4.png", runs, names, EXPERIMENTS["figure4"][0], EXPERIMENTS["figure4"][1], ["q", "score"])
    rivals = [t for t in tasks if any((s, t) in runs for s in ("wpc-exponential", "wpc-random"))]
    figure(args.out / "figure5.png", runs, names, EXPERIMENTS["table2"][0], rivals, ["score"])
    print("\n".join(text) + f"\nwritten to {args.out}/")


if __name__ == "__main__":
    args = tyro.extras.subcommand_cli_from_dict({"list": List, "report": Report}, description=__doc__)
    list_commands(args) if isinstance(args, List) else report(args)
