"""Play a recording of a hydrophone array from a multichannel WAV file and a YAML file beside it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fls_flow import HydrophoneBlock, InputError, Mount, hookimpl
from fls_sources.array_waveform import Chirp
from fls_sources.wav_array_settings import ArraySettings, read_settings

if TYPE_CHECKING:
    import soundfile

__all__ = ["WavArray"]

FloatArray = npt.NDArray[np.float64]


@dataclass
class WavArray:
    """The pings of a recording, in order: the samples from each start of transmission; one is in memory.

    WAV, W64, RF64, FLAC or what else libsndfile reads. Samples of 16 bits stay integers, others become
    float32 within +-1. `settings` is a YAML file (docs/active_array.md); None: the recording's name with
    `.yaml`. A ping lasts to the next one or `listen_s`; the recording's last one counts if it is whole, or
    has half of that at least. Stamps are `start_ns` plus the place in the recording.

    Raises ValueError for bad parameters, InputError for files that are missing, damaged or do not fit each
    other, and when soundfile is not installed.
    """

    path: Path
    settings: Path | None = None
    first: int = 0  # index of the first ping to play
    pings: int | None = None  # how many to play; None: to the end
    sound_speed_mps: float | None = None  # None: as in the settings
    mount: Mount = field(default_factory=Mount)

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        if self.first < 0:
            raise ValueError(f"first must be 0 or more, not {self.first}")
        if self.pings is not None and self.pings < 1:
            raise ValueError(f"pings must be 1 or more, not {self.pings}")
        speed = self.sound_speed_mps
        if speed is not None and not (isfinite(speed) and speed > 0.0):
            raise ValueError(f"sound_speed_mps must be positive and finite, not {speed}")

    def __len__(self) -> int:
        settings = self._read_settings()
        with _opened(self.path) as wav:
            return len(self._spans(wav, settings))

    def __call__(self) -> Iterator[HydrophoneBlock]:
        """Read and check all settings at once, then give ping by ping."""
        settings = self._read_settings()
        with _opened(self.path) as wav:
            waveform = _waveform(settings.pulse, float(wav.samplerate))
            channels = len(settings.position_m)
            if wav.channels != channels:
                raise InputError(
                    f"{self.path}: has {wav.channels} channels, its settings place {channels} hydrophones"
                )
            spans = self._spans(wav, settings)
        return self._play(settings, waveform, spans)

    def _read_settings(self) -> ArraySettings:
        if not self.path.exists():
            raise InputError(f"{self.path}: No such file or directory")
        return read_settings(self.path.with_suffix(".yaml") if self.settings is None else self.settings)

    def _spans(self, wav: soundfile.SoundFile, settings: ArraySettings) -> list[tuple[int, int, int]]:
        """Number, first sample and end of each ping to play."""
        found = list(enumerate(_ping_spans(settings, wav.frames, wav.samplerate)))
        if self.first >= len(found):
            raise InputError(
                f"{self.path}: has {len(found)} pings by its settings; "
                f"parameter first = {self.first} lies beyond"
            )
        last = None if self.pings is None else self.first + self.pings
        return [(number, *span) for number, span in found[self.first : last]]

    def _play(
        self, settings: ArraySettings, waveform: FloatArray, spans: list[tuple[int, int, int]]
    ) -> Iterator[HydrophoneBlock]:
        with _opened(self.path) as wav:
            dtype = "int16" if wav.subtype == "PCM_16" else "float32"
            for number, begin, end in spans:
                wav.seek(begin)
                samples = wav.read(end - begin, dtype, always_2d=True)
                if len(samples) != end - begin:
                    raise InputError(
                        f"{self.path}: ends at sample {begin + len(samples)}, "
                        f"its header promises {wav.frames}"
                    )
                yield HydrophoneBlock(
                    number,
                    settings.start_ns + begin * 1_000_000_000 // wav.samplerate,
                    np.ascontiguousarray(samples.T),
                    float(wav.samplerate),
                    settings.position_m.copy(),
                    waveform.copy(),
                    self.sound_speed_mps or settings.sound_speed_mps,
                    self.mount,
                )


def _ping_spans(settings: ArraySettings, n_samples: int, sample_rate_hz: int) -> list[tuple[int, int]]:
    """First sample and end of each ping; what the recording has less than half of is left out."""
    starts_s = np.array(settings.ping_times_s or (settings.first_ping_s,))
    length_s = n_samples / sample_rate_hz
    if settings.period_s is not None:
        count = max(0, int(np.ceil((length_s - settings.first_ping_s) / settings.period_s)))
        starts_s = settings.first_ping_s + settings.period_s * np.arange(count)
    gaps_s = np.diff(starts_s)
    usual_s = settings.period_s or (float(gaps_s[-1]) if gaps_s.size else length_s - float(starts_s[0]))
    lasts_s = np.append(gaps_s, usual_s)[: starts_s.size]
    if settings.listen_s is not None:
        lasts_s = np.minimum(lasts_s, settings.listen_s)
    begin = np.floor(starts_s * sample_rate_hz + 0.5).astype(np.int64)
    end = begin + np.floor(lasts_s * sample_rate_hz + 0.5).astype(np.int64)
    kept = np.minimum(end, n_samples)
    enough = (end > begin) & (2 * (kept - begin) >= end - begin)
    return [(int(b), int(e)) for b, e in zip(begin[enough], kept[enough], strict=True)]


def _waveform(pulse: Chirp | Path, sample_rate_hz: float) -> FloatArray:
    if isinstance(pulse, Chirp):
        if pulse.highest_hz >= sample_rate_hz / 2.0:
            raise InputError(
                f"the pulse reaches {pulse.highest_hz:g} Hz; a recording at {sample_rate_hz:g} Hz "
                "carries less than half of that"
            )
        return pulse.samples(sample_rate_hz)
    with _opened(pulse) as wav:
        if wav.channels != 1 or wav.samplerate != sample_rate_hz or not wav.frames:
            raise InputError(
                f"{pulse}: has {wav.channels} channels, {wav.frames} samples at {wav.samplerate} Hz; a pulse "
                f"has one channel at the recording's {sample_rate_hz:g} Hz"
            )
        samples: FloatArray = wav.read(dtype="float64")
    return samples


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file, open for reading; InputError in one line when it is none, also while it is read."""
    try:
        import soundfile  # an extra: loaded only when a recording is played
    except (ImportError, OSError) as error:  # OSError: no libsndfile
        raise InputError("soundfile is not installed: pip install 'fls-flow[wav]'") from error
    try:
        path.open("rb").close()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    try:
        with soundfile.SoundFile(path) as wav:
            yield wav
    except soundfile.SoundFileError as error:
        raise InputError(f"{path}: {' '.join(str(error).split())}; give a sound file") from error


@hookimpl
def fls_node() -> type[WavArray]:
    """Return the node of kind `wav-array`."""
    return WavArray
