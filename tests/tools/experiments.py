# SPDX-License-Identifier: MIT
"""The paper's experiments: the commands to run, and a report on what they left.

    python tests/tools/experiments.py list table1 --runs runs/paper > commands.txt
    tr '\\n' '\\0' < commands.txt | xargs -0 -n 1 -P 2 sh -c
    python tests/tools/experiments.py report --runs runs/paper --out report

`list` starts nothing; table2 and figure4 need copies of wpc.py with other weights, such
as wpc_random.py, which tests/tools/weights.py writes. The second line, in the activated
environment, runs what it lists, two at a time, and continues what was interrupted. With
a GPU, tests/tools/together.py trains many of these runs at once. `report` reads every
run folder below --runs, whatever its name.
"""

import csv
import functools
import importlib
import itertools
import json
import math
import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from PIL import Image
from scipy import stats

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))  # the scripts know their defaults
TASKS = [
    f"{robot}-{kind}"
    for kind in ("random", "medium", "medium-replay", "medium-expert")
    for robot in ("halfcheetah", "hopper", "walker2d")
]
PUBLISHED = {
    # Tables 1 and 2 of the paper, task by task: D4RL's files, five seeds, 1,000,000
    # steps. CORL's are the last scores of Tarasov et al. (NeurIPS 2023).
    "wPC, paper": "19.6 19.9 0.7 53.3 86.5 86.0 48.3 97.0 89.9 93.7 95.7 110.1",
    "TD3+BC, paper": "11.7 8.6 0.9 48.2 57.7 83.2 44.6 67.4 83.7 90.7 106.1 110.1",
    "TD3+BC, CORL": "- - - 48.1 60.4 82.7 44.8 64.4 85.6 90.8 101.2 110.0",
    "wBC, paper": "2.2 10.5 12.1 45.6 64.2 81.0 41.1 86.6 61.2 92.5 105.8 109.9",
    "BC, paper": "2.3 4.8 1.7 42.6 52.9 75.3 36.6 18.1 26.0 55.2 52.5 107.5",
    "BC, CORL": "- - - 42.4 53.5 63.2 35.7 29.8 21.8 56.0 52.3 99.0",
    "wPC-e, paper": "16.0 9.1 4.4 48.6 67.0 83.8 44.6 88.9 85.6 91.5 103.0 110.2",
    "wPC-rnd, paper": "15.5 7.9 0.2 50.5 66.5 59.3 47.0 78.5 77.1 75.0 59.6 103.1",
}
SYSTEMS = {
    # How each is drawn: colours that the colour-blind can tell apart (Okabe and Ito,
    # 2008), and line styles for print
    "wPC": ("#0072B2", "-"),
    "TD3+BC": ("#E69F00", "--"),
    "wBC": ("#009E73", "-."),
    "BC": ("#000000", ":"),
    "wPC-e": ("#CC79A7", (0, (6, 1, 1, 1, 1, 1))),
    "wPC-rnd": ("#56B4E9", ":"),
    "static weight": ("#D55E00", (0, (8, 2))),
}
OUR_DATA = {
    "random": "of uniform actions",
    "medium": "of D4RL's policy",
    "medium-replay": "of our SAC agent",
    "hopper-medium-replay": "of our SAC agent; D4RL's file has 402,000",
    "medium-expert": "of D4RL's medium policy and an expert that is not D4RL's",
}
COMPARED = ["wPC", "TD3+BC", "wBC"]
OF_WEIGHTS = {"exponential": "wPC-e", "random": "wPC-rnd", "static": "static weight"}
NOT_COMPARED = "env dataset seed max_timesteps eval_freq eval_episodes device run_dir"
EXPERIMENTS = {  # the scripts with what tells their runs apart, and the tasks
    "table1": ("wpc td3_bc wbc", TASKS),
    "table2": ("wpc td3_bc wpc_exponential wpc_random", TASKS),
    "figure4": ("wpc wpc_static", ["walker2d-medium"]),
    "runaway": (
        "wpc wpc--alpha=1.0 wpc--alpha=0.5 wpc--alpha=0.1",
        ["walker2d-medium"],
    ),
}


