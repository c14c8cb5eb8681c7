"""A node that tells how many threads the numerical libraries may use."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from threadpoolctl import threadpool_info

from fls_flow import Detections, Ping, hookimpl


@dataclass
class Threads:
    """Threads of numba, OpenCV, and at most of a BLAS, as ranges."""

    def __call__(self, ping: Ping) -> Detections:
        most = max((pool["num_threads"] for pool in threadpool_info()), default=0)
        values = [float(numba.get_num_threads()), float(cv2.getNumThreads()), float(most)]
        zeros = np.zeros(3)
        return Detections.of(ping, range_m=values, bearing_rad=zeros, amplitude=zeros)


@hookimpl
def fls_node() -> type[Threads]:
    return Threads
