"""Detect the strongest cell of each beam."""

from dataclasses import dataclass

import numpy as np

from fls_flow import Detections, Ping, hookimpl


@dataclass
class Peaks:
    """The strongest cell of each beam, if it is `margin_db` above the beam's median."""

    margin_db: float = 15.0

    def __call__(self, ping: Ping) -> Detections:
        image = ping.amplitude.astype(float) if ping.amplitude.size else np.zeros((1, 0))
        row, beam = image.argmax(axis=0), np.arange(image.shape[1])
        loud = image[row, beam] > np.median(image, axis=0) * 10 ** (self.margin_db / 20)
        row, beam = row[loud], beam[loud]
        return Detections.of(
            ping, range_m=ping.range_m[row], bearing_rad=ping.bearing_rad[beam], amplitude=image[row, beam]
        )


@hookimpl
def fls_node() -> type[Peaks]:
    return Peaks
