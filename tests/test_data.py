# SPDX-License-Identifier: MIT
"""The way from an HDF5 file to transitions, against a slow loop, on files of every kind; bad files; downloads."""

import contextlib
import hashlib
import http.server
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from conftest import DATASET, ROOT, d4rl_arrays, wpc, write_hdf5
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st


def slow_transitions(arrays):
    """d4rl.qlearning_dataset row by row, and the episodes' rewards; the 1000 steps counted from each episode's start."""
    rows, rewards = len(arrays["rewards"]), np.asarray(arrays["rewards"]).reshape(-1)
    transitions, episodes, episode = [], [], []
    for i in range(rows):
        episode.append((i, float(np.float32(rewards[i]))))
        terminal = bool(arrays["terminals"][i])
        timeout = bool(arrays["timeouts"][i]) if "timeouts" in arrays else len(episode) == 1000
        if not timeout and i + 1 < rows:
            o, a = arrays["observations"], arrays["actions"]
            transitions.append((i, [*o[i], *a[i], rewards[i], 1 - terminal, *o[i + 1]]))
        if terminal or timeout or i + 1 == rows:
            episodes.append(episode)
            episode = []
    return transitions, episodes


@st.composite
def files(draw):
    """Arrays of a random file: sizes, ends of episodes, types, shapes, with and without timeouts, and other groups."""
    rows, seed = draw(st.integers(2, 60)), draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    float_type = draw(st.sampled_from([np.float32, np.float64]))
    flag_type = draw(st.sampled_from([bool, np.uint8, np.float32]))
    ends = st.lists(st.sampled_from(["", "", "", "terminal", "timeout", "both"]), min_size=rows, max_size=rows)
    ends = np.array(draw(ends))
    arrays = {
        "observations": rng.normal(3, 2, (rows, draw(st.integers(1, 4)))).astype(float_type),
        "actions": rng.uniform(-1, 1, (rows, draw(st.integers(1, 3)))).astype(float_type),
        "rewards": rng.normal(size=draw(st.sampled_from([(rows,), (rows, 1)]))).astype(float_type),
        "terminals": np.isin(ends, ["terminal", "both"]).astype(flag_type),
    }
    if draw(st.booleans()):
        arrays["timeouts"] = np.isin(ends, ["timeout", "both"]).astype(flag_type)
    if draw(st.booleans()):
        arrays["next_observations"] = np.full((rows, 1), np.nan)  # not used
        arrays |= {"infos/qpos": np.zeros((rows, 2)), "metadata/algorithm": "SAC", "metadata/policy/output": 3}
    return arrays


