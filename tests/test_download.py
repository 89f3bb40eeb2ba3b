# SPDX-License-Identifier: MIT
"""Downloads of D4RL's files, from servers here that answer well and badly."""

import contextlib
import hashlib
import http.server
import io
import re
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import h5py
import numpy as np
import pytest
from conftest import ROOT, files, refusal, wpc

with io.BytesIO() as buffer:
    with h5py.File(buffer, "w") as hdf5:
        hdf5["noise"] = np.random.default_rng(0).normal(size=40_000)
    CONTENT = buffer.getvalue()
TASK, NAME = "hopper-medium-replay-v2", "hopper_medium_replay-v2.hdf5"
NOBODY = "http://127.0.0.1:9/"  # refuses connections
DIGESTS = ROOT / "tests/data/d4rl_v2.sha256"
TEXT = DIGESTS.read_text()


class Server(http.server.ThreadingHTTPServer):
    """A server for D4RL's files: `answer` maps a request's handler to what it sends."""

    def __init__(self, answer):
        methods = {"do_GET": answer, "log_message": lambda *_: None}
        handler = type("Handler", (http.server.BaseHTTPRequestHandler,), methods)
        super().__init__(("127.0.0.1", 0), handler)
        threading.Thread(target=self.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.server_address[1]}/"

    def server_close(self):
        self.shutdown()  # or its thread would spin on the closed socket
        super().server_close()


def send(handler, content, length=None):
    if handler.path != f"/{NAME}":
        return handler.send_error(404)
    handler.send_response(200)
    handler.send_header("Content-Length", length or len(content))
    handler.end_headers()
    handler.wfile.write(content)


ANSWERS = {
    "whole": lambda h: send(h, CONTENT),
    "cut short": lambda h: send(h, CONTENT[:100_000], len(CONTENT)),
    "404": lambda h: h.send_error(404),
    "page": lambda h: send(h, b"<html>Please sign in</html>"),
    "half": lambda h: send(h, CONTENT[:150_000]),  # as if that were all
    "slow": lambda h: (time.sleep(1), send(h, CONTENT)),
}


@pytest.fixture
def servers(monkeypatch, tmp_path):
    """Starts two servers that answer so (None: nobody listens), and an empty folder."""
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path / "d4rl"))
    with contextlib.ExitStack() as stack:

        def call(*answers):
            urls = [
                stack.enter_context(Server(ANSWERS[answer])).url if answer else NOBODY
                for answer in answers
            ]
            monkeypatch.setattr(wpc, "D4RL_SERVERS", urls)

        yield call


GOOD = [("whole", None), (None, "whole"), ("404", "whole"), ("cut short", "whole")]
GOOD += [("page", "whole"), ("half", "whole")]


@pytest.mark.parametrize("answers", GOOD)
def test_the_first_server_that_has_the_file(servers, tmp_path, answers):
    servers(*answers)
    assert wpc.download_dataset(TASK).read_bytes() == CONTENT
    assert files(tmp_path / "d4rl") == {NAME: CONTENT}
    servers(None, None)
    assert wpc.download_dataset(TASK).read_bytes() == CONTENT  # nobody is asked


BAD = [(None, None), ("404", "cut short"), ("page", "half")]


@pytest.mark.parametrize("answers", BAD)
def test_no_server_has_the_file(servers, tmp_path, answers):
    servers(*answers)
    sentence = refusal(wpc, "python", "wpc.py", "--env", TASK)
    for part in (str(tmp_path / "d4rl" / NAME), "D4RL_DATASET_DIR", "--dataset"):
        assert part in sentence
    assert not (tmp_path / "d4rl").exists() or files(tmp_path / "d4rl") == {}
    servers("whole", None)  # and the next start finds it
    assert wpc.download_dataset(TASK).read_bytes() == CONTENT


def test_without_a_home_folder(servers, monkeypatch, tmp_path):
    servers(None, None)
    monkeypatch.delenv("D4RL_DATASET_DIR")
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)  # raises KeyError
    monkeypatch.chdir(tmp_path)
    sentence = refusal(wpc, "python", "wpc.py", "--env", TASK)
    assert "is missing: give a --dataset, or set D4RL_DATASET_DIR" in sentence


def test_two_jobs_that_download_one_file(servers, tmp_path):
    """Each writes a file of its own, so that none finds another's half."""
    servers("slow", None)
    with ThreadPoolExecutor(3) as pool:
        paths = list(pool.map(wpc.download_dataset, [TASK] * 3))
    assert [path.read_bytes() for path in paths] == [CONTENT] * 3
    assert files(tmp_path / "d4rl") == {NAME: CONTENT}


def test_a_file_that_another_process_has_meanwhile_is_taken(servers, tmp_path, capsys):
    servers(None, None)
    path = tmp_path / "d4rl" / NAME

    def refuse(*_, **__):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(CONTENT)
        raise OSError("refused")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wpc, "urlopen", refuse)
        assert wpc.download_dataset(TASK) == path
    assert capsys.readouterr().out.count("downloading from") == 1


def test_d4rls_own_folder_is_in_the_home_folder(servers, monkeypatch, tmp_path):
    servers("whole", None)
    monkeypatch.delenv("D4RL_DATASET_DIR")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert wpc.download_dataset(TASK) == tmp_path / ".d4rl/datasets" / NAME
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    assert "D4RL_DATASET_DIR" in refusal(wpc, "python", "wpc.py", "--env", TASK)


def test_names_and_digests_are_d4rls(monkeypatch, tmp_path):
    """The digests against a sample copied by hand from the published list."""
    pattern = re.compile(r"([0-9a-f]{64})  (\S+)\n")
    digests = {name: digest[:16] for digest, name in pattern.findall(TEXT)}
    assert len(digests) == 18 == len(TEXT.splitlines())
    assert digests["hopper_medium-v2.hdf5"] == "5bdf1bc4a713c829"
    assert digests["walker2d_medium_replay-v2.hdf5"] == "e75de96a4f77acf7"
    assert digests["halfcheetah_expert-v2.hdf5"] == "d9fe53bb994eb1e2"

    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path))
    for name in digests:
        (tmp_path / name).touch()
    kinds = ["random", "medium", "expert"]
    kinds += ["medium-replay", "full-replay", "medium-expert"]
    for robot in wpc.D4RL_ROBOTS:
        for kind in kinds:
            path = wpc.download_dataset(f"{robot}-{kind}-v2")
            assert path == wpc.download_dataset(f"{robot}-{kind}")  # as papers call it
            del digests[path.name]
    assert digests == {}


def test_sha256sum_reads_the_digests(tmp_path):
    (tmp_path / NAME).write_bytes(CONTENT)
    line = ["sha256sum", "--check", "--ignore-missing", DIGESTS]
    process = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True)
    assert process.stdout == f"{NAME}: FAILED\n", process
    digest = hashlib.sha256(CONTENT).hexdigest()
    text = re.sub(rf".*  {NAME}", f"{digest}  {NAME}", TEXT)
    (tmp_path / "digests").write_text(text)
    process = subprocess.run([*line[:-1], "digests"], cwd=tmp_path, capture_output=True)
    assert process.returncode == 0
