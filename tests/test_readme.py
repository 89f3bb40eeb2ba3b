# SPDX-License-Identifier: MIT
"""What README.md and tests/results/README.md say is what the code and the runs do.

After a change of wpc.py, this writes the lines of the README's map anew:

    python tests/test_readme.py
"""

import csv
import importlib
import itertools
import json
import re
import shlex
import subprocess
import sys
import textwrap
import types
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from conftest import wpc_with
from scipy import stats

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/tools")]
import experiments  # noqa: E402

import wpc  # noqa: E402

README = (ROOT / "README.md").read_text()
RESULTS = (ROOT / "tests/results/README.md").read_text()
TABLES = (ROOT / "tests/results/tables.md").read_text()
MAP_ROW = re.compile(r"^\| (.*) \| \[\d+\]\(wpc\.py#L\d+\) \|$", re.M)
MAP = {  # what the paper has, and how the line of wpc.py begins that does it
    "networks, Table 4": "class MLP(nn.Sequential):",
    "Algorithm 1: initialize": "self.critic = Critic(state_dim, action_dim)",
    "sample a batch": "batch = sample_batch(dataset, args.batch_size)",
    "the target's action a'": "a_next = (self.actor_target(s_next) + noise).clamp(",
    "the target y": "y = r + args.discount * (1 - done) * torch.min(q1_next, q2_next)",
    "Q1 and Q2 fit y": "critic_loss = F.mse_loss(q1, y) + F.mse_loss(q2, y)",
    "V fits y": "value_loss = F.mse_loss(v, y)",
    "every policy_freq steps": "if step % args.policy_freq == 0:",
    "**w(s, a), eq. 7**": "weight = (advantage > 0).float()  # eq. 7",
    "lambda": "lmbda = args.alpha / q_pi.abs().mean().detach()",
    "the policy's objective, eq. 6": "actor_loss = -lmbda * q_pi.mean() + constraint",
    "targets follow": "soft_update(self.critic_target, self.critic, args.tau)",
}
DATA = str(ROOT / "tests/data/halfcheetah_replay.hdf5")
WORDS = 1_200  # beside tables and code


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
    shown = re.findall(r"```diff\n(.*?)```", README, re.S)[0]
    line = ["diff", "td3_bc.py", "wpc.py"]
    output = subprocess.run(line, cwd=ROOT, capture_output=True, text=True).stdout
    real = changes(output)
    assert 2 <= len(changes(shown)) <= 8
    for change in changes(shown):
        assert change in real, change


def rows_of(text, title):
    """The cells of the rows on D4RL's tasks in a section's tables; None: the first."""
    section = text if title is None else text.split(f"## {title}\n")[1]
    section = section.split("\n## ")[0]
    lines = re.findall(
        r"^\| (?:[a-z0-9]+-(?:random|medium)|all twelve).*", section, re.M
    )
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def test_its_results_are_the_reports():
    ours, theirs = rows_of(RESULTS, "Scores"), rows_of(TABLES, "Table 1")
    assert len(theirs) == 12
    for row, cells in zip(ours, theirs, strict=False):
        del cells[11]  # CORL's BC
        cells = ["" if cell == "-" else cell for cell in cells]
        assert [cell.strip("*") for cell in row] == cells
    totals = dict.fromkeys(("wPC", "TD3+BC", "wBC", "BC"))
    section = TABLES.split("## Totals\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (\S+) \| (\d+) \| (\S+) \|.*\| (\S+) \|$", section, re.M)
    for system, tasks, score, paper in rows:
        totals[system] = [score if tasks == "12" else "", f"*{paper}*"]
    wpc_sum, td3_bc_sum, wbc_sum, bc_sum = totals.values()
    sums = [*wpc_sum, *td3_bc_sum, "", *wbc_sum, *bc_sum]
    assert ours[12] == ["all twelve, added up", "", *sums, ""]
    assert float(wpc_sum[0]) > float(td3_bc_sum[0])
    assert "over all twelve tasks, wPC is ahead of TD3+BC" in RESULTS


def test_its_first_table_is_a_part_of_them():
    *rows, total = rows_of(README, None)
    scores = rows_of(RESULTS, "Scores")
    expected = [row for row in scores if row[0].endswith("-medium")][:3]
    for row, ours in zip(expected, rows, strict=True):
        steps = "500k" if row[0] == "halfcheetah-medium" else "1,000k"
        assert row[2].endswith(f"; {steps})") and row[4].endswith(f"; {steps})")
        assert ours == [row[0], *(x.replace(f"; {steps}", "") for x in row[2:6])]
    assert total == [total[0], *scores[12][2:6]] and "all twelve" in total[0]
    assert "trained on these for 1,000,000 steps (HalfCheetah: 500,000), on" in README