def assert_loads_as_the_loop(path, arrays, normalize=True, discount=0.9):
    obs_dim, action_dim = arrays["observations"].shape[1], arrays["actions"].shape[1]
    args = wpc.Args(normalize=normalize, discount=discount)
    expected, episodes = slow_transitions(arrays)
    if not expected:
        with pytest.raises(SystemExit, match="no transitions"):
            wpc.load_dataset(path, obs_dim, action_dim, args)
        return
    transitions, mean, std, widths, returns, best_return = wpc.load_dataset(path, obs_dim, action_dim, args)
    assert widths == [obs_dim, action_dim, 1, 1, obs_dim, 1]
    index, table = [i for i, _ in expected], np.array([row for _, row in expected], np.float32).astype(np.float64)
    if normalize:
        o = table[:, :obs_dim]
        expected_mean, expected_std = o.mean(0), o.std(0) + 1e-3
        for columns in (slice(0, obs_dim), slice(obs_dim + action_dim + 2, None)):
            table[:, columns] = (table[:, columns] - expected_mean) / expected_std
    else:
        expected_mean, expected_std = np.zeros(obs_dim), np.ones(obs_dim)
    assert mean.numpy() == pytest.approx(expected_mean, rel=1e-5, abs=1e-6)
    assert std.numpy() == pytest.approx(expected_std, rel=1e-5)
    assert transitions.dtype == mean.dtype == std.dtype == torch.float32
    assert transitions[:, :-1].numpy() == pytest.approx(table, rel=1e-4, abs=1e-4)
    totals = [sum(r for _, r in episode) for episode in episodes]
    assert returns == pytest.approx(totals, rel=1e-6, abs=1e-6)
    assert best_return == pytest.approx(max(sum(r * discount**t for t, (_, r) in enumerate(e)) for e in episodes), abs=1e-5)
    best = sorted(range(len(totals)), key=lambda e: (-totals[e], e))[: (len(totals) + 1) // 2]
    half = {i for e in best for i, _ in episodes[e]}
    assert transitions[:, -1].tolist() == [float(i in half) for i in index]


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(arrays=files(), normalize=st.booleans())
def test_transitions_of_random_files(tmp_path, arrays, normalize):
    assert_loads_as_the_loop(write_hdf5(tmp_path / "data.hdf5", arrays), arrays, normalize)


@pytest.mark.parametrize("terminals", [[], [500], [999], [1000], [10, 1009], [10, 1010, 1011, 3300]])
def test_without_timeouts_an_episode_ends_after_1000_steps(tmp_path, terminals):
    arrays = d4rl_arrays(3500, 2, 1)
    del arrays["timeouts"]
    arrays["terminals"] = np.isin(np.arange(3500), terminals)
    assert_loads_as_the_loop(write_hdf5(tmp_path / "data.hdf5", arrays), arrays)


def test_a_dropped_row_by_hand(tmp_path):
    arrays = d4rl_arrays(6, 1, 1)
    arrays["observations"] = np.arange(6, dtype=np.float32)[:, None]
    arrays["terminals"], arrays["timeouts"] = np.array([0, 0, 1, 0, 1, 0], bool), np.array([0, 1, 0, 0, 1, 0], bool)
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    transitions = wpc.load_dataset(path, 1, 1, wpc.Args(normalize=False))[0].numpy()
    assert transitions[:, 0].tolist() == [0, 2, 3]  # 1: timeout; 4: terminal and timeout; 5: last
    assert transitions[:, 3].tolist() == [1, 0, 1]  # 2 is terminal and stays, not_done = 0
    assert transitions[:, 4].tolist() == [1, 3, 4]


@pytest.mark.parametrize("returns, half", [([1, 3, 2], [0, 1, 1]), ([5, 5, 5, 5], [1, 1, 0, 0]), ([1, 2, 2], [0, 1, 1])])
def test_static_weight_is_the_better_half_rounded_up_and_of_equals_the_earlier(tmp_path, returns, half):
    arrays = d4rl_arrays(2 * len(returns), 1, 1)
    arrays["rewards"] = np.repeat(np.float32(returns) / 2, 2)
    arrays["terminals"] = np.arange(2 * len(returns)) % 2 == 1
    arrays["timeouts"] = np.zeros(2 * len(returns), bool)
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    columns = wpc.load_dataset(path, 1, 1, wpc.Args())[0][:, -1].tolist()
    assert columns == [float(h) for h in half for _ in range(2)][:-1]  # the file's last row is no transition


def test_scripts_load_alike(script):
    args = script.Args()
    ours, theirs = (s.load_dataset(DATASET, 17, 6, args) for s in (script, wpc))
    assert (ours[0] == theirs[0][:, : ours[0].shape[1]]).all() and (ours[1] == theirs[1]).all() and (ours[2] == theirs[2]).all()


def without(key):
    return lambda a: a.pop(key)


def replaced(key, change):
    return lambda a: a.update({key: change(a[key])})


def with_value(key, value):
    def change(array):
        array = array.astype(np.float64)
        array[7] = value
        return array

    return replaced(key, change)


BAD = [
    (without("observations"), "'observations' is missing"),
    (without("actions"), "'actions' is missing"),
    (without("rewards"), "'rewards' is missing"),
    (without("terminals"), "'terminals' is missing"),
    (replaced("actions", lambda x: x[:-1]), r"'actions' is \(39, 6\), where \(40, 6\) was expected"),
    (replaced("rewards", lambda x: np.stack([x, x], 1)), r"'rewards' is \(40, 2\), where \(40, 1\)"),
    (replaced("timeouts", lambda x: x[:-2]), r"'timeouts' is \(38,\)"),
    (replaced("terminals", lambda x: np.bool_(True)), r"'terminals' is \(\)"),
    (replaced("observations", lambda x: x[:, :11]), r"'observations' is \(40, 11\), where \(40, 17\)"),
    (replaced("actions", lambda x: x[:, :3]), r"'actions' is \(40, 3\), where \(40, 6\)"),
    (with_value("observations", np.nan), "'observations' is not finite in row 7"),
    (with_value("actions", -np.inf), "'actions' is not finite in row 7"),
    (with_value("rewards", 1e300), "'rewards' is not finite in row 7"),  # beyond float32
    (with_value("terminals", np.nan), "'terminals' is not finite in row 7"),
    (replaced("rewards", lambda x: np.array([b"one"] * 40)), "damaged"),
    (lambda a: a.update({k: v[:0] for k, v in a.items()}), "has no transitions, only 0 rows"),
    (lambda a: a.update({k: v[:1] for k, v in a.items()}), "has no transitions, only 1 rows"),
    (lambda a: a.update(timeouts=np.ones(40, bool)), "has no transitions, only 40 rows"),
    (lambda a: a.update({"rewards/inner": a.pop("rewards")}), "'rewards' is missing"),
]


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
@pytest.mark.parametrize("spoil, sentence", BAD, ids=[sentence for _, sentence in BAD])
def test_bad_datasets_are_refused_in_one_sentence(tmp_path, spoil, sentence):
    arrays = d4rl_arrays(40)
    spoil(arrays)
    path = write_hdf5(tmp_path / "data.hdf5", arrays)
    with pytest.raises(SystemExit, match=sentence) as stop:
        wpc.load_dataset(path, 17, 6, wpc.Args())
    assert str(path) in stop.value.code and "\n" not in stop.value.code


@pytest.mark.parametrize("content", [b"", b"no HDF5", DATASET.read_bytes()[:100_000]], ids=["empty", "text", "cut short"])
def test_files_that_are_no_hdf5_or_cut_short(tmp_path, content):
    path = tmp_path / "data.hdf5"
    path.write_bytes(content)
    with pytest.raises(SystemExit, match="is no HDF5 file, or is damaged or cut short"):
        wpc.load_dataset(path, 17, 6, wpc.Args())


def test_a_million_rows_load_in_seconds_within_three_times_their_size(tmp_path):
    """One file of each kind of D4RL's, full size, HalfCheetah's width for the largest; peak memory of a fresh process."""
    for kind, rows, obs_dim, action_dim, dtype in [
        ("medium", 1_000_000, 11, 3, np.float32),
        ("medium-replay", 402_000, 11, 3, np.float64),
        ("medium-expert", 2_000_000, 17, 6, np.float32),
    ]:
        path = tmp_path / f"{kind}.hdf5"
        arrays = {
            "observations": np.ones((rows, obs_dim), dtype),
            "actions": np.zeros((rows, action_dim), dtype),
            "rewards": np.ones(rows, dtype),
            "terminals": np.zeros(rows, bool),
            "timeouts": np.arange(rows) % 1000 == 999,
            "next_observations": np.zeros((rows, 1), dtype),
            "infos/action_log_probs": np.zeros(rows, dtype),
            "infos/qpos": np.zeros((rows, 2), dtype),
            "metadata/algorithm": np.bytes_("SAC"),
            "metadata/iteration": 5,
            "metadata/policy/fc0/weight": np.zeros((256, obs_dim), dtype),
            "metadata/policy/nonlinearity": "relu",
        }
        write_hdf5(path, arrays)
        program = (
            "import time, wpc\n"
            "peak = lambda: 1024 * int(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])\n"
            "before, start = peak(), time.perf_counter()\n"
            f"data = wpc.load_dataset({str(path)!r}, {obs_dim}, {action_dim}, wpc.Args())\n"
            "print(time.perf_counter() - start, (peak() - before) / data[0].nbytes, len(data[0]))\n"
        )
        output = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        seconds, memory, transitions = map(float, output.split())
        print(f"{kind}: {rows:,} rows in {seconds:.1f} s, peak {memory:.2f} times the transitions")
        assert transitions == rows - rows // 1000
        assert seconds < 30 and 1 < memory < 3
        path.unlink()


class Server(http.server.ThreadingHTTPServer):
    """D4RL's server on this machine: `answer` maps a request handler to what it sends."""

    def __init__(self, answer):
        methods = {"do_GET": answer, "log_message": lambda *_: None}
        super().__init__(("127.0.0.1", 0), type("Handler", (http.server.BaseHTTPRequestHandler,), methods))
        threading.Thread(target=self.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.server_address[1]}/"

    def server_close(self):
        self.shutdown()  # or its thread would spin on the closed socket
        super().server_close()


CONTENT = np.random.default_rng(0).bytes(300_000)


def send(handler, content, length=None, pause=0):
    handler.send_response(200)
    handler.send_header("Content-Length", length or len(content))
    handler.end_headers()
    for i in range(0, len(content), 50_000):
        time.sleep(pause)
        handler.wfile.write(content[i : i + 50_000])


ANSWERS = {
    "whole": lambda h: send(h, CONTENT),
    "slow": lambda h: send(h, CONTENT, pause=0.05),
    "cut short": lambda h: send(h, CONTENT[:100_000], len(CONTENT)),
    "wrong bytes": lambda h: send(h, CONTENT[::-1]),
    "404": lambda h: h.send_error(404),
}


@pytest.fixture
def download(monkeypatch, tmp_path):
    """Calls dataset_path with servers that answer so (None: nobody listens); returns the path and its folder."""
    digests = " ".join([hashlib.sha256(CONTENT).hexdigest()[:16]] * len(wpc.KINDS))
    monkeypatch.setattr(wpc, "SHA256", {"hopper": digests})
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path / "d4rl"))
    with contextlib.ExitStack() as stack:

        def call(*answers):
            servers = [stack.enter_context(Server(ANSWERS[a])) if a else None for a in answers]
            for name, server in zip(("SERVER", "MIRROR"), servers):
                monkeypatch.setattr(wpc, name, server.url if server else "http://127.0.0.1:9/")
            return wpc.dataset_path(wpc.Args(env="hopper-medium-replay-v2"))

        yield call


