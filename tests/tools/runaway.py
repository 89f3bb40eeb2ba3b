# SPDX-License-Identifier: MIT
"""When does Q run away? Q over the dataset's best discounted return, run by run.

    python tests/tools/runaway.py --runs tests/results/runaway

The folder holds run folders <dataset>/<anything>/<run>; the runs on a dataset that have
the same alpha are its seeds. Writes table.md and figure.png beside them.
"""

import csv
import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tyro
from experiments import markdown

THRESHOLD = 1.2  # that of the scripts' warning


@dataclass
class Args:
    runs: Path
    """folder of the run folders"""


def best_discounted_return(run_dir):
    """That of the run's dataset, as the run's first start recorded it."""
    first_start, *_ = (run_dir / "provenance.jsonl").read_text().splitlines()
    return json.loads(first_start)["best_discounted_return"]


def read_runs(folder):
    """The runs of a folder by dataset and alpha, each run as its steps, Q over the best
    discounted return, and scores: arrays (evaluations,)."""
    runs = {}
    for path in sorted(folder.glob("*/*/*/evaluations.csv")):
        run_dir = path.parent
        rows = list(csv.DictReader(path.open()))
        steps, q, scores = (
            np.array([float(row[column]) for row in rows])
            for column in ("step", "q", "normalized_score")
        )
        ratios = q / best_discounted_return(run_dir)
        alpha = json.loads((run_dir / "args.json").read_text())["alpha"]
        key = run_dir.parts[-3], alpha
        runs.setdefault(key, []).append((steps, ratios, scores))
    return dict(sorted(runs.items()))


def first_over(steps, ratios):
    """The first evaluation with Q over the threshold, such as "20,000"."""
    over = steps[ratios > THRESHOLD]
    return f"{over[0]:,.0f}" if len(over) else "never"


def table(runs):
    """A Markdown table: a row for each dataset and alpha, the seeds side by side. The
    mean of the last ten evaluations is that of all where there are fewer."""
    over = f"over {THRESHOLD} from"
    header = ["dataset", "alpha", "steps", "Q / best return", over]
    header += ["last score", "mean of last ten"]
    rows = []
    for (dataset, alpha), seeds in runs.items():
        last_steps = sorted({int(steps[-1]) for steps, _, _ in seeds})
        row = [
            dataset,
            str(alpha),
            ", ".join(f"{step:,}" for step in last_steps),
            ", ".join(f"{ratios[-1]:.2f}" for _, ratios, _ in seeds),
            "; ".join(first_over(steps, ratios) for steps, ratios, _ in seeds),
            ", ".join(f"{scores[-1]:.1f}" for _, _, scores in seeds),
            ", ".join(f"{scores[-10:].mean():.1f}" for _, _, scores in seeds),
        ]
        rows.append(row)
    return markdown(header, rows)


def draw(path, runs):
    """A panel for each dataset, a colour for each alpha, a line for each seed; dotted:
    where the scripts warn."""
    datasets = sorted({dataset for dataset, _ in runs})
    alphas = sorted({alpha for _, alpha in runs})
    shades = plt.cm.viridis(np.linspace(0.85, 0, len(alphas)))
    colors = dict(zip(alphas, shades, strict=True))
    plt.rcParams["axes.formatter.min_exponent"] = 6  # 0.5, not 5 x 10^-1
    height = math.ceil(len(datasets) / 3)
    width = math.ceil(len(datasets) / height)
    figure, axes = plt.subplots(
        height,
        width,
        figsize=(3.6 * width, 3.2 * height),
        squeeze=False,
        layout="constrained",
    )
    for axis, dataset in zip(axes.flat, datasets, strict=False):
        for (of_dataset, alpha), seeds in runs.items():
            if of_dataset != dataset:
                continue
            for seed, (steps, ratios, _) in enumerate(seeds):
                label = None if seed else f"{alpha}"
                axis.plot(steps / 1000, ratios, color=colors[alpha], label=label)
        axis.axhline(THRESHOLD, color="black", linestyle=":", linewidth=1)
        axis.set_yscale("log")
        axis.set_title(dataset, fontsize="medium")
        axis.set_xlabel("training steps (thousands)")
        axis.grid(alpha=0.3)
        axis.legend(title="alpha", fontsize="small", title_fontsize="small")
    for axis in axes.flat[len(datasets) :]:
        axis.remove()
    for axis in axes[:, 0]:
        axis.set_ylabel("Q / best discounted return")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main(args: Args):
    runs = read_runs(args.runs)
    if not runs:
        sys.exit(f"{args.runs} holds no run folders <dataset>/<anything>/<run>")
    text = table(runs)
    (args.runs / "table.md").write_text(text)
    draw(args.runs / "figure.png", runs)
    print(text, end="")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
