"""A node that comes to a bad end at ping 5, or as it closes."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from dataclasses import dataclass
from typing import Literal

from fls_flow import Detections, Ping, hookimpl

AT = 5


@dataclass
class Fated:
    fate: Literal["die", "leave-program", "let-go", "unclosable", "none"] = "none"

    def __call__(self, ping: Ping) -> Detections:
        if ping.seq == AT and self.fate == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if ping.seq == AT and self.fate == "leave-program":
            subprocess.Popen(["sleep", "600"])  # holds the process's output open
        if ping.seq == AT and self.fate == "let-go":
            os.closerange(3, 256)  # as what turns itself into a daemon does
            time.sleep(60.0)
        return Detections(ping.seq, ping.stamp_ns)

    def close(self) -> None:
        if self.fate == "unclosable":
            raise OSError(28, "No space left on device")


@hookimpl
def fls_node() -> type[Fated]:
    return Fated
