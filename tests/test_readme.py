# SPDX-License-Identifier: MIT
"""What the README shows is what the code does.

After a change of wpc.py, this writes the lines of the README's map anew:

    python tests/test_readme.py
"""

import importlib
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tyro
from scipy import stats

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/tools")]
README = (ROOT / "README.md").read_text()
TABLES = (ROOT / "tests/results/tables.md").read_text()
MAP_ROW = re.compile(r"^\| (.*) \| \[\d+\]\(wpc\.py#L\d+\) \|$", re.M)
MAP = {  # what the paper has, and how the line of wpc.py begins that does it
    "networks, Table 4": "def mlp(input_dim, output_dim):",
    "Algorithm 1: initialize": "self.critic = Critic(state_dim, action_dim)",
    "sample a batch": "batch = sample_batch(dataset, args.batch_size)",
    "the target's action a'": "a_next = self.actor_target(s_next) + noise",
    "the target y": "y = r + args.discount * (1 - done) * torch.min(q1_next, q2_next)",
    "Q1 and Q2 fit y": "critic_loss = F.mse_loss(q1, y) + F.mse_loss(q2, y)",
    "V fits y": "value_loss = F.mse_loss(v, y)",
    "every policy_freq steps": "if step % args.policy_freq == 0:",
    "**w(s, a), eq. 7**": "weight = (advantage > 0).float()  # eq. 7",
    "w(s, a) of wPC-e, eq. 8": "return (advantage / args.beta).exp().clamp(max=100)",
    "lambda": "lmbda = args.alpha / q_pi.abs().mean().detach()",
    "the policy's objective, eq. 6": "actor_loss = -lmbda * q_pi.mean() + constraint",
    "targets follow": "soft_update(self.critic_target, self.critic, args.tau)",
}
WORDS = 1_500


def map_row(paper):
    lines = [line.strip() for line in (ROOT / "wpc.py").read_text().splitlines()]
    code = MAP[paper]
    numbers = [i for i, line in enumerate(lines, 1) if line.startswith(code)]
    assert len(numbers) == 1, f"`{code}` stands in lines {numbers} of wpc.py"
    return f"| {paper} | [{numbers[0]}](wpc.py#L{numbers[0]}) |"


def test_the_map_leads_to_the_lines():
    shown = [match.group() for match in MAP_ROW.finditer(README)]
    assert shown == [map_row(paper) for paper in MAP], (
        "run `python tests/test_readme.py`"
    )


def changes(text):
    """The changed lines of a diff, of either kind, as (taken away?, code)."""
    lines = [line for line in text.splitlines() if re.match(r"[-<+>] ", line)]
    return [(line[0] in "-<", line[1:].strip()) for line in lines]


def test_the_diff_is_part_of_the_real_one():
    (shown,) = re.findall(r"```diff\n(.*?)```", README, re.S)
    line = ["diff", "td3_bc.py", "wpc.py"]
    output = subprocess.run(line, cwd=ROOT, capture_output=True, text=True).stdout
    real = changes(output)
    assert 2 <= len(changes(shown)) <= 8
    for change in changes(shown):
        assert change in real, change


def rows_of(text, title):
    """The cells of the rows on D4RL's tasks in a section's table."""
    section = text.split(f"## {title}\n")[1].split("\n## ")[0]
    lines = re.findall(r"^\| [a-z0-9]+-medium.*", section, re.M)
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def test_its_results_are_the_reports():
    ours, theirs = rows_of(README, "Results"), rows_of(TABLES, "Table 1")
    theirs = [row for row in theirs if row[2] != "-"]  # tasks with runs of ours
    assert len(ours) == len(theirs)
    for row, cells in zip(ours, theirs, strict=True):
        cells = ["" if x == "-" else re.sub(r"; [\d,]+k\)", ")", x) for x in cells]
        assert [x.strip("*") for x in row] == cells[: len(row)]
    cells = {row[0]: [x.split(" (")[0] for x in row] for row in theirs}
    wpc, wpc_paper, td3_bc, td3_bc_paper = cells["hopper-medium"][2:6]
    assert f"wPC has {wpc} (three seeds; the paper {wpc_paper})" in README
    assert f"and TD3+BC {td3_bc} ({td3_bc_paper}), on" in README
    wpc, wpc_paper, td3_bc, td3_bc_paper = cells["walker2d-medium"][2:6]
    assert f" {wpc} ({wpc_paper}) and {td3_bc} ({td3_bc_paper}), where" in README