def list_commands(
    experiment: tyro.conf.Positional[Literal["table1", "table2", "figure4", "runaway"]],
    runs: Path = Path("runs"),
    datasets: Path | None = None,
    seeds: int = 5,
    compiled: bool = False,
):
    """Print the commands of an experiment, one a line.

    Args:
        experiment: a table or figure of the paper, or "When does Q run away?"
        runs: folder of the run folders
        datasets: folder with files such as halfcheetah_medium.hdf5, used for D4RL's
        seeds: number of seeds
        compiled: run the scripts by tests/tools/compiled.py
    """
    systems, tasks = EXPERIMENTS[experiment]
    for task, system, seed in itertools.product(tasks, systems.split(), range(seeds)):
        script, *option = system.split("--")
        line = ["python", *["tests/tools/compiled.py"] * compiled, f"{script}.py"]
        line += ["--env", f"{task}-v2", "--seed", str(seed)]
        if datasets:
            line += ["--dataset", f"{datasets}/{task.replace('-', '_')}.hdf5"]
        line += ["--max-timesteps", "1000000", "--eval-freq", "10000"]
        line += [f"--{x}" for x in option]
        name = f"{task}__{re.sub('[-=]+', '-', system)}__{seed}"
        print(shlex.join([*line, "--run-dir", f"{runs}/{name}"]))


# --- The runs -------------------------------------------------------------------------


@dataclass(eq=False)
class Group:
    """The runs of a system on a task, one a seed, at the steps that all of them have:
    arrays (seeds, evaluations), and `steps` (evaluations,)."""

    task: str
    system: str
    others: str  # arguments that are not the system's own, such as "alpha 1.0"
    alpha: float | None
    best_return: float
    steps: np.ndarray
    scores: np.ndarray
    q: np.ndarray

    def last_ten(self, steps=None):
        """Each seed's mean of the last ten scores, at these steps alone: (seeds,)."""
        among = np.isin(self.steps, self.steps if steps is None else steps)
        return self.scores[:, among][:, -10:].mean(axis=1)

    @property
    def data(self):
        """What tells one dataset of a task from another."""
        return f"{self.best_return:.1f}"

    @property
    def size(self):
        return f"{len(self.scores)}; {self.steps[-1] / 1000:,g}k"

    @property
    def score(self):
        return f"{mean_and_std(self.last_ten())} ({self.size})"


def read_run(folder):
    """What the report needs of a run; a ValueError says why it is of no use."""
    args = json.loads((folder / "args.json").read_text())
    rows = list(csv.DictReader((folder / "evaluations.csv").open()))
    rows = [row for row in rows if float(row["step"])]  # at 0, nothing is trained yet
    if len(rows) < 10:
        raise ValueError(f"{len(rows)} evaluations, ten are needed")
    if any(None in row or None in row.values() for row in rows):
        raise ValueError("evaluations.csv has a row that is too short or too long")
    score = "normalized_score" if "normalized_score" in rows[0] else "mean_return"
    run = {
        name: np.array([float(row.get(name) or "nan") for row in rows])
        for name in ("step", score, "q", "best_discounted_return")
    }
    run["score"] = run.pop(score)
    if not np.isfinite(run["score"]).all() or not (np.diff(run["step"]) > 0).all():
        raise ValueError("evaluations.csv lacks scores, or its steps do not increase")

    task = Path(args["dataset"] or args["env"]).stem.replace("_", "-")
    task = task.removesuffix("-v2") + " (mean return)" * (score == "mean_return")
    if "value_lr" not in args:
        script, system = "td3_bc", "TD3+BC" if args["alpha"] else "BC"
    elif "alpha" not in args:
        script, system = "wbc", "wBC"
    else:
        script, system = "wpc", OF_WEIGHTS.get(args.get("weight"), "wPC")
    env = "hopper-medium-expert-v2" if "medium-expert" in task else "hopper-medium-v2"
    defaults = vars(importlib.import_module(script).Args(env=env, dataset="-"))
    if system == "BC":
        defaults["alpha"] = 0
    if system == "wPC":
        defaults["weight"] = "binary"
    others = ", ".join(
        f"{name} {args[name]}"
        for name, default in defaults.items()
        if args.get(name, default) != default and name not in NOT_COMPARED.split()
    )
    run |= {"key": (task, system, others), "folder": folder}
    return run | {"seed": args["seed"], "alpha": args.get("alpha")}


