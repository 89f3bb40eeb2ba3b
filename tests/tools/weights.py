# SPDX-License-Identifier: MIT
"""Writes a copy of wpc.py that has another of the paper's weights w(s, a).

    python tests/tools/weights.py exponential --out wpc_exponential.py
    python wpc_exponential.py --env hopper-medium-v2

The copy is a script like wpc.py, and compiled.py takes it, too.

- exponential: wPC-e. The weight is exp(A / beta) (eq. 8) with the paper's beta = 1 and
  A = Q - V. Without a limit, exp would overflow: IQL's is 100.
- random: wPC-rnd. The binary weights are shuffled within the batch.
- static: that of Figure 4. The weight is 1 in the episodes whose return is at least the
  median, and 0 in the others.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

WPC = Path(__file__).parents[2] / "wpc.py"
ARGUMENT = "    alpha: float"
EQ_7 = "                weight = (advantage > 0).float()  # eq. 7\n"
DATASET = "    dataset = {k: torch.tensor("
LINES = {
    "exponential": """\
                weight = advantage.exp().clamp(max=100)  # eq. 8, beta = 1
""",
    "random": f"""\
{EQ_7}\
                shuffled = torch.randperm(len(weight), device=weight.device)
                weight = weight.gather(0, shuffled[:, None])  # wPC-rnd
""",
    "static": """\
                weight = batch["better_half"]  # Figure 4
""",
}
BETTER_HALF = """\
    end = (terminals + timeouts).ravel() > 0
    episode = np.cumsum(end) - end  # the number of each row's episode
    returns = np.bincount(episode, arrays["rewards"].ravel())
    better_half = np.float32(returns >= np.median(returns))[episode, None]
    arrays = arrays | {"better_half": better_half}
"""


@dataclass
class Args:
    weight: Annotated[Literal["exponential", "random", "static"], tyro.conf.Positional]
    """the weight"""
    out: Path
    """script to write"""


def with_weight(weight):
    """The text of wpc.py with this weight, which is an argument of its runs."""
    argument = f'    weight: str = "{weight}"\n    """the weight of this script"""\n'
    changes = [(ARGUMENT, argument + ARGUMENT), (EQ_7, LINES[weight])]
    if weight == "static":
        changes.append((DATASET, BETTER_HALF + DATASET))
    text = WPC.read_text()
    for old, new in changes:
        assert text.count(old) == 1, f"not once in wpc.py: {old}"
        text = text.replace(old, new)
    return text


def main(args):
    try:
        args.out.write_text(with_weight(args.weight))
    except OSError as error:
        sys.exit(f"--out can't be written: {error}")
    print(f"to train: {sys.orig_argv[0]} {args.out} --env hopper-medium-v2")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
