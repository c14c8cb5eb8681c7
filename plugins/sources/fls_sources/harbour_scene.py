"""Simulate a sonar on a pier: divers, seals, dolphins and fish before a background that stands still."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from math import isfinite
from typing import NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from fls_flow import Ping, Truth, hookimpl
from fls_sources.harbour_echoes import echoes_at, fade
from fls_sources.harbour_image import Still, echo_power, ping_image, still_scene
from fls_sources.harbour_plan import SPECIES, Kind, Matched, Planned, Sector, plan
from fls_sources.scene_clutter import AmplitudeArray, Law, NumberFormat, background
from fls_sources.scene_image import Sonar
from fls_sources.scene_motion import even_stamps, uneven_stamps

__all__ = ["HarbourPing", "HarbourScene"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

CURRENT_STREAM, STILL_STREAM, PING_STREAM, CLOCK_STREAM = 2, 3, 4, 5  # what the seed's streams are for

COUNTS: dict[str, Kind] = {
    "open_divers": "open",
    "semi_closed_divers": "semi-closed",
    "closed_divers": "closed",
    "seals": "seal",
    "dolphins": "dolphin",
    "fish_schools": "fish-school",
}


class HarbourPing(NamedTuple):
    """What a simulated sonar gives: the image, and who is in it."""

    ping: Ping
    truth: Truth


@dataclass
class HarbourScene:
    """Pings of a simulated sonar on a pier and the truth in them, the same for the same parameters.

    Of each kind there are as many places as its parameter says; who has one stays for `stay_s` (by default as
    long as real divers were followed), fades out of the vertical beam, and another one of its kind comes.
    Classes in `Truth` are diver, seal, dolphin and fish; with `name_circuits`, diver-open, diver-semi-closed
    and diver-closed. Ping `k` depends on the parameters and `k` alone.

    Modelled:
    - motion: mean speed by species (divers 0.3 to 0.6 m/s), speed and turn rate wander, turns at the borders
      of the sector, each keeps `apart_m` from the others as far as it can turn;
    - bodies of scatterers, each with the echo of its material (gas, neoprene, steel, bone, tissue) and of
      how its part faces the sonar. Divers: head, torso, arms, tank or counterlungs, legs and fins that kick
      as a flutter or a frog, with glides. Seals: lungs, skull and a hind end that beats from side to side.
      Dolphins: lungs, skull, a tail that beats up and down. Fish: a school of swimbladders that mill about;
    - bubbles: clumps let go at each breath (open circuit), a few at every third one (semi-closed), none
      (closed); they stay behind, drift with the current, spread, rise and leave the vertical beam;
    - the image: speckle averaged over `looks`, pulse and beam pattern with side lobes, reverberation with a
      fixed texture, fixed piles and a wall, gain over range, a slow drift of the level, number formats. With
      `clutter: measured` the level, tail and beam pattern of a real sonar.
    Not modelled: depth but for bubbles and fading, multipath, shadows, sound in the animals' own bands,
    surfacing to breathe, wakes, how the echo of a body depends on frequency. Nobody has measured these bodies
    with this sonar: strengths are of the right order at best. A classifier that does well here has learned
    these shapes and motions; it is not proven on real divers.

    `snr_db` is the mean power of the echo of a scatterer of gas, in the middle of its cell and beam, over
    that of the reverberation where its gain is 1; a torso has some ten of them. `matched_motion` draws
    lengths, speeds and turns of all kinds from one law, `matched_echo` gives all bodies the same total
    strength (bubbles apart): what then still parts the classes is shape.

    Sources: classes, circuits and speeds after Brinkmann 2010, 2.2 and 2.3; stays after the sequences of
    DeMarco 2013 (tests/golden/diver_motion). Raises ValueError for bad parameters.
    """

    pings: int = 240
    open_divers: int = 1
    semi_closed_divers: int = 1
    closed_divers: int = 1
    seals: int = 1
    dolphins: int = 1
    fish_schools: int = 1
    snr_db: float = 20.0
    matched_motion: bool = False
    matched_echo: bool = False
    name_circuits: bool = False
    stay_s: float | None = None
    apart_m: float = 8.0
    current_mps: float = 0.08
    range_min_m: float = 8.0
    cell_m: float = 0.1
    n_ranges: int = 400
    n_beams: int = 256
    beam_spacing_deg: float = 0.25
    beamwidth_deg: float = 0.3  # -3 dB
    vertical_beamwidth_deg: float = 20.0
    side_lobe_db: float = -26.0
    looks: int = 4  # samples of independent speckle that each cell averages, in power
    ping_interval_s: float = 0.25
    uneven_pings: bool = False
    clutter: Law = "rayleigh"
    k_shape: float = 2.0  # of the K law: small is spiky
    texture_db: float = 2.0  # standard deviation of the reverberation's fixed texture
    structures: int = 6  # single piles; with any, there is a wall too
    structure_db: float = 22.0  # mean echo of a pile over the reverberation
    drift_db: float = 1.0  # most by which the level swells and falls, in minutes
    dtype: NumberFormat | None = None  # None: uint8 for measured clutter, else float32
    frequency_hz: float = 450e3
    sound_speed_mps: float = 1500.0
    seed: int = 0
    start_ns: int = 1_283_299_200_000_000_000  # 2010-09-01

    def __post_init__(self) -> None:
        for spec in fields(self):
            value = getattr(self, spec.name)
            self._require(spec.name, not isinstance(value, float) or isfinite(value), "finite")
        for name in ("pings", "n_ranges", "n_beams", "looks"):
            self._require(name, getattr(self, name) >= 1, "1 or more")
        for name in (*COUNTS, "apart_m", "current_mps", "range_min_m", "texture_db", "structures"):
            self._require(name, getattr(self, name) >= 0, "0 or more")
        for name in ("drift_db", "seed", "start_ns"):
            self._require(name, getattr(self, name) >= 0, "0 or more")
        for name in ("cell_m", "beam_spacing_deg", "beamwidth_deg", "vertical_beamwidth_deg", "k_shape"):
            self._require(name, getattr(self, name) > 0.0, "positive")
        for name in ("ping_interval_s", "frequency_hz", "sound_speed_mps"):
            self._require(name, getattr(self, name) > 0.0, "positive")
        self._require("side_lobe_db", self.side_lobe_db < 0.0, "negative")
        self._require("stay_s", self.stay_s is None or self.stay_s >= 1.0, "1 or more")
        self._require("clutter", self.clutter in get_args(Law), f"one of {get_args(Law)}")
        known = get_args(NumberFormat)
        self._require("dtype", self.dtype is None or self.dtype in known, f"one of {known}")
        sector_deg = self.n_beams * self.beam_spacing_deg
        if sector_deg > 180.0:
            raise ValueError(f"n_beams times beam_spacing_deg is {sector_deg}; a sector has at most 180")

    def __len__(self) -> int:
        return self.pings

    def __call__(self) -> Iterator[HarbourPing]:
        """Every ping of the scene with its truth, from the first, each time it is called."""
        sonar, stamps = self._sonar(), self._stamps()
        still, planned = self._still(sonar), self._plan(sonar, stamps)
        for seq, stamp_ns in enumerate(stamps.tolist()):
            time_s = (stamp_ns - self.start_ns) * 1e-9
            ping = Ping(
                seq,
                stamp_ns,
                self._image(sonar, still, planned, time_s, self._rng(PING_STREAM, seq)),
                sonar.range_m,
                sonar.beams_rad,
                beamwidth_rad=sonar.beamwidth_rad,
                sound_speed_mps=self.sound_speed_mps,
                frequency_hz=self.frequency_hz,
            )
            yield HarbourPing(ping, self._truth(seq, stamp_ns, sonar, planned, time_s))

    def _image(
        self, sonar: Sonar, still: Still, planned: Planned, time_s: float, rng: np.random.Generator
    ) -> AmplitudeArray:
        position, power = echoes_at(
            planned, time_s, self._current_mps(), np.deg2rad(self.vertical_beamwidth_deg)
        )
        echoes = echo_power(sonar, position, power * 10.0 ** (self.snr_db / 10.0), self.looks, rng)
        return ping_image(still, echoes, time_s, self.looks, self._number_format, rng)

    def _truth(self, seq: int, stamp_ns: int, sonar: Sonar, planned: Planned, time_s: float) -> Truth:
        places, who = planned.present(time_s)
        state = planned.states(time_s, places)[:, :4]
        bright = np.array([fade(planned.visitors[w], time_s) >= 0.5 for w in who.tolist()], bool)
        seen = np.flatnonzero(bright & sonar.sees(state[:, :2]))
        visitors = [planned.visitors[w] for w in who[seen].tolist()]
        ids = np.array([one.target_id for one in visitors], np.int64)
        return Truth(seq, stamp_ns, ids, state[seen], tuple(self._name(one.kind) for one in visitors))

    def _name(self, kind: Kind) -> str:
        species = SPECIES[kind]
        return f"{species}-{kind}" if self.name_circuits and species == "diver" else species

    def _plan(self, sonar: Sonar, stamps: IntArray) -> Planned:
        counts = {kind: getattr(self, name) for name, kind in COUNTS.items()}
        return plan(
            counts,
            Sector(sonar.range_min_m, sonar.range_max_m, sonar.half_width_rad),
            (int(stamps[-1]) - self.start_ns) * 1e-9,
            stay_s=self.stay_s,
            matched=Matched(self.matched_motion, self.matched_echo),
            apart_m=self.apart_m,
            seed=self.seed,
        )

    def _still(self, sonar: Sonar) -> Still:
        rng = self._rng(STILL_STREAM)
        shape = (sonar.n_ranges, self.n_beams)
        return still_scene(
            sonar,
            background(self.clutter, self.k_shape, self._number_format, shape, rng),
            texture_db=self.texture_db,
            structures=self.structures,
            structure_db=self.structure_db,
            drift_db=self.drift_db,
            rng=rng,
        )

    def _current_mps(self) -> FloatArray:
        angle = self._rng(CURRENT_STREAM).uniform(-np.pi, np.pi)
        return self.current_mps * np.array([np.cos(angle), np.sin(angle)])

    def _sonar(self) -> Sonar:
        spacing = np.deg2rad(self.beam_spacing_deg)
        beams = (np.arange(self.n_beams) - (self.n_beams - 1) / 2.0) * spacing
        width = np.deg2rad(self.beamwidth_deg)
        return Sonar(self.range_min_m, self.cell_m, self.n_ranges, beams, spacing, width, self.side_lobe_db)

    @property
    def _number_format(self) -> NumberFormat:
        if self.dtype is not None:
            return self.dtype
        return "uint8" if self.clutter == "measured" else "float32"

    def _stamps(self) -> IntArray:
        rate_hz = 1.0 / self.ping_interval_s
        if self.uneven_pings:
            return uneven_stamps(self.start_ns, self.pings, rate_hz, self._rng(CLOCK_STREAM))
        return even_stamps(self.start_ns, self.pings, rate_hz)

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, *stream))

    def _require(self, name: str, holds: bool, what: str) -> None:
        if not holds:
            raise ValueError(f"{name} is {getattr(self, name)!r}; it must be {what}")


@hookimpl
def fls_node() -> type[HarbourScene]:
    """The simulated harbour."""
    return HarbourScene
