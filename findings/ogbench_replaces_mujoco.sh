#!/usr/bin/env bash
# ogbench 1.2.2 with pip: installing it replaces a MuJoCo that it could use.
#
# Expected: ogbench asks for mujoco>=3.1.6, so pip leaves an installed mujoco 3.15.0 alone.
# Seen: pip takes the newest dm_control, which ogbench asks for without a version and which
#   asks for a newer MuJoCo, and so replaces 3.15.0 by 4.x, where OGBench's antmaze moves
#   otherwise. Named in the same command, mujoco==3.15.0 stays, with an older dm_control.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
pip=$folder/venv/bin/pip
"$pip" install -q --disable-pip-version-check mujoco==3.15.0
would_install() {
    "$pip" install --disable-pip-version-check --dry-run "$@" 2>&1 |
        grep "Would install" | grep -oE "(mujoco|dm[_-]control)-[0-9.]+" | sort -u | tr '\n' ' '
}
alone=$(would_install ogbench==1.2.2)
together=$(would_install ogbench==1.2.2 mujoco==3.15.0)
echo "installed: mujoco-3.15.0"
echo "pip install ogbench==1.2.2 would install:                  $alone"
echo "pip install ogbench==1.2.2 mujoco==3.15.0 would install:   $together"
[[ $alone == *mujoco-4* && $together != *mujoco-* && $together == *control-1.0.48* ]]