def read_runs(folder):
    """The runs by (task, system, other arguments) and seed, the longest of each seed.
    Says on stdout what does not count, and why."""
    runs, by_key = [], {}
    for path in sorted(folder.rglob("evaluations.csv")):
        try:
            runs.append(read_run(path.parent))
        except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
            print(f"passed over: {path.parent} ({type(error).__name__}: {error})")
    for run in sorted(runs, key=lambda run: -run["step"][-1]):
        kept = by_key.setdefault(run["key"], {}).setdefault(run["seed"], run)
        if kept is not run:
            print(f"passed over: {run['folder']} ({kept['folder']} is of its seed)")
    return by_key


def read_groups(folder):
    """The groups of runs by (task, system, other arguments), in the paper's order."""

    def in_order(item):
        task, system, others = item[0]
        place = TASKS.index(task) if task in TASKS else len(TASKS)
        return place, task, list(SYSTEMS).index(system), others

    groups = {}
    for key, seeds in sorted(read_runs(folder).items(), key=in_order):
        runs = [seeds[seed] for seed in sorted(seeds)]
        data = {f"{run['best_discounted_return'][-1]:.1f}" for run in runs}
        steps = functools.reduce(np.intersect1d, [run["step"] for run in runs])
        if len(data) > 1 or len(steps) < 10:
            best = " and ".join(sorted(data))
            print(
                f"passed over: {key} (its runs share {len(steps)} evaluations, on data "
                f"with best returns of {best})"
            )
            continue
        scores, q = (
            np.stack([run[name][np.isin(run["step"], steps)] for run in runs])
            for name in ("score", "q")
        )
        alpha, best_return = runs[0]["alpha"], runs[0]["best_discounted_return"][-1]
        groups[key] = Group(*key, alpha, best_return, steps, scores, q)
    return groups


# --- The tables -----------------------------------------------------------------------


def markdown(header, rows):
    lines = [header, ["---"] * len(header), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines) if rows else ""


def mean_and_std(values):
    std = f" ± {values.std(ddof=1):.1f}" if len(values) > 1 else ""
    return f"{values.mean():.1f}{std}"


def published(source, task):
    """A score such as the one of "wPC, paper"; "-" if there is none."""
    scores = dict(zip(TASKS, PUBLISHED.get(source, "").split(), strict=False))
    return scores.get(task, "-")


