# SPDX-License-Identifier: MIT
"""The scripts share no code: what they have in common is the same text in each, so that
`diff` shows the algorithm and nothing else. And they stay small.

tests/diffs/ holds the differences as they should be. To change them on purpose, run

    python tests/test_twins.py
"""

import ast
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


# Size: what the user ordered is minimal. A line more has to take the place of another.

LINES, NODES, FUNCTION, DIFF = 560, 4_100, 70, 45


def size(name):
    """A script's lines and the nodes of its syntax tree."""
    text = (ROOT / f"{name}.py").read_text()
    return len(text.splitlines()), len(list(ast.walk(ast.parse(text))))


def test_scripts_stay_small():
    lines, nodes = size("wpc")
    assert lines <= LINES and nodes <= NODES
    for name in ("td3_bc", "wbc"):
        assert size(name)[0] < lines and size(name)[1] < nodes


@pytest.mark.parametrize("name", NAMES)
def test_a_function_fits_on_a_screen_and_the_algorithm_in_the_first_half(name):
    tree = ast.parse((ROOT / f"{name}.py").read_text())
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    assert max(f.end_lineno - f.lineno + 1 for f in functions) <= FUNCTION
    (update,) = [f for f in functions if f.name == "update"]
    assert update.end_lineno < size(name)[0] / 2


def test_the_diff_is_short():
    changed = [line for line in real_diff("td3_bc", "wpc") if line[0] in "<>"]
    assert len(changed) <= DIFF
    readme = (ROOT / "README.md").read_text()
    assert f"shows all that wPC adds, in {len(changed)} changed lines" in readme


@pytest.mark.parametrize("action", [["check"], ["format", "--check"]])
def test_ruff_agrees(action):
    line = [sys.executable, "-m", "ruff", *action, "."]
    process = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr


if __name__ == "__main__":
    for pair in PAIRS:
        stored_diff(*pair).write_text("\n".join(real_diff(*pair)) + "\n")