def test_its_differences_are_the_reports():
    table = rows_of(TABLES, "Differences")
    rows = {task: cell for task, cell, _ in table}
    pattern = r"(\S+) \[(\S+), (\S+)\], p = (\S+)"
    mean, low, high, p = re.match(pattern, rows["hopper-medium"]).groups()
    interval = f"95% interval {low} to {high}, p = {float(p):.1g}"
    assert (
        f"is {mean} on *hopper-medium* ({interval}, Welch's t test, uncorrected)"
        in README
    )
    mean, low, high, p = re.match(pattern, rows["halfcheetah-medium"]).groups()
    interval = f"{low} to {high}, p = {float(p):.1g}"
    assert f"two seeds, {mean} on *halfcheetah-medium* ({interval})" in README
    assert "(2, 2;" in rows["halfcheetah-medium"]
    mean, low, high, p = re.match(pattern, rows["walker2d-medium"]).groups()
    assert f"it is {mean} ({low} to {high}, p = {p})" in README
    assert f"where the lead could be chance (p = {p})" in README
    over_wbc = {task: cell for task, _, cell in table}
    cells = [over_wbc[f"{robot}-medium"] for robot in ("hopper", "halfcheetah")]
    cells.append(over_wbc["walker2d-medium"])
    seeds = ["(3, 3; 500k)", "(2, 2; 500k)", "(3, 3; 500k)"]
    assert [cell[-12:] for cell in cells] == seeds
    numbers = []
    for cell in cells:
        mean, low, high, p = re.match(pattern, cell).groups()
        numbers += [mean, f"({low} to {high}, p = {p})"]
    assert (
        "Its lead over wBC at step 500,000 is {} on *hopper-medium* {}, {} with two "
        "seeds on *halfcheetah-medium* {} and, with one seed of wPC yet to recover, {} "
        "on *walker2d-medium* {}."
    ).format(*numbers) in README


def arguments(script, words):
    return vars(tyro.cli(importlib.import_module(Path(script).stem).Args, args=words))


def test_the_runs_have_the_arguments_of_their_commands():
    text = (ROOT / "tests/results/commands.txt").read_text()
    folders = []
    for line in re.findall(
        r"^python (?:tests/tools/compiled.py )?(\w+\.py .*)", text, re.M
    ):
        script, *words = shlex.split(line)
        args = arguments(script, words)
        folders.append(ROOT / "tests/results" / args["run_dir"])
        made = json.loads((folders[-1] / "args.json").read_text())
        args |= {"device": made["device"], "dataset": Path(args["dataset"]).name}
        assert made == made | args
    assert sorted(folders) == sorted((ROOT / "tests/results/runs").iterdir())


COMMANDS = re.findall(r"(?<=\.venv/bin/python )[a-z0-9_/]+\.py [^\n`]+", README)


@pytest.mark.parametrize("line", [x for x in COMMANDS if "[...]" not in x])
def test_its_commands_are_understood(line):
    script, *words = shlex.split(line.removesuffix(" ..."))
    if script == "tests/tools/compiled.py":
        script, *words = words
    if script == "tests/tools/experiments.py":
        assert words[0] == "report" and words[1::2] == ["--runs", "--out"]
    else:
        arguments(script, words)


def test_its_program_plays_a_run(finished):
    (program,) = re.findall(r"```python\n(.*?)```", README, re.S)
    names = {}
    exec(program.replace("RUN_DIR", str(finished)), names)
    assert names["observations"].shape == (1, 17) and names["rewards"].shape == (1,)


def tables(script, task):
    """What was evaluated in the runs of all seeds, without the one at step 0."""
    return [
        np.genfromtxt(path / "evaluations.csv", names=True, delimiter=",")[1:]
        for path in sorted((ROOT / "tests/results/runs").glob(f"{script}__{task}__*"))
    ]


def scores(script, task):
    """Steps and scores of all seeds: (evaluations,) and (seeds, evaluations)."""
    runs = tables(script, task)
    return runs[0]["step"], np.stack([x["normalized_score"] for x in runs])


def test_what_it_says_of_curves_is_in_the_runs():
    early, jumps = [], []
    for script in ("wpc", "td3_bc"):
        for task in ("hopper-medium", "walker2d-medium"):
            steps, values = scores(script, task)
            early.append(f"{values[:, steps <= 100_000].mean():.1f}")
        steps, values = scores(script, "hopper-medium-replay")
        jumps.append(np.abs(np.diff(values[:, steps > 500_000])))
    first = "wPC averages {} on *hopper-medium* and {} on *walker2d-medium*, TD3+BC {} "
    assert (first + "and {}.").format(*early) in README
    ours, td3_bc = (f"{np.median(x):.0f}" for x in jumps)
    most = f"by {max(x.max() for x in jumps):.0f} at most"
    assert f"by {td3_bc} (TD3+BC) and {ours} points (wPC)" in README and most in README


def test_its_last_evaluations_are_in_the_runs():
    last = (
        f"{scores(script, 'hopper-medium')[1][:, -1].mean():.1f}"
        for script in ("wpc", "td3_bc")
    )
    sentence = "By last evaluations, the paper's measure, *hopper-medium* has {} (wPC)"
    assert (sentence + " and {} (TD3+BC).").format(*last) in README


