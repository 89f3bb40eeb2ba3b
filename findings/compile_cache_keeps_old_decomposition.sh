#!/usr/bin/env bash
# torch 2.13.0: torch.compile's cache on disk doesn't notice that a decomposition changed.
#
# Expected: who puts a decomposition of an operation into Inductor's table, edits it, and
#   runs the program again, gets the new one. (That is how one tries another order of a
#   product, or another approximation of an activation.) At worst, the cache is not used.
# Seen: the second program gets what the first one had compiled. Its decomposition is never
#   called, and its numbers are those of the old one, without a word. Without the cache,
#   or with an empty one, all is as expected.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 numpy==2.4.6
cat >"$folder/program.py" <<'PYTHON'
import sys

import torch
from torch._inductor.decomposition import decompositions

calls = []


def exact(x):
    calls.append(x)
    return x * torch.sigmoid(x)


def piecewise_linear(x):
    calls.append(x)
    return x * (x + 3).clamp(0, 6) / 6


kind = sys.argv[1]
decompositions[torch.ops.aten.silu.default] = globals()[kind]
y = torch.compile(torch.nn.functional.silu)(torch.tensor([1.0, 2.0]))
print(f"{kind}, called {len(calls)} times: {[round(v, 4) for v in y.tolist()]}")
PYTHON
run() { "$folder/venv/bin/python" "$folder/program.py" "$1"; }
export TORCHINDUCTOR_CACHE_DIR=$folder/cache
first=$(run exact)
second=$(run piecewise_linear)
rm -r "$folder/cache"
empty=$(run piecewise_linear)
printf '%s\n' "$first" "$second, where the cache has the first's" "$empty, with an empty cache"
[ "$first" = "exact, called 1 times: [0.7311, 1.7616]" ]
[ "$second" = "piecewise_linear, called 0 times: [0.7311, 1.7616]" ]
[ "$empty" = "piecewise_linear, called 1 times: [0.6667, 1.6667]" ]
