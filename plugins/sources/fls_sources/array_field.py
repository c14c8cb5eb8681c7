"""Reverberation of an active array: a Gaussian field of waves from all directions at its hydrophones.

Infinitely many scatterers, evenly around, each echoing the pulse W(f): the spectra of the channels are
jointly complex Gaussian at each frequency, independent between frequencies, with E[X_m conj(X_n)] =
|W|^2 J0(2 pi f |q_m - q_n| / c) (isotropic in the plane). q is where a hydrophone stands, plus where the
projector stands: moving the whole array by s moves q by 2 s, since the way out changes too.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy import fft, special

__all__ = ["ClutterField", "beamformed_share", "coherence"]

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex64]
DIRECTIVE_FLOOR = 1e-4  # of the peak power of the pulse's spectrum: what lies below carries no clutter
ROUNDING = 1e-9  # added to the diagonal, so that hydrophones at one place do not break the factorisation


def coherence(frequency_hz: FloatArray, here_m: FloatArray, there_m: FloatArray, c_mps: float) -> FloatArray:
    """J0(2 pi f |here_m - there_n| / c), (n_frequencies, n_here, n_there)."""
    apart = np.linalg.norm(here_m[:, None, :2] - there_m[None, :, :2], axis=-1)
    return np.asarray(special.j0(2.0 * np.pi / c_mps * frequency_hz[:, None, None] * apart))


def beamformed_share(
    frequency_hz: FloatArray, power: FloatArray, hydrophone_m: FloatArray, c_mps: float
) -> float:
    """Clutter power in a beam, averaged over bearings, per power in a channel.

    (1/M^2) sum_mn of the coherence J0 times the bearing average of exp(j 2 pi f (tau_m - tau_n)), which is J0
    too; averaged over frequencies with weight `power`. 1/M for hydrophones far apart.
    """
    j0 = coherence(frequency_hz, hydrophone_m, hydrophone_m, c_mps)
    share = np.mean(np.square(j0), axis=(1, 2))
    return float(np.average(share, weights=power))


@dataclass(eq=False)
class ClutterField:
    """Clutter of ping after ping: spectra X_k = A X_(k-1) + noise, at the bins where the pulse has power.

    A = rho C1 C0^-1 with C0 the coherence among the hydrophones at ping k - 1 and C1 that between their
    places at k and at k - 1: exact for neighbouring pings, and without motion an even fading, rho^n after n
    pings. The noise keeps the power. Spectra are scaled for a mean power of `power` after a matched filter on
    one channel.
    """

    pulse: FloatArray  # (n_pulse,) transmitted, at sample_rate_hz
    sample_rate_hz: float
    n_samples: int
    sound_speed_mps: float
    power: float
    correlation: float  # rho, of neighbouring pings
    _spectra: ComplexArray | None = field(default=None, init=False)  # (n_bins, n_channels), without W
    _place_m: FloatArray | None = field(default=None, init=False)
    _step: tuple[bytes, ComplexArray | None, ComplexArray] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._n_fft = fft.next_fast_len(self.n_samples, real=True)
        spectrum = fft.rfft(self.pulse, self._n_fft)
        self._bins = np.flatnonzero(np.abs(spectrum) ** 2 > DIRECTIVE_FLOOR * np.abs(spectrum).max() ** 2)
        self.frequency_hz = self._bins * (self.sample_rate_hz / self._n_fft)
        shape = np.abs(spectrum[self._bins])
        # A bin of variance 1 times W gives |2 W^2 / E|^2 / N^2 after the filter y = IFFT(2 X conj(W)) / E.
        energy = float(np.sum(np.square(self.pulse)))
        filtered = float(np.sum((2.0 * shape**2 / energy / self._n_fft) ** 2))
        self._shape = (shape * np.sqrt(self.power / filtered)).astype(np.float32)
        self.filtered_power = shape**4  # weights of the bins after the filter

    @property
    def sample_power(self) -> float:
        """Mean square of a channel's samples."""
        return float(2.0 * np.sum(self._shape.astype(float) ** 2) / self._n_fft**2)

    def next(self, place_m: FloatArray, rng: np.random.Generator) -> npt.NDArray[np.float32]:
        """The samples (n_channels, n_samples) of the next ping, heard at `place_m` (n_channels, 2)."""
        carried, fresh = self._stepped(place_m)
        shape = (self._bins.size, len(place_m))
        drawn = rng.standard_normal((2, *shape), np.float32)
        noise = (drawn[0] + 1j * drawn[1]) * np.float32(np.sqrt(0.5))
        spectra = np.matmul(fresh, noise[..., None])[..., 0]
        if carried is not None and self._spectra is not None:
            spectra += np.matmul(carried, self._spectra[..., None])[..., 0]
        self._spectra, self._place_m = spectra, place_m
        whole = np.zeros((len(place_m), self._n_fft // 2 + 1), np.complex64)
        whole[:, self._bins] = (spectra * self._shape[:, None]).T
        return np.asarray(fft.irfft(whole, self._n_fft)[:, : self.n_samples])

    def _stepped(self, place_m: FloatArray) -> tuple[ComplexArray | None, ComplexArray]:
        """A and the factor of the noise's covariance, for the move from the last places to these."""
        before = None if self.correlation == 0.0 else self._place_m
        points = place_m if before is None else np.concatenate([place_m, before])
        apart = np.linalg.norm(points[:, None] - points, axis=-1)  # all that the coherence depends on
        key = np.round(apart, 9).tobytes()
        if self._step is None or self._step[0] != key:
            self._step = key, *self._factors(before, place_m)
        return self._step[1], self._step[2]

    def _factors(
        self, before: FloatArray | None, place_m: FloatArray
    ) -> tuple[ComplexArray | None, ComplexArray]:
        f, c = self.frequency_hz, self.sound_speed_mps
        rounding = ROUNDING * np.eye(len(place_m))
        here = coherence(f, place_m, place_m, c) + rounding
        if before is None:
            return None, np.linalg.cholesky(here).astype(np.complex64)
        across = self.correlation * coherence(f, place_m, before, c)
        carried = np.linalg.solve(coherence(f, before, before, c) + rounding, across.transpose(0, 2, 1))
        left = here - across @ carried
        return (
            carried.transpose(0, 2, 1).astype(np.complex64),
            np.linalg.cholesky(0.5 * (left + left.transpose(0, 2, 1)) + rounding).astype(np.complex64),
        )
