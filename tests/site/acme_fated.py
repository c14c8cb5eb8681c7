"""A node that does what no node should, at one ping or as it closes."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from fls_flow import Detections, Ping, hookimpl


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def die_unnamed() -> None:
    os.kill(os.getpid(), 40)  # a real-time signal


def exit_quietly() -> None:
    os._exit(0)


def leave_program() -> None:
    subprocess.Popen(["sleep", "600"])  # holds the process's output open


def let_go() -> None:
    os.closerange(3, 256)  # as what turns itself into a daemon does
    time.sleep(60.0)


def fork() -> None:
    os.fork()  # the copy comes back too


def fork_and_exit() -> None:
    if os.fork() == 0:
        sys.exit(0)  # which raises, in the copy


def fork_and_die() -> None:
    if os.fork() == 0:
        time.sleep(600)  # holds all that this process holds
    time.sleep(0.2)
    die()


def change_folder() -> None:
    os.chdir("/")


def close_streams() -> None:
    sys.stdout.close()
    sys.stderr.close()


def close_descriptors() -> None:
    os.closerange(0, 3)


def log_long() -> None:
    logging.getLogger("acme").warning("x" * 300_000)


def hold_the_lock() -> None:
    ctypes.PyDLL(None).sleep(20)  # as native code that never lets go of the GIL


@dataclass
class Fated:
    """`fate` names one of the functions above; "unclosable" fails as it closes, "never_made" as it is made."""

    fate: str = ""
    at: int = 5

    def __post_init__(self) -> None:
        parent = Path(f"/proc/{os.getppid()}/cmdline").read_bytes()
        if self.fate == "never_made" and b"nursery" in parent:  # where it is to run, not where it is checked
            time.sleep(60.0)

    def __call__(self, ping: Ping) -> Detections:
        if ping.seq == self.at and self.fate not in ("", "unclosable", "never_made"):
            globals()[self.fate]()
        return Detections(ping.seq, ping.stamp_ns)

    def close(self) -> None:
        if self.fate == "unclosable":
            raise OSError(28, "No space left on device")


@hookimpl
def fls_node() -> type[Fated]:
    return Fated
