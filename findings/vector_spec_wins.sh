#!/usr/bin/env bash
# Gymnasium 1.4.0: make_vec, given the spec of a vector environment, ignores what it is
# called with.
#
# Expected: make_vec(envs.spec, num_envs=2, vectorization_mode="async", wrappers=[]) makes
#   two environments in processes of their own, without wrappers: what is named in the
#   call stands above what the spec had, as with make(spec, ...) and with the arguments
#   of the environment itself.
# Seen: three environments in this process, with the wrapper that the spec was made with,
#   and no warning. An argument of the environment (g) is taken from the call. A spec of
#   one environment doesn't keep the number, so there num_envs is taken from the call, too.
# So an evaluation that takes envs.spec of training with num_envs=1 plays as many as there.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q gymnasium==1.4.0 numpy==2.4.6
cat > "$folder/look.py" <<'P'
import gymnasium as gym


class Half(gym.RewardWrapper):
    def reward(self, reward):
        return reward / 2


if __name__ == "__main__":
    made = {"vectorization_mode": "sync", "wrappers": [Half]}
    spec = gym.make_vec("Pendulum-v1", 3, **made).spec
    asked = {"vectorization_mode": "async", "wrappers": []}
    envs = gym.make_vec(spec, num_envs=2, **asked, g=1.0)
    inner = getattr(envs, "envs", [None])[0]
    seen = type(envs).__name__, envs.num_envs, "Half" in str(inner)
    print("asked for 2 in processes, without wrappers, with g = 1; seen:", *seen)
    print("g is", inner.unwrapped.g)
    plain = gym.make_vec(gym.spec("Pendulum-v1"), num_envs=2, vectorization_mode="sync")
    one = gym.make_vec("Pendulum-v1", 1, vectorization_mode="sync").spec
    two = gym.make_vec(one, num_envs=2)
    print("of a plain spec:", plain.num_envs, "and of a spec of one:", two.num_envs)
    assert seen == ("SyncVectorEnv", 3, True) and inner.unwrapped.g == 1.0
    assert plain.num_envs == two.num_envs == 2
P
"$folder/venv/bin/python" "$folder/look.py"
