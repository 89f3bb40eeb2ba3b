# SPDX-License-Identifier: MIT
"""Downloads of D4RL's files, from servers here that answer well and badly."""

import contextlib
import hashlib
import http.server
import threading
import time

import numpy as np
import pytest
from conftest import wpc

CONTENT = np.random.default_rng(0).bytes(300_000)
NAME = "hopper_medium_replay-v2.hdf5"


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
    "no HTTP": lambda h: h.wfile.write(b"what?\r\n\r\n"),
}


@pytest.fixture
def download(monkeypatch, tmp_path):
    """Calls download_dataset while two servers answer so (None: nobody listens)."""
    task = "hopper-medium-replay-v2"
    digest = hashlib.sha256(CONTENT).hexdigest()[:16]
    monkeypatch.setattr(wpc, "D4RL_SHA256", {task: digest})
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path / "d4rl"))
    with contextlib.ExitStack() as stack:

        def call(*answers):
            urls = ["http://127.0.0.1:9/"] * 2
            for i, answer in enumerate(answers):
                if answer:
                    urls[i] = stack.enter_context(Server(ANSWERS[answer])).url
            monkeypatch.setattr(wpc, "D4RL_SERVERS", urls)
            return wpc.download_dataset(task)

        yield call


def files(tmp_path):
    return {path.name: path.read_bytes() for path in (tmp_path / "d4rl").iterdir()}


GOOD = [
    ("whole", None),
    (None, "whole"),
    ("404", "whole"),
    ("cut short", "whole"),
    ("wrong bytes", "whole"),
    ("no HTTP", "whole"),
]


@pytest.mark.parametrize("answers", GOOD)
def test_the_first_server_that_has_the_file(download, tmp_path, answers):
    assert download(*answers).read_bytes() == CONTENT
    assert files(tmp_path) == {NAME: CONTENT}
    assert download(None, None).read_bytes() == CONTENT  # it is there: nobody is asked


NONE_HAS_IT = [
    ((None, None), "refused"),
    (("404", "404"), "404"),
    (("cut short", "wrong bytes"), "hash"),
]


@pytest.mark.parametrize("answers, reason", NONE_HAS_IT)
def test_no_server_has_the_file(download, tmp_path, answers, reason):
    with pytest.raises(SystemExit, match=reason) as stop:
        download(*answers)
    for part in (str(tmp_path / "d4rl" / NAME), "--dataset", "halfcheetah_replay.hdf5"):
        assert part in stop.value.code
    assert files(tmp_path) == {}


def test_two_downloads_at_once(download, tmp_path):
    other = threading.Thread(target=download, args=("slow", None))
    other.start()
    time.sleep(0.1)
    download("slow", None)
    other.join()
    assert files(tmp_path) == {NAME: CONTENT}


def test_tasks_and_digests_are_d4rls():
    """Against a sample copied by hand from the published list."""
    assert len(wpc.D4RL_SHA256) == 18
    assert wpc.D4RL_SHA256["hopper-medium-v2"] == "5bdf1bc4a713c829"
    assert wpc.D4RL_SHA256["walker2d-medium-replay-v2"] == "e75de96a4f77acf7"
    assert wpc.D4RL_SHA256["halfcheetah-expert-v2"] == "d9fe53bb994eb1e2"
