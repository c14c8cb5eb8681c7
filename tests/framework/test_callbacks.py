"""Zenoh's threads call back, and keep their state in Python."""

import json
import subprocess
import sys
import threading

import pytest

from fls_flow.links._callbacks import Kept

# In a process of its own: Zenoh's threads serve all sessions of a process. What is local to a thread dies with
# its state in Python, so it tells how many states there were.
SCRIPT = """
import json, socket, sys, threading, time
import zenoh
from fls_flow.links._callbacks import Kept

def opened(port, where):
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5(where + "/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    return zenoh.open(config)

with socket.socket() as probe:
    probe.bind(("127.0.0.1", 0))
    port = probe.getsockname()[1]
local, states, calls = threading.local(), [], []

def heard(sample):
    if not hasattr(local, "seen"):
        local.seen = True
        states.append(1)
    calls.append(threading.get_ident())

with opened(port, "listen") as giver, opened(port, "connect") as taker:
    callback = Kept()(heard) if sys.argv[1] == "kept" else heard
    subscriber = taker.declare_subscriber("a/b", zenoh.handlers.Callback(callback, indirect=False))
    publisher = giver.declare_publisher("a/b")
    while not publisher.matching_status.matching:
        time.sleep(0.01)
    for number in range(20):
        publisher.put(b"x")
        while len(calls) <= number:
            time.sleep(0.002)
print(json.dumps({"calls": len(calls), "threads": len(set(calls)), "states": len(states)}))
"""


@pytest.mark.parametrize("way", ["kept", "plain"])
def test_a_thread_that_calls_back_keeps_its_state(way: str) -> None:
    run = subprocess.run([sys.executable, "-c", SCRIPT, way], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    seen = json.loads(run.stdout)
    assert seen["calls"] == 20
    # without it each call has a new one: if that fails, Zenoh keeps the state itself and `Kept` can go
    assert seen["states"] == (seen["threads"] if way == "kept" else 20)
    assert seen["threads"] < 20


def test_one_serves_several_callbacks() -> None:
    kept, heard = Kept(), []
    first, second = kept(heard.append), kept(heard.append)
    caller = threading.Thread(target=lambda: (first("a"), second("b"), first("c")))
    caller.start()
    caller.join()
    assert heard == ["a", "b", "c"]