def known_data(groups):
    """By task, the row of datasets.csv on the data trained on, if it has one."""
    best = {group.task: group.data for group in groups.values() if not group.others}
    with (ROOT / "tests/results/datasets.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {x["task"]: x for x in rows if best.get(x["task"]) == x["best_return"]}


def score_table(groups, tasks, systems):
    """Our scores, beside them those that were published, and whose data are ours."""
    header, rows, data = ["task", "data's score"], [], known_data(groups)
    for system in systems:
        header.append(system)
        header += [source for source in PUBLISHED if source.startswith(f"{system},")]
    for task in tasks:
        row, whose = [task, "-"], "-"
        if task in data:
            row[1], count = data[task]["mean_score"], int(data[task]["transitions"])
            kind = task.partition("-")[2]
            whose = f"{count:,}, {OUR_DATA.get(task, OUR_DATA.get(kind, 'own'))}"
        for name in header[2:]:
            group = groups.get((task, name, ""))
            row.append(group.score if group else published(name, task))
        rows.append([*row, whose])
    return markdown([*header, "whose data"], rows)


def difference(group, other):
    """The difference of two groups' means, its 95% interval and p by Welch's t test."""
    if not group or not other or min(len(group.scores), len(other.scores)) < 2:
        return "-"
    steps = np.intersect1d(group.steps, other.steps)
    if len(steps) < 10 or group.data != other.data:
        return "-"
    ours, theirs = group.last_ten(steps), other.last_ten(steps)
    test = stats.ttest_ind(ours, theirs, equal_var=False)
    low, high = test.confidence_interval()
    text = f"{ours.mean() - theirs.mean():.1f} [{low:.1f}, {high:.1f}]"
    size = f"{len(ours)}, {len(theirs)}; {steps[-1] / 1000:,g}k"
    return f"{text}, p = {test.pvalue:.2g} ({size})"


def difference_table(groups, tasks, systems):
    first, *others = systems
    rows = []
    for task in tasks:
        group, *rest = (groups.get((task, system, "")) for system in systems)
        rows.append([task, *(difference(group, other) for other in rest)])
    rows = [row for row in rows if set(row[1:]) != {"-"}]
    return markdown(["task", *(f"{first} - {other}" for other in others)], rows)


def totals_table(groups, systems):
    """Sums over the tasks of Table 1 that a system has runs on, ours and published."""
    rows = []
    for system in systems:
        tasks = [task for task in TASKS if (task, system, "") in groups]
        ours = sum(groups[task, system, ""].last_ten().mean() for task in tasks)
        row = [system, str(len(tasks)), f"{ours:.1f}"]
        for source, summed in (("paper", tasks), ("CORL", tasks), ("paper", TASKS)):
            scores = [published(f"{system}, {source}", task) for task in summed]
            row.append("-" if "-" in scores else f"{sum(map(float, scores)):.1f}")
        if tasks:
            rows.append(row)
    header = ["system", "tasks", "these runs", "paper", "CORL", "paper, all twelve"]
    return markdown(header, rows)


def span(values, form):
    low, high = format(min(values), form), format(max(values), form)
    return low if low == high else f"{low} to {high}"


def q_table(groups):
    """Q over the data's best discounted return."""
    header = "task, system, arguments, seeds; steps, Q at the end, largest Q, at step"
    header = [*header.split(", "), "seeds over 1", "back", "score"]
    rows = []
    for group in groups.values():
        arguments = group.others or (f"alpha {group.alpha}" if group.alpha else "")
        row, cells = [group.task, group.system, arguments, group.size], ["-"] * 5
        if group.best_return > 0:
            ratio = group.q / group.best_return
            end, largest = ratio[:, -10:].mean(axis=1), ratio.max(axis=1)
            steps, over = group.steps[ratio.argmax(axis=1)], largest > 1
            cells = [span(end, ".2f"), span(largest, ".2f"), span(steps, ",.0f")]
            cells += [str(over.sum()), str((over & (ratio[:, -1] < 1)).sum())]
        rows.append([*row, *cells, mean_and_std(group.last_ten())])
    return markdown(header, rows)


def published_curve(task):
    """Others' evaluations of TD3+BC on D4RL's own file of a task; empty for others."""
    path = ROOT / "tests/results/td3_bc_on_d4rl.csv"
    options = {"delimiter": ",", "dtype": None, "encoding": "utf-8"}
    curves = np.genfromtxt(path, names=True, skip_header=4, **options)
    return curves[curves["task"] == task]


def reproduction_table(pairs):
    """TD3+BC's mean score over all evaluations, here and on D4RL's files."""
    rows = []
    for group, curve in pairs:
        _, i, j = np.intersect1d(group.steps, curve["step"], return_indices=True)
        ours = group.scores[:, i].mean(axis=1)
        theirs, std, p = curve["mean"][j].mean(), curve["average_std"][j[-1]], "-"
        if len(ours) > 1:
            both = ours.mean(), ours.std(ddof=1), len(ours), theirs, std, 5
            p = f"{stats.ttest_ind_from_stats(*both, equal_var=False).pvalue:.2g}"
        row = [group.task, f"{mean_and_std(ours)} ({group.size})"]
        rows.append([*row, f"{theirs:.1f} ± {std:.1f} (5)", p])
    return markdown(["task", "these runs", "on D4RL's files", "p"], rows)


# --- The figures ----------------------------------------------------------------------


def band(values):
    """The lowest, mean and highest of some seeds' values (seeds, evaluations)."""
    return values.min(axis=0), values.mean(axis=0), values.max(axis=0)


def panel(groups, task, systems, column):
    """A task's scores with the paper's dotted, or its Q with the best return dashed."""
    shown = [groups[task, s, ""] for s in systems if (task, s, "") in groups]
    curves = [
        (group.system, SYSTEMS[group.system], group.steps, band(getattr(group, column)))
        for group in shown
    ]
    if column == "q":
        levels = [(shown[0].best_return, "black", "--")]
        return task, "Q (dashed: best return)", curves, levels
    papers = [(published(f"{x.system}, paper", task), x.system) for x in shown]
    levels = [(float(score), SYSTEMS[s][0], ":") for score, s in papers if score != "-"]
    return task, "score (dotted: the paper's)", curves, levels


def reproduction_panel(group, curve):
    theirs = curve["step"], [curve[name] for name in ("min", "mean", "max")]
    curves = [("on D4RL's own files (five seeds)", ("#555555", "-"), *theirs)]
    ours = ("TD3+BC, these runs", SYSTEMS["TD3+BC"], group.steps, band(group.scores))
    return group.task, "score", [*curves, ours], []


def draw(path, panels):
    """A figure of panels (title, label of the y axis, curves, horizontal lines)."""
    height = math.ceil(len(panels) / 3)
    width = math.ceil(len(panels) / height)
    size = 3.6 * width, 2.9 * height + 0.6
    figure, axes = plt.subplots(
        height, width, figsize=size, squeeze=False, layout="constrained"
    )
    handles = {}
    for axis, (title, ylabel, curves, levels) in zip(axes.flat, panels, strict=False):
        for label, (color, line), steps, (low, middle, high) in curves:
            (handle,) = axis.plot(steps / 1000, middle, linestyle=line, color=color)
            axis.fill_between(steps / 1000, low, high, color=color, alpha=0.2, lw=0)
            handles.setdefault(label, handle)
            if ylabel.startswith("Q") and high.max() > 10 * levels[0][0] > 0:
                axis.set_yscale("log")
        for level, color, line in levels:
            axis.axhline(level, color=color, linestyle=line, linewidth=1)
            axis.update_datalim([(0, level)], updatex=False)  # with a margin
        axis.autoscale_view()
        axis.set(title=title, xlabel="training steps (thousands)", ylabel=ylabel)
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    figure.legend(
        handles.values(),
        handles,
        title="mean over seeds, and their range",
        loc="outside lower center",
        ncols=len(handles) if width > 1 else 1,
        frameon=False,
    )
    figure.savefig(path, dpi=130)
    Image.open(path).convert("RGB").quantize(64).save(path)  # a third of the size
    plt.close(figure)
    print(f"wrote {path}")


# --- The report -----------------------------------------------------------------------

INTRODUCTION = """\
Scores are D4RL's normalized ones, or returns where a task is called "(mean return)". A
score is the mean of a run's last ten evaluations; over seeds: mean ± sample standard
deviation (seeds; training steps). What the paper and CORL have published is of D4RL's
own files. The data's score is the mean of the episodes trained on; "whose data" gives
the number of transitions and whom they are of, where the report knows it
(tests/results/datasets.csv). Runs whose arguments differ from the scripts' defaults are
in the table on Q alone.
"""
NOTES = {
    "Differences": "Mean, 95% interval and p of Welch's t test, not corrected for "
    "the number of tests (seeds of each; steps).",
    "Totals": "Over the tasks of Table 1 on which a system has runs here, which are "
    "not the same for all systems; beside them what is published for the same tasks. "
    "(Of all twelve, the paper prints 711.4 for wBC, but its scores add up to 712.7.)",
    "When does Q run away?": "Q (its mean over a batch) divided by the best discounted "
    "return-to-go of the data, from the lowest to the highest seed: the mean "
    "of the last ten evaluations, the largest and its step; how many seeds had it over "
    "1, and with how many of these it was below at the last step.",
    "TD3+BC here and on D4RL's files": "Mean score of all evaluations to this step, "
    "and Welch's p. The published curves are tests/results/td3_bc_on_d4rl.csv.",
}


def report(runs: Path = Path("runs"), out: Path = Path("report")):
    """Write tables.md and figures from the run folders.

    Args:
        runs: folder to search for run folders
        out: folder to write to
    """
    groups = read_groups(runs)
    if not groups:
        sys.exit(f"{runs} holds no run with ten evaluations: run what `list` prints")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        sys.exit(f"--out can't be written: {error}")

    def tasks_of(*systems, at_least=1):
        tasks = dict.fromkeys(task for task, _, _ in groups)
        count = {t: sum((t, s, "") in groups for s in systems) for t in tasks}
        return [task for task in tasks if count[task] >= at_least]

    td3_bc = (groups[task, "TD3+BC", ""] for task in tasks_of("TD3+BC"))
    pairs = [(group, published_curve(group.task)) for group in td3_bc]
    pairs = [pair for pair in pairs if np.isin(pair[0].steps, pair[1]["step"]).any()]
    all_tasks = tasks_of(*COMPARED, "BC")
    if set(all_tasks) & set(TASKS):
        all_tasks = list(dict.fromkeys([*TASKS, *all_tasks]))
    table_1, weights = [*COMPARED, "BC"], ["wPC", "TD3+BC", *OF_WEIGHTS.values()]
    others = tasks_of(*OF_WEIGHTS.values())
    tables = {
        "Table 1": score_table(groups, all_tasks, table_1),
        "Totals": totals_table(groups, table_1),
        "Differences": difference_table(groups, tasks_of(*COMPARED), COMPARED),
        "Other weights (Table 2, Figure 4)": score_table(groups, others, weights),
        "Differences to other weights": difference_table(
            groups, others, ["wPC", *OF_WEIGHTS.values()]
        ),
        "When does Q run away?": q_table(groups),
        "TD3+BC here and on D4RL's files": reproduction_table(pairs),
    }
    text = INTRODUCTION
    for title, table in tables.items():
        if table:
            note = f"{NOTES[title]}\n\n" if title in NOTES else ""
            text += f"\n## {title}\n\n{note}{table}"
    (out / "tables.md").write_text(text)
    print(f"{text}\nwrote {out / 'tables.md'}")

    def panels(tasks, systems, *columns):
        pairs = itertools.product(tasks, columns)
        return [panel(groups, task, systems, column) for task, column in pairs]

    static = tasks_of("static weight")
    figures = {
        "figure2": panels(tasks_of(*COMPARED), COMPARED, "scores"),
        "figure3": panels(tasks_of(*COMPARED, at_least=2), COMPARED, "q"),
        "figure4": panels(static, ["wPC", "static weight"], "q", "scores"),
        "figure5": panels(tasks_of("wPC-e", "wPC-rnd"), weights[:4], "scores"),
        "reproduction": [reproduction_panel(*pair) for pair in pairs],
    }
    for name, drawn in figures.items():
        if drawn:
            draw(out / f"{name}.png", drawn)


def main(arguments=None):
    commands = {"list": list_commands, "report": report}
    tyro.extras.subcommand_cli_from_dict(commands, description=__doc__, args=arguments)


if __name__ == "__main__":
    main()
