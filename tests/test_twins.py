# SPDX-License-Identifier: MIT
"""The scripts share no code: what they have in common is the same text in each, so that
`diff` shows the algorithm and nothing else.

tests/diffs/ holds the differences as they should be. To change them on purpose, run

    python tests/test_twins.py
"""

import difflib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAMES = ["wpc", "td3_bc", "wbc"]
PAIRS = [("td3_bc", "wpc"), ("wbc", "wpc"), ("td3_bc", "wbc")]


def real_diff(one, other):
    """What `diff` prints, without the line numbers, which any change above moves."""
    line = ["diff", f"{one}.py", f"{other}.py"]
    output = subprocess.run(line, cwd=ROOT, capture_output=True, text=True).stdout
    lines = output.splitlines()
    return ["@@" if line[0].isdigit() else line for line in lines]


def stored_diff(one, other):
    return ROOT / f"tests/diffs/{one}-{other}.diff"


@pytest.mark.parametrize("one, other", PAIRS)
def test_scripts_differ_as_stored(one, other):
    stored = stored_diff(one, other).read_text().splitlines()
    drift = difflib.unified_diff(
        stored, real_diff(one, other), "stored", "now", n=1, lineterm=""
    )
    text = "\n".join(drift)
    assert not text, (
        "A line that was the same in two scripts, or differed otherwise, has changed. "
        "Change the other script too or, if this is meant, run "
        f"`python tests/test_twins.py`:\n{text}"
    )


@pytest.mark.parametrize("name", NAMES)
def test_scripts_stand_alone(name):
    text = (ROOT / f"{name}.py").read_text()
    for other in NAMES:
        assert f"import {other}" not in text and f"from {other}" not in text


@pytest.mark.parametrize("action", [["check"], ["format", "--check"]])
def test_ruff_agrees(action):
    line = [sys.executable, "-m", "ruff", *action, "."]
    process = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr


if __name__ == "__main__":
    for pair in PAIRS:
        stored_diff(*pair).write_text("\n".join(real_diff(*pair)) + "\n")