def leads():
    """The report's differences: {(task, over): (lead, low, high, p, seeds; steps)}."""
    cell = re.compile(r"(\S+) \[(\S+), (\S+)\], p = (\S+) \((.*)\)")
    rows = rows_of(TABLES, "Differences")
    return {
        (task, over): cell.fullmatch(text).groups()
        for task, *texts in rows
        for over, text in zip(("TD3+BC", "wBC"), texts, strict=True)
    }


def test_its_differences_are_the_reports():
    rows = [row for row in rows_of(RESULTS, "Scores") if row[1] in ("TD3+BC", "wBC")]
    expected = {
        key: (lead, f"{low} to {high}", p, seeds)
        for key, (lead, low, high, p, seeds) in leads().items()
    }
    assert {(task, over): tuple(cells) for task, over, *cells in rows} == expected
    assert float(expected["walker2d-medium", "TD3+BC"][2]) > 0.05
    assert "On *walker2d-medium* the lead over TD3+BC could be chance" in RESULTS
    (row,) = (x for x in rows_of(TABLES, "Table 1") if x[0] == "walker2d-medium")
    papers = float(row[3]) - float(row[5])
    low, high = leads()["walker2d-medium", "TD3+BC"][1:3]
    assert float(low) < 0 < papers < float(high)
    assert f"consistent with the paper's {papers:.1f} and with 0." in RESULTS
    hopper, cheetah, walker = (
        float(expected[f"{robot}-medium", "TD3+BC"][2])
        for robot in ("hopper", "halfcheetah", "walker2d")
    )
    assert (
        f"is clear on *hopper-medium* (p = {hopper:.1g}, Welch's t test). It is likely "
        f"on *halfcheetah-medium* (p = {cheetah:.1g}), and could be chance on "
        f"*walker2d-medium* (p = {walker:.2f})."
    ) in README


def test_one_seed_is_why_wbc_is_ahead_at_step_500_000():
    steps, values = scores("wpc", "walker2d-medium")
    then = values[:, (steps > 400_000) & (steps <= 500_000)].mean(axis=1)
    assert sorted(then > 79.9) == [False, True, True]
    assert "because one seed of wPC has yet to recover" in RESULTS


def test_its_float32_run_ends_where_it_says():
    path = "float32/wpc__hopper-medium__0/evaluations.csv"
    table = np.genfromtxt(ROOT / "tests/results" / path, names=True, delimiter=",")
    end = table["normalized_score"][-10:].mean()
    assert f"[ends at {end:.1f}]({path})" in RESULTS


def arguments(script, words):
    name, _, weight = Path(script).stem.partition("wpc_")
    module = wpc_with(weight) if weight else importlib.import_module(name)
    return vars(tyro.cli(module.Args, args=words))


def test_the_runs_have_the_arguments_of_their_commands():
    text = (ROOT / "tests/results/commands.txt").read_text()
    folders = []
    for tool, line in re.findall(
        r"^python (tests/tools/compiled.py )?(\w+\.py .*)", text, re.M
    ):
        script, *words = shlex.split(line)
        args = arguments(script, words)
        folders.append(ROOT / "tests/results" / args["run_dir"])
        made = json.loads((folders[-1] / "args.json").read_text())
        args |= {"device": made["device"], "dataset": Path(args["dataset"]).name}
        assert made == made | args
        assert ("made_by" in made) == (tool == "")
    assert sorted(folders) == sorted((ROOT / "tests/results/runs").iterdir())


COMMANDS = re.findall(
    r"(?<=\.venv/bin/python )[a-z0-9_/]+\.py [^\n`]+", README + RESULTS
)


@pytest.mark.parametrize("line", COMMANDS)
def test_its_commands_are_understood(line):
    script, *words = shlex.split(line.replace("$SLURM_ARRAY_TASK_ID", "3"))
    if script == "tests/tools/compiled.py":
        script, *words = words
    if script == "tests/tools/experiments.py":
        assert words[0] == "report" and words[1::2] == ["--runs", "--out"]
    else:
        arguments(script, words)


def block(kind, words):
    """The README's one block of code of a kind that holds these words."""
    blocks = re.findall(rf"```{kind}\n(.*?)```", README, re.S)
    (code,) = (x for x in blocks if words in x)
    return code


def replaced(code, replacements):
    """The code after replacements, each of something that stands there once."""
    for old, new in replacements.items():
        assert code.count(old) == 1, old
        code = code.replace(old, new)
    return code


