# SPDX-License-Identifier: MIT
"""Downloads of D4RL's files, from servers here that answer well and badly."""

import contextlib
import hashlib
import http.server
import re
import subprocess
import sys
import threading

import numpy as np
import pytest
from conftest import ROOT, files, refusal, wpc

CONTENT = np.random.default_rng(0).bytes(300_000)
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


@pytest.mark.parametrize("answers", GOOD)
def test_the_first_server_that_has_the_file(servers, tmp_path, answers):
    servers(*answers)
    assert wpc.download_dataset(TASK).read_bytes() == CONTENT
    assert files(tmp_path / "d4rl") == {NAME: CONTENT}
    servers(None, None)
    assert wpc.download_dataset(TASK).read_bytes() == CONTENT  # nobody is asked


@pytest.mark.parametrize("answers", [(None, None), ("404", "cut short")])
def test_no_server_has_the_file(servers, tmp_path, answers):
    servers(*answers)
    sentence = refusal(wpc, "python", "wpc.py", "--env", TASK)
    for part in (str(tmp_path / "d4rl" / NAME), "D4RL_DATASET_DIR", "--dataset"):
        assert part in sentence
    assert NAME not in files(tmp_path / "d4rl")


def test_d4rls_own_folder_is_in_the_home_folder(servers, monkeypatch, tmp_path):
    servers("whole", None)
    monkeypatch.delenv("D4RL_DATASET_DIR")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert wpc.download_dataset(TASK) == tmp_path / ".d4rl/datasets" / NAME
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    assert "D4RL_DATASET_DIR" in refusal(wpc, "python", "wpc.py", "--env", TASK)


@pytest.mark.parametrize("name", ["ant-medium-v2", "HalfCheetah-v4", "hoper-medium-v2"])
def test_no_server_is_asked_for_other_names(monkeypatch, capsys, name):
    monkeypatch.setattr(wpc, "download_dataset", pytest.fail)
    monkeypatch.setattr(wpc, "make_envs", pytest.fail)
    monkeypatch.setattr(sys, "argv", ["wpc.py", "--env", name])
    with pytest.raises(SystemExit) as stop:
        wpc.main()
    assert stop.value.code == 2
    assert f"{name} can't be downloaded: it needs --dataset" in capsys.readouterr().err


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
