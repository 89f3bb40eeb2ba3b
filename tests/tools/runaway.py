# SPDX-License-Identifier: MIT
"""When does Q run away? A table of Q over the dataset's best discounted return.

    python tests/tools/runaway.py --runs tests/results/runaway --best-return 262

The folder holds a folder for each setting, with a run folder for each seed in it. The
best discounted return is a dataset's own: a script prints it when it warns.
"""

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

STEPS = (10_000, 20_000, 30_000)


@dataclass
class Args:
    runs: Path
    """folder with a folder for each setting"""
    best_return: float
    """best discounted return in the dataset"""


def q_over_best(run_dir, best_return):
    """{step: Q over the best return} of a run's evaluations."""
    with (run_dir / "evaluations.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {int(row["step"]): float(row["q"]) / best_return for row in rows}


def table(args):
    """A Markdown table: a row for each setting, the seeds side by side."""
    header = ["setting", *(f"{step:,}" for step in STEPS), "over 2 at the end"]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for setting in sorted(path for path in args.runs.iterdir() if path.is_dir()):
        folders = sorted(setting.glob("*__*__*"))
        seeds = [q_over_best(folder, args.best_return) for folder in folders]
        cells = [setting.name]
        for step in STEPS:
            cells.append(", ".join(f"{q[step]:.2f}" for q in seeds if step in q))
        far = sum(q[max(q)] > 2 for q in seeds)
        cells.append(f"{far} of {len(seeds)} seeds")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main(args: Args):
    text = table(args)
    if text.count("\n") == 2:
        sys.exit(f"{args.runs} holds no folders with runs")
    (args.runs / "table.md").write_text(text)
    print(text, end="")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