def test_its_smallest_install_is_the_block_for_training():
    (line,) = re.findall(r"pip install -r <\((.*)\)$", README, re.M)
    output = subprocess.run(
        shlex.split(line), cwd=ROOT, capture_output=True, text=True
    ).stdout
    block = (ROOT / "requirements.txt").read_text().split("\n\n")[0]
    assert output.strip() == block and block.startswith("# training\n")


def test_it_names_the_versions_that_it_was_tried_with():
    text = (ROOT / "requirements.txt").read_text()
    mujoco, pytorch = (
        re.search(rf"^{name}==(\S+)", text, re.M)[1] for name in ("mujoco", "torch")
    )
    assert f"It was tried with MuJoCo {mujoco} and PyTorch {pytorch}." in README


def test_its_command_to_download_gives_d4rls_file(monkeypatch, tmp_path):
    (program,) = re.findall(r'python -c "(.*)"$', README, re.M)
    (tmp_path / "hopper_medium-v2.hdf5").write_text("")  # there is no network here
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path))
    names = {}
    exec(program.replace("wpc.download", "path = wpc.download"), names)
    assert Path(names["path"]) == tmp_path / "hopper_medium-v2.hdf5"


def test_its_columns_are_those_of_a_run(finished):
    (table,) = re.findall(r"^\| column \|.*?\n\n", README, re.S | re.M)
    names = [
        re.findall(r"`(\w+)`", line.split("|")[1]) for line in table.split("\n")[2:-2]
    ]
    with (finished / "evaluations.csv").open() as file:
        header, *_ = csv.reader(file)
    assert sorted(itertools.chain(*names)) == sorted(header)


def test_its_program_plays_a_run(finished):
    names = {}
    exec(block("python", "RUN_DIR").replace("RUN_DIR", str(finished)), names)
    assert names["observations"].shape == (1, 17) and names["rewards"].shape == (1,)


def test_its_sweep_goes_on_after_a_run_that_fails(monkeypatch, tmp_path, capsys):
    program = replaced(
        block("python", "UserError"),
        {
            'env="hopper-medium-v2"': f'env="halfcheetah", dataset={DATA!r}, **SHORT',
            "(1.0, 2.5, 5.0)": "(1e38, 2.5, 5.0)",
        },
    )
    short = {"max_timesteps": 4, "eval_freq": 2, "eval_episodes": 1, "device": "cpu"}
    monkeypatch.chdir(tmp_path)
    exec(program, {"SHORT": short})
    lines = capsys.readouterr().out.splitlines()
    means = [x.split() for x in lines if re.fullmatch(r"[25]\.\d \S+", x)]
    assert [x[0] for x in means] == ["2.5", "5.0"]
    assert len(list((tmp_path / "runs").iterdir())) == 3


def changed_script(words, folder, name):
    """wpc.py after the changes of the README's diff that holds these words, imported.

    A hunk's first lines (-) are replaced by its others (+), wherever they are indented.
    """
    lines = (ROOT / "wpc.py").read_text().splitlines()
    hunks = re.findall(r"((?:^-.*\n)+)((?:^\+.*\n)+)", block("diff", words), re.M)
    assert hunks
    for hunk in hunks:
        old, new = ([x[1:] for x in part.splitlines()] for part in hunk)
        old, new = (textwrap.dedent("\n".join(x)).splitlines() for x in (old, new))
        places = []
        for start in range(len(lines) - len(old) + 1):
            found = lines[start : start + len(old)]
            if textwrap.dedent("\n".join(found)).splitlines() == old:
                places.append(start)
        assert len(places) == 1, f"{old} stands {len(places)} times in wpc.py"
        (start,) = places
        first = lines[start]
        indent = first[: len(first) - len(first.lstrip())]
        lines[start : start + len(old)] = [indent + x for x in new]
    path = folder / f"{name}.py"
    path.write_text("\n".join(lines) + "\n")
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses look it up
    spec.loader.exec_module(module)
    return module


def short_run(module, folder, **options):
    """A few steps, and a few more after continuing; returns the checkpoint."""
    for steps in (4, 8):
        args = module.Args(
            env="halfcheetah",
            dataset=DATA,
            device="cpu",
            max_timesteps=steps,
            eval_freq=2,
            eval_episodes=1,
            run_dir=str(folder / "run"),
            **options,
        )
        module.train(args)
    return torch.load(folder / "run/checkpoint.pt", weights_only=True)