def folder(tmp_path):
    return {p.name: p.read_bytes() for p in (tmp_path / "d4rl").iterdir()}


WHOLE = {"hopper_medium_replay-v2.hdf5": CONTENT}


@pytest.mark.parametrize("answers", [("whole", None), (None, "whole"), ("404", "whole"), ("cut short", "whole"), ("wrong bytes", "whole")])
def test_download_from_the_first_server_that_has_it(download, tmp_path, answers):
    assert download(*answers).read_bytes() == CONTENT
    assert folder(tmp_path) == WHOLE
    assert download(None, None).read_bytes() == CONTENT  # there now: no server is asked


@pytest.mark.parametrize("answers, reason", [((None, None), "refused"), (("404", "404"), "404"), (("cut short", "wrong bytes"), "hash")])
def test_no_server_has_it(download, tmp_path, answers, reason):
    with pytest.raises(SystemExit, match=reason) as stop:
        download(*answers)
    for part in (str(tmp_path / "d4rl/hopper_medium_replay-v2.hdf5"), "--dataset", "tests/data/halfcheetah_replay.hdf5"):
        assert part in stop.value.code
    assert folder(tmp_path) == {}


def test_two_downloads_at_once(download, tmp_path):
    other = threading.Thread(target=download, args=("slow", None))
    other.start()
    time.sleep(0.1)
    download("slow", None)
    other.join()
    assert folder(tmp_path) == WHOLE


def test_tasks_are_d4rls():
    """Names, and the digests as published, for a sample that was copied by hand."""
    assert len([f"{robot}-{kind}-v2" for robot in wpc.ROBOTS for kind in wpc.KINDS]) == 18
    assert all(len(digests.split()) == len(wpc.KINDS) for digests in wpc.SHA256.values())
    assert wpc.SHA256["hopper"].split()[wpc.KINDS.index("medium")] == "5bdf1bc4a713c829"
    assert wpc.SHA256["walker2d"].split()[wpc.KINDS.index("medium-replay")] == "e75de96a4f77acf7"
    assert wpc.SHA256["halfcheetah"].split()[wpc.KINDS.index("expert")] == "d9fe53bb994eb1e2"
