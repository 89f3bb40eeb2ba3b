#!/usr/bin/env bash
# torch 2.13.0: torch.compile on a CPU loses the change of a float64 tensor without axes.
#
# Expected: a compiled function that does p.mul_(0.5) on its input changes p, and goes on
#   with the new value, as it does when it is not compiled. (Optimizers keep such numbers:
#   the powers of Adam's betas, a step count, a temperature.)
# Seen: with float64 the input keeps its old value, and so does what is computed after it:
#   x / (1 - p) is inf where it is 2. No warning. The backend "aot_eager" does so, too, so
#   it is not the generated code; with float32, with one axis, or with the backend "eager",
#   all is as expected.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 numpy==2.4.6
TORCHINDUCTOR_CACHE_DIR=$folder/cache "$folder/venv/bin/python" - <<'PYTHON'
import torch


def step(p, x):
    p.mul_(0.5)
    return x / (1 - p)


def result(dtype, shape, backend):
    p, x = torch.ones(shape, dtype=dtype), torch.ones(1, dtype=torch.float32)
    torch._dynamo.reset()
    y = torch.compile(step, backend=backend)(p, x)
    return p.item(), y.item()


print("dtype    axes  backend     p    x / (1 - p); expected 0.5 and 2.0")
seen = {}
for backend in ("eager", "aot_eager", "inductor"):
    for dtype in (torch.float32, torch.float64):
        for shape in ((1,), ()):
            seen[dtype, len(shape), backend] = p, y = result(dtype, shape, backend)
            print(f"{str(dtype)[6:]}  {len(shape)}     {backend:9}  {p}  {y}")
wrong = [key for key, values in seen.items() if values != (0.5, 2.0)]
assert wrong == [(torch.float64, 0, x) for x in ("aot_eager", "inductor")], wrong
PYTHON