def test_its_change_for_another_weight_works(tmp_path):
    module = changed_script("torch.sigmoid", tmp_path, "wpc_with_another_weight")
    checkpoint = short_run(module, tmp_path)
    assert 0.4 < checkpoint["evaluations"][-1]["weight"] < 0.6  # about half at first
    mean = {row.get("weight") for row in checkpoint["evaluations"]} - {None}
    assert all(abs(x * 256 - round(x * 256)) > 1e-4 for x in mean)  # not 0 or 1


def test_its_change_for_five_critics_works(tmp_path):
    module = changed_script("class Critic", tmp_path, "wpc_with_five_critics")
    checkpoint = short_run(module, tmp_path)
    assert len(checkpoint["agent"]["critic"]) == 5 * 6  # weights and biases of 3 layers
    args = module.Args(device="cpu")
    agent = module.Agent(11, 3, 1.0, args)
    before = [p.clone() for p in agent.critic.parameters()]
    batch = {
        "observations": torch.randn(9, 11),
        "next_observations": torch.randn(9, 11),
    }
    batch |= {"actions": torch.rand(9, 3), "rewards": torch.randn(9, 1)}
    agent.update(batch | {"terminals": torch.zeros(9, 1)}, 1)
    after = list(agent.critic.parameters())
    assert all((x != y).any() for x, y in zip(before, after, strict=True))


def test_its_change_for_another_logger_works(monkeypatch, tmp_path):
    logged, configs = {}, []
    wandb = types.SimpleNamespace(
        init=lambda config: configs.append(config),
        log=lambda row, step: logged.update({step: row}),
        finish=lambda: None,
    )
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    module = changed_script("import wandb", tmp_path, "wpc_with_another_logger")
    checkpoint = short_run(module, tmp_path)
    assert [config["max_timesteps"] for config in configs] == [4, 8]
    assert logged == {row["step"]: row for row in checkpoint["evaluations"]}


def test_its_program_trains_on_data_in_memory(capsys):
    names = {}
    exec(block("python", "prepare_dataset"), names)
    assert "normalized_score" in capsys.readouterr().out.splitlines()[-1]
    assert names["step"] == 100
    assert all(p.isfinite().all() for p in names["agent"].critic.parameters())


