# SPDX-License-Identifier: MIT
"""The scripts share no code, so what they have in common must be the same text: `diff` shows the algorithm and no more.

The expected differences are stored in tests/diffs. After a change that is meant to widen them:

    python tests/test_twins.py
"""

import difflib
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAIRS = [("td3_bc", "wpc"), ("wbc", "wpc"), ("td3_bc", "wbc")]


def diff(one, other):
    """What `diff` prints, without line numbers, which any change above would move."""
    output = subprocess.run(["diff", f"{one}.py", f"{other}.py"], cwd=ROOT, capture_output=True, text=True).stdout
    return ["@@" if line[0].isdigit() else line for line in output.splitlines()]


def stored(one, other):
    return ROOT / f"tests/diffs/{one}-{other}.diff"


@pytest.mark.parametrize("one, other", PAIRS)
def test_scripts_differ_as_stored(one, other):
    drift = list(difflib.unified_diff(stored(one, other).read_text().splitlines(), diff(one, other), "stored", "now", n=1))
    assert not drift, (
        "lines that were the same in both scripts, or differed otherwise, have drifted; mend the script that was left "
        "behind, or, if it is meant, run `python tests/test_twins.py`:\n" + "\n".join(drift)
    )


def test_td3_bc_becomes_wpc_in_forty_lines():
    assert sum(line[0] in "<>" for line in diff("td3_bc", "wpc")) <= 40


@pytest.mark.parametrize("name", ["wpc", "td3_bc", "wbc"])
def test_scripts_stand_alone_and_are_short(name):
    text = (ROOT / f"{name}.py").read_text()
    for other in {"wpc", "td3_bc", "wbc"} - {name}:
        assert f"import {other}" not in text and f"from {other}" not in text
    assert len(text.splitlines()) <= 400


if __name__ == "__main__":
    for pair in PAIRS:
        stored(*pair).parent.mkdir(exist_ok=True)
        stored(*pair).write_text("\n".join(diff(*pair)) + "\n")
