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
import math
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
from scipy import stats

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
FIGURES = {  # of the paper, and what each shows of an experiment
    "table1": {"figure2.png": ["normalized_score"], "figure3.png": ["q"]},
    "table2": {"figure5.png": ["normalized_score"]},
    "figure4": {"figure4.png": ["q", "normalized_score"]},
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


def final_scores(runs, system, task):
    """The mean of the last ten evaluations of each seed, an array (seeds,)."""
    seeds = runs.get((system, task), {}).values()
    return np.array([columns["normalized_score"][-10:].mean() for columns in seeds])


def mean_and_std(scores):
    if len(scores) == 0:
        return "missing"
    if len(scores) == 1:
        return f"{scores[0]:.1f} (1)"
    return f"{scores.mean():.1f} ± {scores.std(ddof=1):.1f} ({len(scores)})"


def difference(scores, others):
    """The difference of two means and its standard error, bold where it is more than
    two of them."""
    if min(len(scores), len(others)) < 2:
        return "-"
    mean = scores.mean() - others.mean()
    error = np.hypot(stats.sem(scores), stats.sem(others))
    text = f"{mean:.1f} ± {error:.1f}"
    return f"**{text}**" if abs(mean) > 2 * error else text


def interquartile_mean(*tasks, axis=-1):
    return stats.trim_mean(np.concatenate(tasks, axis=axis), 0.25, axis=axis)


def interquartile_mean_and_interval(tasks):
    """The interquartile mean of all scores of some tasks, arrays (seeds,), and its 95%
    interval by the stratified bootstrap (Agarwal et al., NeurIPS 2021): the seeds of
    each task are drawn anew."""
    low, high = stats.bootstrap(
        tasks, interquartile_mean, method="percentile", n_resamples=20_000, rng=0
    ).confidence_interval
    return f"{interquartile_mean(*tasks):.1f} [{low:.1f}, {high:.1f}]"


def paper_value(system, task):
    if system not in PAPER or task not in TASKS:
        return "-"
    return PAPER[system].split()[TASKS.index(task)]


def markdown(header, rows):
    lines = [header, ["---"] * len(header), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def steps_of(runs, systems, task):
    """How long the runs of a task are, such as "10,000" or "10,000 to 20,000" steps."""
    last_steps = {
        int(columns["step"][-1])
        for system in systems
        for columns in runs.get((system, task), {}).values()
    }
    ends = sorted({min(last_steps), max(last_steps)})
    return " to ".join(f"{step:,}" for step in ends)


def tables(runs, names, systems, tasks):
    """Three tables in Markdown: our scores, the differences between the first system
    and the others, and the paper's scores."""
    labels = [STYLES[system][0] for system in systems]
    ours, differences, papers = [], [], []
    of_complete_tasks = []
    for task in tasks:
        scores = [final_scores(runs, system, task) for system in systems]
        steps = steps_of(runs, systems, task)
        ours.append([names[task], steps, *map(mean_and_std, scores)])
        first, *others = scores
        differences.append([names[task], *(difference(first, x) for x in others)])
        papers.append([task, *(paper_value(system, task) for system in systems)])
        if min(map(len, scores)) >= 3:
            of_complete_tasks.append(scores)
    if len(of_complete_tasks) > 1:
        by_system = zip(*of_complete_tasks, strict=True)
        cells = [interquartile_mean_and_interval(scores) for scores in by_system]
        title = f"interquartile mean of {len(of_complete_tasks)} tasks"
        ours.append([title, "", *cells])
    minus = [f"{labels[0]} - {label}" for label in labels[1:]]
    return [
        markdown(["task", "steps", *labels], ours),
        markdown(["task", *minus], differences),
        markdown(["the paper's", *labels], papers),
    ]


def versions_table(versions):
    """A Markdown table: the version of the script that each system's runs are of."""
    tasks = {}
    for (system, task), scripts in versions.items():
        for script in scripts:
            tasks.setdefault((system, script), []).append(task)
    rows = [
        [STYLES[system][0], script[:16], ", ".join(of_script)]
        for (system, script), of_script in sorted(tasks.items())
    ]
    return markdown(["system", "SHA-256 of its script", "tasks"], rows)


def draw_panel(axis, runs, systems, task, column):
    """The mean over seeds of a column, with a standard deviation on each side; where Q
    runs away, its median and range. Dotted: the score that the paper ends with."""
    labels = {
        "normalized_score": "normalized score",
        "q": "Q(s, a), mean over a batch",
    }
    axis.set_ylabel(labels[column])
    for system in systems:
        seeds = list(runs.get((system, task), {}).values())
        if not seeds:
            continue
        label, color, line = STYLES[system]
        length = min(len(columns["step"]) for columns in seeds)
        steps = seeds[0]["step"][:length] / 1000
        values = np.stack([columns[column][:length] for columns in seeds])
        mean = values.mean(axis=0)
        std = values.std(axis=0, ddof=1) if len(seeds) > 1 else 0
        middle, low, high = mean, mean - std, mean + std
        if column == "q" and values.max() > 10_000:  # Q runs away: seeds are far apart
            axis.set_yscale("log")
            middle, low, high = np.percentile(values, [50, 0, 100], axis=0)
        label = f"{label} ({len(seeds)})"
        axis.plot(steps, middle, linestyle=line, color=color, label=label)
        axis.fill_between(steps, low, high, color=color, alpha=0.2, linewidth=0)
        paper = paper_value(system, task)
        if column == "normalized_score" and paper != "-":
            axis.axhline(float(paper), linestyle=":", color=color, linewidth=1)
            axis.set_ylabel("normalized score (dotted: the paper's)")
    axis.set_xlabel("training steps (thousands)")
    axis.grid(alpha=0.3)


def draw_figure(path, runs, names, systems, tasks, columns):
    """A panel for each task and column; nothing if no task has two of the systems."""
    tasks = [t for t in tasks if sum((s, t) in runs for s in systems) > 1]
    panels = [(task, column) for task in tasks for column in columns]
    if not panels:
        return
    height = math.ceil(len(panels) / 3)
    width = math.ceil(len(panels) / height)
    figure, axes = plt.subplots(
        height,
        width,
        figsize=(4.4 * width, 4.0 * height),
        squeeze=False,
        layout="constrained",
    )
    for axis, (task, column) in zip(axes.flat, panels, strict=False):
        draw_panel(axis, runs, systems, task, column)
        axis.set_title(names[task], fontsize="medium")
        axis.legend(
            title="system (seeds)",
            fontsize="small",
            title_fontsize="small",
            frameon=False,
            ncols=3,
            loc="upper center",
            bbox_to_anchor=(0.5, -0.18),  # below the panel: over no curve
        )
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def shown_tasks(runs, systems, tasks):
    """The tasks of an experiment: those with a run of one of its systems or, where it
    compares weights, of one of the other weights."""
    weights = [system for system in systems if system.startswith("wpc-")]
    return [t for t in tasks if any((s, t) in runs for s in weights or systems)]


def report(args):
    runs, versions, names = read_runs(args.runs)
    if args.tasks:
        names = {task: name for task, name in names.items() if task in args.tasks}
    if not names:
        sys.exit(
            f"{args.runs} holds no run folders <system>__<task>__<seed> with "
            "evaluations: run what `list` prints"
        )
    versions = {key: scripts for key, scripts in versions.items() if key[1] in names}
    args.out.mkdir(parents=True, exist_ok=True)
    known = [task for task in TASKS if task in names]
    tasks = known + sorted(names.keys() - set(TASKS))
    text = [
        "Normalized scores on our data: the mean of the last ten evaluations, mean ± "
        "sample standard deviation over seeds (their number). The interquartile mean "
        "is over the runs of all tasks with three seeds of each system; in brackets, "
        "its 95% interval by a bootstrap that is stratified by task. Differences: ± "
        "their standard error, bold where they are more than two of these. The paper's "
        "scores are from D4RL's files, 1,000,000 steps and five seeds.\n",
    ]
    for experiment, (systems, _) in EXPERIMENTS.items():
        shown = shown_tasks(runs, systems, tasks)
        if not shown:
            continue
        heading = experiment.replace("e", "e ", 1).capitalize()
        text += [f"## {heading}\n", *tables(runs, names, systems, shown)]
        for figure, columns in FIGURES[experiment].items():
            draw_figure(args.out / figure, runs, names, systems, shown, columns)
    text += ["## Scripts\n", versions_table(versions)]
    for (system, task), scripts in versions.items():
        if len(scripts) > 1:
            text.append(
                f"{STYLES[system][0]} on {names[task]}: its runs are of {len(scripts)} "
                "different versions of the script.\n"
            )
    (args.out / "tables.md").write_text("\n".join(text))
    print("\n".join(text) + f"\nwritten to {args.out}/")


if __name__ == "__main__":
    commands = {"list": List, "report": Report}
    args = tyro.extras.subcommand_cli_from_dict(commands, description=__doc__)
    list_commands(args) if isinstance(args, List) else report(args)
