# SPDX-License-Identifier: MIT
"""What the README shows is what the code does.

After a change of the scripts, this writes their diff and the lines of the map anew:

    python tests/test_readme.py
"""

import re
import subprocess
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
DIFF = re.compile(r"```diff\n.*?```", re.S)
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
    "w(s, a) of wPC-e, eq. 8": "weight = (advantage / args.beta).exp().clamp(max=100)",
    "lambda": "lmbda = args.alpha / q.abs().mean().detach()",
    "the policy's objective, eq. 6": "actor_loss = -lmbda * q.mean() + constraint",
    "targets follow": "soft_update(self.critic_target, self.critic, args.tau)",
}


def map_rows():
    lines = [line.strip() for line in (ROOT / "wpc.py").read_text().splitlines()]
    rows = []
    for paper, code in MAP.items():
        numbers = [i for i, line in enumerate(lines, 1) if line.startswith(code)]
        assert len(numbers) == 1, f"`{code}` stands in lines {numbers} of wpc.py"
        rows.append(f"| {paper} | [{numbers[0]}](wpc.py#L{numbers[0]}) |")
    return rows


def real_diff():
    line = ["diff", "td3_bc.py", "wpc.py"]
    output = subprocess.run(line, cwd=ROOT, capture_output=True, text=True).stdout
    return f"```diff\n{output}```"


def test_the_map_leads_to_the_lines():
    shown = [match.group() for match in MAP_ROW.finditer(README)]
    assert shown == map_rows(), "run `python tests/test_readme.py`"


def test_the_diff_is_real():
    assert real_diff() in README, "run `python tests/test_readme.py`"


def test_files_that_it_links_to_exist():
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", README)
    assert len(links) > 10
    for link in links:
        assert (ROOT / link).exists(), link


def test_the_snippet_acts_as_the_policy(tmp_path):
    from conftest import command, load, read_rows, run_here, wpc

    run_here(wpc, *command("wpc", "--run-dir", tmp_path, "--max-timesteps", 1))
    snippet = README.split("```python\n")[1].split("```")[0]
    observations = np.random.default_rng(0).normal(size=(4, 17))
    variables = {"observations": observations}
    exec(snippet.replace("runs/DIR", str(tmp_path)), variables)
    actions = variables["actions"]
    assert actions.shape == (4, 6) and actions.abs().max() <= 1

    checkpoint, agent = load(tmp_path), variables["agent"]
    states = torch.tensor(observations).float() - checkpoint["mean"]
    assert torch.equal(agent.actor(states / checkpoint["std"]), actions)
    envs = wpc.make_envs("halfcheetah", 2)
    mean, std = checkpoint["mean"], checkpoint["std"]
    returns = wpc.evaluate(envs, agent.actor, mean, std, seed=0)
    played = " ".join(f"{x:.2f}" for x in returns)
    assert played == read_rows(tmp_path)[-1]["returns"]


if __name__ == "__main__":
    rows = iter(map_rows())
    text = MAP_ROW.sub(lambda _: next(rows), README)
    (ROOT / "README.md").write_text(DIFF.sub(lambda _: real_diff(), text))