def test_its_program_writes_data_that_train(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    program = replaced(block("python", "h5py"), {"10_000": "1_000"})
    exec(program, {})
    (line,) = (x for x in COMMANDS if "--dataset pendulum.hdf5" in x)
    _, *words = shlex.split(line)
    options = shlex.split("--max-timesteps 4 --eval-freq 2 --run-dir run")
    wpc.train(tyro.cli(wpc.Args, args=words + options))
    checkpoint = torch.load("run/checkpoint.pt", weights_only=True)
    assert len(checkpoint["mean"]) == 3


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
    for task, ours, td3_bc in zip(
        ("hopper-medium", "walker2d-medium"), early[:2], early[2:], strict=True
    ):
        assert f"\n| {task} | {ours} | {td3_bc} |\n" in RESULTS
        assert float(ours) < 0.7 * float(td3_bc)  # far below
    sentence = "over the first 100,000 steps on *hopper-medium* and *walker2d-medium*, "
    assert sentence + "it scores far below TD3+BC" in README
    ours, td3_bc = (f"{np.median(x):.0f}" for x in jumps)
    most = max(x.max() for x in jumps)
    sentence = "is {} points (TD3+BC) and {} (wPC), and the largest is {:.0f}."
    assert sentence.format(td3_bc, ours, most) in RESULTS


def test_its_last_evaluations_are_in_the_runs():
    last = [
        f"{scores(script, 'hopper-medium')[1][:, -1].mean():.1f}"
        for script in ("wpc", "td3_bc")
    ]
    sentence = "By last evaluations, the paper's measure, *hopper-medium* has {} (wPC)"
    assert (sentence + " and {} (TD3+BC).").format(*last) in RESULTS
    sentence = (
        "by last evaluations, ours on *hopper-medium* are {} (wPC) and {} (TD3+BC)."
    )
    assert sentence.format(*last) in README


def test_what_it_says_of_q_running_away_is_in_the_runs():
    runs = tables("wpc", "walker2d-medium")
    ratios = [x["q"] / x["best_discounted_return"] for x in runs]
    largest = sorted(f"{ratio.max():.1f}" for ratio in ratios)
    steps = [x["step"][r.argmax()] for x, r in zip(runs, ratios, strict=True)]
    assert "\n| {} | {} | {} |\n".format(*largest) in RESULTS
    assert f"largest at steps {min(steps):,.0f} to {max(steps):,.0f}." in RESULTS
    assert [ratio.max() > 1 for ratio in ratios].count(True) == 2
    assert all(ratio[-10:].mean() < 1 for ratio in ratios)
    assert "Q can run away and come back, as with two seeds on *walk" in README
    assert (
        "On *walker2d-random* and, with alpha 2.5, *walker2d-medium-expert* (one seed "
        "each), it had not come back by step 500,000."
    ) in README
    above = []
    for task, script in itertools.product(experiments.TASKS, ("wpc", "wpc-alpha-2.5")):
        for run in tables(script, task):
            if run["q"][-1] > run["best_discounted_return"][-1]:
                above.append((task, script))
                assert run["step"][-1] == 500_000
    assert above == [
        ("halfcheetah-random", "wpc"),  # whose returns are above the data's, too
        ("walker2d-random", "wpc"),
        ("walker2d-medium-expert", "wpc-alpha-2.5"),
    ]

    (long,) = (x for x, r in zip(runs, ratios, strict=True) if r.max() > 5)
    early = long["step"] <= 600_000
    below = long["normalized_score"] < 40
    assert below[early].mean() > 0.9 and below[~early].mean() < 0.1
    assert "the score was mostly below 40 until step 600,000" in RESULTS
    assert (
        "One of three seeds on *walker2d-medium* scored mostly below 40 until step 600,"
        in README
    )
    ends = [x["normalized_score"][-10:].mean() for x in runs]
    lowest, highest = np.floor(min(ends)), np.ceil(max(ends))
    assert f"All three seeds end between {lowest:.0f} and {highest:.0f}." in RESULTS


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
    text = f"{min(below):.0f} to {max(below):.0f} points below its scores"
    assert f"TD3+BC keep the paper's order, {text}" in RESULTS
    assert (
        "seeds of wPC and TD3+BC keep the paper's order, with lower scores." in README
    )
    for text in (README, RESULTS):
        assert "all three algorithms score within 3 points of the paper" in text


def test_td3_bc_is_as_near_to_its_curves_on_d4rls_files_as_it_says():
    lines, apart = [], {}
    for task, ours, theirs, p in rows_of(TABLES, "TD3+BC here and on D4RL's files"):
        seeds = re.search(r"\((\d)", ours)[1]
        difference = float(ours.split()[0]) - float(theirs.split()[0])
        lines.append([task, seeds, f"{difference:.1f}", p.strip("-")])
        apart.setdefault(task.split("-", 1)[1], []).append(difference)
    assert rows_of(RESULTS, "The data") == lines and len(lines) == 12
    assert max(abs(x) for x in apart["medium"]) <= 1
    assert "our mean over all evaluations is within a point of theirs" in RESULTS
    assert (
        "mean over all evaluations there is within a point of what [others]" in README
    )
    assert max(abs(x) for x in apart["random"]) <= 3
    assert "On *random* data, a single seed is within 3 points of them." in RESULTS
    least, most = -max(apart["medium-replay"]), -min(apart["medium-replay"])
    assert (
        f"our *medium-replay* data it is {least:.0f} to {most:.0f} points below"
        in RESULTS
    )
    below, above = -min(apart["medium-expert"]), max(apart["medium-expert"])
    assert f"from {below:.0f} points below to {above:.0f} above" in RESULTS


def end_of(script, task):
    """The score of the only seed's run, and its largest Q over the best return."""
    (run,) = tables(script, task)
    ratio = (run["q"] / run["best_discounted_return"]).max()
    return f"{run['normalized_score'][-10:].mean():.1f}", ratio


def test_what_surprises_in_the_paper_is_in_the_runs():
    def paper(system, task):
        return experiments.published(f"{system}, paper", task)

    task, systems = "hopper-medium-expert", ("wpc", "td3_bc")
    ours, theirs = (end_of(x, task)[0] for x in systems)
    assert float(ours) > float(theirs)
    rows = [
        f"{task} | wPC {paper('wPC', task)}, below TD3+BC's {paper('TD3+BC', task)} | "
        f"{ours} and {theirs} | not reproduced, on another expert's data"
    ]
    task, systems = "walker2d-random", ("wpc", "wbc")
    ours, theirs = (end_of(x, task)[0] for x in systems)
    assert float(ours) < float(theirs)
    rows.append(
        f"{task} | wPC {paper('wPC', task)}, below wBC's {paper('wBC', task)} | "
        f"{ours} and {theirs} | the same order, not decided by one seed"
    )
    task = "hopper-random"
    ours, theirs = (end_of(x, task)[0] for x in systems)
    for script in systems:
        last = tables(script, task)[0]["normalized_score"][-10:]
        assert last.max() > 3 * last.min()  # it jumps
    rows.append(
        f"{task} | wPC {paper('wPC', task)}, above wBC's {paper('wBC', task)} | "
        f"{ours} and {theirs}, both jumping | not decided by one seed"
    )
    task = "walker2d-medium"
    static, random = (end_of(f"wpc-{x}", task)[0] for x in ("static", "random"))
    td3_bc = at_300_000("td3_bc").mean()
    assert abs(float(random) - td3_bc) < 3
    rows += [
        f"{task} | the static weight fails (Figure 4) | {static} at step 300,000, with "
        "a rising Q | the same until then",
        f"{task} | wPC-rnd {paper('wPC-rnd', task)}, below TD3+BC's "
        f"{paper('TD3+BC', task)} | {random} at step 300,000, and {td3_bc:.1f} | not "
        "seen until then",
    ]
    assert "".join(f"| {row} |\n" for row in rows) in RESULTS


def at_300_000(script):
    """Each seed's mean of the last ten scores at step 300,000 of walker2d-medium."""
    steps, values = scores(script, "walker2d-medium")
    return values[:, steps <= 300_000][:, -10:].mean(axis=1)


def test_what_it_says_of_the_other_weights_is_in_the_runs():
    (static,), (random,) = (
        tables(f"wpc-{x}", "walker2d-medium") for x in ("static", "random")
    )
    for run in (static, random):
        assert run["step"][-1] == 300_000
    q = static["q"] / static["best_discounted_return"]
    assert q[:15].max() > q[15:25].max() and q.argmax() == len(q) - 1
    sentence = (
        "rose to {:.2f} of the best discounted return of the data, fell, and rose"
    )
    assert sentence.format(q[:15].max()) in RESULTS
    assert f"fell, and rose again to {q[-1]:.2f} at the last step" in RESULTS
    lowest, *others = sorted(at_300_000("wpc"))
    assert f"one of wPC's three seeds had a score of {lowest:.1f}, too," in RESULTS
    assert len(others) == 2 and others[0] > 75
    largest = (random["q"] / random["best_discounted_return"]).max()
    assert f"random weight's Q stayed below {np.ceil(100 * largest) / 100}" in RESULTS


def test_what_it_says_of_q_on_random_data_is_in_the_runs():
    systems = ("wpc", "td3_bc", "wbc")
    sentence = "Q has run away by step 500,000, to more than 350,000 times the best"
    assert sentence in RESULTS
    for system in systems:
        (run,) = tables(system, "walker2d-random")
        assert run["q"][-1] > 350_000 * run["best_discounted_return"][-1]
        assert run["step"][-1] == 500_000
    with (ROOT / "tests/results/datasets.csv").open() as file:
        best = {row["task"]: row["best_score"] for row in csv.DictReader(file)}
    best = best["halfcheetah-random"]
    assert "the Q of wPC and TD3+BC passes the best return." in RESULTS
    assert f"Their scores are far above the best in the data, {best}." in RESULTS
    for script, passes in zip(systems, (True, True, False), strict=True):
        score, ratio = end_of(script, "halfcheetah-random")
        assert (ratio > 1) == passes
        assert (float(score) > 5 * float(best)) == passes


def test_what_it_says_against_itself_is_in_the_runs():
    ahead = []
    for robot in ("halfcheetah", "hopper", "walker2d"):
        ours, *others = (
            float(end_of(x, f"{robot}-medium-expert")[0])
            for x in ("wpc", "td3_bc", "wbc")
        )
        ahead.append(min(others) > ours)
    assert ahead.count(True) == 2
    assert "TD3+BC and wBC are ahead of wPC on two of the three tasks" in RESULTS
    score, _ = end_of("bc", "halfcheetah-medium-replay")
    assert f"on *halfcheetah-medium-replay*, {score} after 200,000 steps" in RESULTS
    score, _ = end_of("wbc", "walker2d-medium-replay")
    assert f"So is wBC's seed on *walker2d-medium-replay*, {score}." in RESULTS
    ends = scores("wbc", "hopper-medium-replay")[1][:, -10:].mean(axis=1)
    assert f"are far apart, {ends[0]:.1f} and {ends[1]:.1f}." in RESULTS
    lead = [
        scores("wpc", task)[1][:, -10:].mean()
        - scores("td3_bc", task)[1][:, -10:].mean()
        for task in experiments.TASKS
    ]
    hoppers = sum(lead[i] for i, x in enumerate(experiments.TASKS) if "hopper" in x)
    assert "wPC is ahead of TD3+BC, most of it on Hopper's" in RESULTS
    assert hoppers > sum(lead) / 2
    missing = [x for x in experiments.TASKS if not tables("bc", x)]
    assert len(missing) == 6 and "Missing are BC on six tasks, and the other" in RESULTS


def test_the_other_tasks_have_one_or_two_seeds():
    for task in experiments.TASKS:
        if task[-7:] != "-medium":
            for script in ("wpc", "td3_bc", "wbc"):
                assert len(tables(script, task)) in (1, 2)
    assert "tasks have one or two seeds, other steps and data of [our own]" in README
    ends = {}
    for task in experiments.TASKS[-3:]:
        ends[task] = [float(end_of(script, task)[0]) for script in ("wpc", "td3_bc")]
    assert sum(ours < theirs for ours, theirs in ends.values()) == 2
    assert "TD3+BC's single seeds beat wPC's on two of three robots." in README


def test_its_speeds_on_a_gpu_are_in_the_runs():
    plain, compiled = (
        np.genfromtxt(ROOT / f"tests/results/h200/{x}.csv", names=True, delimiter=",")
        for x in ("plain", "compiled")
    )
    speeds = plain["steps_per_second"][1:]
    slow, fast = f"{speeds.min():.0f}", f"{speeds.max():.0f}"
    quick = f"{compiled['steps_per_second'][-1]:,.0f}"
    assert f"made {slow} to {fast} steps a second, without evaluation." in RESULTS
    assert f"it made {quick}." in RESULTS
    assert f"| {slow} to {fast}/s, " in README and f"| {quick}/s, " in README
    for robot in ("walker2d", "halfcheetah", "hopper"):
        runs = []
        for path in (ROOT / "tests/results/runs").glob(f"*__{robot}-*__*"):
            args = json.loads((path / "args.json").read_text())
            if "made_by" in args and args["max_timesteps"] == 500_000:
                runs += tables(*path.name.split("__")[:2])[int(path.name[-1]) :][:1]
        speed = np.median([run["steps_per_second"] for run in runs])
        assert f"\n| {len(runs)} | {robot} | {speed:,.0f} |\n" in RESULTS


def test_its_table_of_alpha_is_in_the_runs():
    for robot in ("halfcheetah", "hopper", "walker2d"):
        cells = [
            cell
            for script in ("wpc", "wpc-alpha-2.5")
            for score, ratio in [end_of(script, f"{robot}-medium-expert")]
            for cell in (score, f"{ratio:.2f}")
        ]
        assert f"\n| {robot}-medium-expert | {' | '.join(cells)} |\n" in RESULTS


def test_its_experts_scores_are_those_of_their_data():
    """Of the medium-expert data's episodes, those that are not the medium data's."""
    with (ROOT / "tests/results/datasets.csv").open() as file:
        rows = {row["task"]: row for row in csv.DictReader(file)}
    for robot in ("HalfCheetah", "Hopper", "Walker2d"):
        both, medium = (
            (int(row["episodes"]), float(row["mean_score"]))
            for kind in ("medium-expert", "medium")
            for row in [rows[f"{robot.lower()}-{kind}"]]
        )
        expert = (both[0] * both[1] - medium[0] * medium[1]) / (both[0] - medium[0])
        score = re.search(
            rf"^\| {robot} \| (?:SAC|TQC), .* \| ([\d.]+) \|$", RESULTS, re.M
        )
        assert abs(float(score[1]) - expert) < 0.2  # of rounded means


def test_its_replay_data_of_hopper_is_as_small_as_it_says():
    with (ROOT / "tests/results/datasets.csv").open() as file:
        rows = {row["task"]: row for row in csv.DictReader(file)}
    ours = int(rows["hopper-medium-replay"]["transitions"])
    assert f"Hopper's has {ours:,} transitions where D4RL's has" in RESULTS
    assert {
        int(rows[f"{x}-medium"]["transitions"]) for x in ("hopper", "walker2d")
    } == {1_000_000}


def test_its_hours_are_those_of_the_measured_speeds():
    speeds = {}
    section = RESULTS.split("## Speed\n")[1].split("On a GPU")[0]
    for line in re.findall(r"^\| [A-Za-z].* \|$", section, re.M):
        name, *cells = [cell.strip() for cell in line.split("|")[1:-1]]
        speeds[name] = [int(cell) for cell in cells]
    assert len(speeds) == 11
    for i, cores in enumerate(("one core", "two cores")):
        cells = [
            f"{speeds[name][i]}/s, {1e6 / speeds[name][i] / 3600:.1f} hours"
            for name in ("wpc.py", "compiled wpc.py")
        ]
        assert f"\n| `wpc.py`, {cores} | {cells[0]} | {cells[1]} |\n" in README
    td3_bc, compiled, d3rlpy = (
        f"{speeds[name][0]}/s, {1e6 / speeds[name][0] / 3600:.1f} hours"
        for name in ("td3_bc.py", "compiled td3_bc.py", "d3rlpy's TD3PlusBC")
    )
    assert f"\n| `td3_bc.py`, one core | {td3_bc} | {compiled} |\n" in README
    assert f"\n| d3rlpy's TD3+BC, one core | {d3rlpy} | |\n" in README
    assert round(1e6 / speeds["wpc.py"][0] / 3600) == 3
    (hopper,) = (x for x in rows_of(TABLES, "Table 1") if x[0] == "hopper-medium")
    score = f"an idle core, and should score about {float(hopper[2].split()[0]):.0f}."
    assert f"`wpc.py` takes [almost three hours](#speed) on {score}" in README
    jax = speeds["JAX-CORL, no LayerNorm"][0]
    cells = f"no LayerNorm, one core | {jax}/s, {1e6 / jax / 3600:.1f} hours | |\n"
    assert f"\n| JAX-CORL's TD3+BC, {cells}" in README
    row = r"NVIDIA H200.*? \| (\d+) to (\d+)/s, (.*?) \| ([\d,]+)/s, (.*?) \|"
    row = re.search(row, README)
    slow, fast, hours, compiled, minutes = row.groups()
    least, most = (1e6 / int(speed) / 3600 for speed in (fast, slow))
    assert hours == f"{least:.1f} to {most:.1f} hours"
    count = 1e6 / int(compiled.replace(",", "")) / 60
    assert minutes == f"{count:.0f} minutes"


def test_what_it_says_of_the_zoos_agents_is_in_its_table():
    row = r"^\| (\w+ \w+) \| (\d+) ± (\d+) \| (\d+) ± (\d+) \| (\d+) ± (\d+) \|$"
    d4rl, stock = {}, {}
    for agent, *numbers in re.findall(row, RESULTS, re.M):
        published, *ours = np.array(numbers, float).reshape(3, 2)
        for (mean, std), values in zip(ours, (d4rl, stock), strict=True):
            test = stats.ttest_ind_from_stats(
                mean, std, 150, *published, 150, equal_var=False
            )
            values[agent] = test.pvalue
            assert values is d4rl or mean < published[0]
    assert len(d4rl) == 6 and f"(p ≥ {min(d4rl.values()):.2f}, Welch's t" in RESULTS
    assert stock.pop("TQC HalfCheetah") > 0.05
    assert f"fall short (p ≤ {max(stock.values()):.2f}):" in RESULTS


def prose(text):
    """A page's text without code, tables, and what links lead to."""
    text = re.sub(r"^```.*?^```$|^\|.*?$|<!--.*?-->", "", text, flags=re.M | re.S)
    return re.sub(r"\]\([^)]*\)", "]", text)


def test_it_is_short():
    text = re.sub(r"^```.*?^```$|^\|.*?$", "", README, flags=re.M | re.S)
    assert len(text.split()) <= WORDS


@pytest.mark.parametrize("page", [README, RESULTS])
def test_no_sentence_has_more_than_two_numbers(page):
    text = re.sub(r"`[^`]*`|\[[^]]*\]", "x", prose(page))
    for sentence in re.split(r"(?<=[.:;!?)])\s+|\n\n|\n(?=- )", text):
        numbers = re.findall(r"(?<![\w.*-])-?\d[\d,.]*(?![\w-])", sentence)
        assert len(numbers) <= 2, sentence


@pytest.mark.parametrize(
    "text", ["```\na b\n```\n", "| a | b |\n|---|---|\n", "](http://a b)"]
)
def test_tables_and_code_do_not_count(text):
    words = prose(f"One two\n{text}").split()
    assert words in (["One", "two"], ["One", "two", "]"])


@pytest.mark.parametrize("page", ["README.md", "tests/results/README.md"])
def test_what_it_links_to_exists(page):
    text = (ROOT / page).read_text()
    links = re.findall(r"\]\(([^):#]*)(?:#([^)]*))?\)", text)
    assert len(links) > 5
    for link, anchor in links:
        target = (ROOT / page).parent / link if link else ROOT / page
        assert target.exists(), link
        if anchor and target.suffix == ".md":
            titles = re.findall(r"^#+ (.*)$", target.read_text(), re.M)
            assert anchor in [x.lower().replace(" ", "-") for x in titles], anchor


if __name__ == "__main__":
    text = MAP_ROW.sub(lambda match: map_row(match.group(1)), README)
    (ROOT / "README.md").write_text(text)