def test_what_it_says_of_q_running_away_is_in_the_runs():
    runs = tables("wpc", "walker2d-medium")
    ratios = [x["q"] / x["best_discounted_return"] for x in runs]
    largest = sorted(f"{ratio.max():.1f}" for ratio in ratios)
    steps = [x["step"][r.argmax()] for x, r in zip(runs, ratios, strict=True)]
    assert "it reached {}, {} and {} times the best".format(*largest) in README
    assert f"at steps {min(steps):,.0f} to {max(steps):,.0f}" in README

    (long,) = (x for x, r in zip(runs, ratios, strict=True) if r.max() > 5)
    early = long["step"] <= 600_000
    below = long["normalized_score"] < 40
    assert below[early].mean() > 0.9 and below[~early].mean() < 0.1
    assert "the score was mostly below 40 until step 600,000" in README
    ends = [x["normalized_score"][-10:].mean() for x in runs]
    lowest, highest = np.floor(min(ends)), np.ceil(max(ends))
    assert f"all three seeds end between {lowest:.0f} and {highest:.0f}" in README


def test_there_is_one_run_of_each_other_weight_or_alpha():
    runs = sorted(path.name for path in (ROOT / "tests/results/runs").glob("wpc-*"))
    assert runs == [
        "wpc-alpha-1.0__walker2d-medium__1",
        "wpc-exponential__walker2d-medium__0",
    ]
    assert "other weights and alphas ([one run each]" in README
    assert "of wPC-e and alpha 1.0)" in README


def test_all_medium_scores_are_as_near_to_the_papers_as_it_says():
    table = TABLES.split("## Table 1")[1].split("##")[0].splitlines()
    header, *rows = [line.split("|")[1:-1] for line in table if line.startswith("| ")]
    count, below = 0, []
    for row in rows:
        cells = {k.strip(): v.split()[0] for k, v in zip(header, row, strict=True)}
        if cells["task"].endswith("-medium"):
            for system in ("wPC", "TD3+BC", "wBC"):
                ours, paper = float(cells[system]), float(cells[f"{system}, paper"])
                assert abs(ours - paper) <= 3
                count += 1
        elif cells["task"].endswith("-medium-replay"):
            for system in ("wPC", "TD3+BC"):
                below.append(float(cells[f"{system}, paper"]) - float(cells[system]))
            assert float(cells["wPC"]) > float(cells["TD3+BC"])
            assert float(cells["wPC, paper"]) > float(cells["TD3+BC, paper"])
    assert count == 9 and len(below) == 6
    text = f"{min(below):.0f} to {max(below):.0f} below its scores"
    assert f"the single seeds agree with the paper's order, {text}" in README
    assert "all three algorithms score within 3 points of the paper" in README


def test_td3_bc_is_as_near_to_its_curves_on_d4rls_files_as_it_says():
    rows = rows_of(TABLES, "TD3+BC here and on D4RL's files")
    rows = [row for row in rows if row[0].endswith("-medium")]
    assert len(rows) == 3
    for _, ours, theirs, _ in rows:
        assert abs(float(ours.split()[0]) - float(theirs.split()[0])) <= 1
    assert "TD3+BC's mean over all evaluations is within a point of" in README
    sentence = "p = {} with two of our seeds, {} and {} with three"
    assert sentence.format(*(row[3] for row in rows)) in README
    assert [row[1].split("(")[1][0] for row in rows] == ["2", "3", "3"]
    below = [
        float(theirs.split()[0]) - float(ours.split()[0])
        for task, ours, theirs, _ in rows_of(TABLES, "TD3+BC here and on D4RL's files")
        if task.endswith("-medium-replay")
    ]
    assert "it is {:.0f}, {:.0f} and {:.0f} points below".format(*below) in README


def test_what_it_says_of_the_zoos_agents_is_in_its_table():
    row = r"^\| (\w+ \w+) \| (\d+) ± (\d+) \| (\d+) ± (\d+) \| (\d+) ± (\d+) \|$"
    d4rl, stock = {}, {}
    for agent, *numbers in re.findall(row, README, re.M):
        published, *ours = np.array(numbers, float).reshape(3, 2)
        for (mean, std), values in zip(ours, (d4rl, stock), strict=True):
            test = stats.ttest_ind_from_stats(
                mean, std, 150, *published, 150, equal_var=False
            )
            values[agent] = test.pvalue
            assert values is d4rl or mean < published[0]
    assert len(d4rl) == 6 and f"(p ≥ {min(d4rl.values()):.2f}, Welch's t" in README
    assert stock.pop("TQC HalfCheetah") > 0.05
    assert f"fall short (p ≤ {max(stock.values()):.2f}):" in README


def prose(text):
    """The README's words without code, tables, and what links lead to."""
    text = re.sub(r"^```.*?^```$|^\|.*?$|<!--.*?-->", "", text, flags=re.M | re.S)
    return re.sub(r"\]\([^)]*\)", "]", text).split()


def test_it_is_short():
    assert len(prose(README)) <= WORDS


@pytest.mark.parametrize(
    "text", ["```\na b\n```\n", "| a | b |\n|---|---|\n", "](http://a b)"]
)
def test_tables_and_code_do_not_count(text):
    assert prose(f"One two\n{text}") in (["One", "two"], ["One", "two", "]"])


def test_files_that_it_links_to_exist():
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", README)
    assert len(links) > 5
    for link in links:
        assert (ROOT / link).exists(), link


if __name__ == "__main__":
    text = MAP_ROW.sub(lambda match: map_row(match.group(1)), README)
    (ROOT / "README.md").write_text(text)
