"""Take the still scene away: what is left moves, or has just come."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fls_flow import Ping, hookimpl

FloatImage = npt.NDArray[np.float32]
BoolImage = npt.NDArray[np.bool_]

LARGEST = np.float32(1e18)  # the square of an amplitude is still a float32


@dataclass
class ClutterMap:
    """The ping as height of each cell above its own running background, in standard deviations.

    z = max(0, e / s), e = X - m, X the amplitude smoothed by a Gaussian of `smooth_cells` (range, beam); then
    m += a psi(e), s^2 += a (psi(e)^2 / kappa - s^2), psi(e) = clip(e, -`clip` s, `clip` s), so that a slow
    swimmer does not become background at once; kappa = E[min(z^2, clip^2)] of a normal z makes s unbiased.
    a = max(`rate`, 1 / (k + 1)) at ping k; s begins as the pooled spread between the first two pings and is
    never below `floor`, in steps of the amplitude. The first `warm_up_pings` come out as zeros, and so does
    the first of another size. Cells that are not valid or not finite count for nothing, come out as zeros,
    and are met as background when they first have data. For a sonar that stands still; log-compressed
    samples are welcome.

    Source: Nitzberg 1986 (clutter map); Huber 1964 (clipped recursion); prior mean, signed statistic and ramp
    as in Brinkmann 2010, 4.1, corrected.
    """

    rate: float = 0.05
    warm_up_pings: int = 20
    smooth_cells: tuple[float, float] = (1.5, 1.0)
    clip: float = 2.0
    floor: float = 1.0
    _count: int = field(default=0, init=False, repr=False)
    _mean: FloatImage = field(default_factory=lambda: _no_image(), init=False, repr=False)
    _sd: FloatImage = field(default_factory=lambda: _no_image(), init=False, repr=False)
    _seen: BoolImage = field(default_factory=lambda: np.zeros((0, 0), bool), init=False, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.rate < 1.0:
            raise ValueError(f"rate is {self.rate}; it lies between 0 and 1")
        if self.warm_up_pings < 2:
            raise ValueError(f"warm_up_pings is {self.warm_up_pings}; a variance needs at least 2")
        if min(self.smooth_cells) < 0.0:
            raise ValueError(f"smooth_cells is {self.smooth_cells}; a width is not negative")
        if not self.clip > 0.0:
            raise ValueError(f"clip is {self.clip}; it is greater than 0")
        if not self.floor > 0.0:
            raise ValueError(f"floor is {self.floor}; it is greater than 0")

    def __call__(self, ping: Ping) -> Ping:
        """The normalised ping, float32; geometry, time and navigation as they came."""
        image, known = _smoothed_known(ping, self.smooth_cells)
        if image.shape != self._mean.shape:
            self._count, self._mean, self._sd = 0, image, np.full_like(image, self.floor)
            self._seen = known
        if not self._seen.all():
            self._mean = np.where(self._seen, self._mean, image)
            self._seen = self._seen | known
        innovation = image - self._mean
        if not known.all():
            innovation = np.where(known, innovation, np.float32(0.0))
        if self._count == 1 and known.any():
            self._sd[:] = max(self.floor, 1.4826 * float(np.median(np.abs(innovation[known]))) / 2**0.5)
        height = np.maximum(innovation / self._sd, np.float32(0.0))
        if self._count < self.warm_up_pings:
            height = np.zeros_like(height)
        self._learn(innovation)
        return replace(
            ping,
            amplitude=height,
            range_m=ping.range_m.copy(),
            bearing_rad=ping.bearing_rad.copy(),
            valid=None if ping.valid is None else ping.valid.copy(),
        )

    def _learn(self, innovation: FloatImage) -> None:
        rate = np.float32(max(self.rate, 1.0 / (self._count + 1)))
        limit = np.float32(self.clip) * self._sd
        clipped = np.clip(innovation, -limit, limit)
        self._mean = self._mean + rate * clipped
        if self._count > 0:  # the first ping is its own background and says nothing of the spread
            unbiased = clipped * clipped / np.float32(clipped_variance(self.clip))
            variance = self._sd * self._sd
            self._sd = np.sqrt(np.maximum(variance + rate * (unbiased - variance), np.float32(self.floor**2)))
        self._count += 1

    def snapshot(self) -> dict[str, Any]:
        """The background and how many pings it has seen."""
        return {
            "count": self._count,
            "mean": self._mean.copy(),
            "sd": self._sd.copy(),
            "seen": self._seen.copy(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self._count = int(state["count"])
        self._mean = np.array(state["mean"], np.float32)
        self._sd = np.array(state["sd"], np.float32)
        self._seen = np.array(state["seen"], bool)


def clipped_variance(clip: float) -> float:
    """E[min(z^2, clip^2)] of a standard normal z."""
    inside = math.erf(clip / math.sqrt(2.0))
    density = math.exp(-0.5 * clip * clip) / math.sqrt(2.0 * math.pi)
    return inside - 2.0 * clip * density + clip * clip * (1.0 - inside)


def _no_image() -> FloatImage:
    return np.zeros((0, 0), np.float32)


def _smoothed_known(ping: Ping, sigma_cells: tuple[float, float]) -> tuple[FloatImage, BoolImage]:
    """The smoothed amplitudes of the cells with data, and which these are; 0 elsewhere.

    X = G * (w x) / (G * w), w 1 in cells with data and 0 in others: those do not darken their neighbours.
    """
    image = ping.amplitude.astype(np.float32)
    known = np.abs(image) < LARGEST  # neither nan nor infinite
    if ping.valid is not None:
        known &= ping.valid
    if known.all():
        return smoothed(image, sigma_cells), known
    weight = smoothed(known.astype(np.float32), sigma_cells)
    total = smoothed(np.where(known, image, np.float32(0.0)), sigma_cells)
    return np.where(known, total / np.where(known, weight, np.float32(1.0)), np.float32(0.0)), known


def smoothed(image: FloatImage, sigma_cells: tuple[float, float]) -> FloatImage:
    """The image under a Gaussian of these standard deviations (rows, columns); edges are replicated."""
    rows, columns = sigma_cells
    if image.size == 0 or not max(sigma_cells) > 0.0:
        return image
    import cv2  # only where there is something to smooth

    # a width of 0 would make OpenCV choose one; a kernel of one cell leaves that axis alone
    kernel = (_kernel_cells(columns), _kernel_cells(rows))
    blurred = cv2.GaussianBlur(
        image, kernel, sigmaX=columns or 1.0, sigmaY=rows or 1.0, borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(blurred, np.float32)


def _kernel_cells(sigma_cells: float) -> int:
    return 2 * int(np.ceil(3.0 * sigma_cells)) + 1


@hookimpl
def fls_node() -> type[ClutterMap]:
    """Announce the kind."""
    return ClutterMap
