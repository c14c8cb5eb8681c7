"""Probabilistic data association filter for divers and marine animals."""

from __future__ import annotations

from dataclasses import dataclass

from fls_flow import hookimpl
from fls_trackers.diver_tracker import DiverTracker

__all__ = ["Pdaf", "fls_node"]


@dataclass
class Pdaf(DiverTracker):
    """Tracks of divers and animals, each updated by all events in its gate, weighted by their probabilities.

    beta_j = e_j / (b + sum of e), e_j = exp(-d2_j / 2), b = lambda sqrt|2 pi S| (1 - p_d p_g) / p_d, over
    the events with d2_j = nu_j^T S^-1 nu_j <= `gamma`. Events are Cartesian by debiased conversion, motion
    is nearly constant velocity: a component changes by `velocity_walk_mps` (standard deviation) within a
    second.

    `group_m`: events within that distance of a stronger one are first made one, as an object fills many
    cells (0: off, for detectors that give one event per object). `clutter`: lambda is the larger of `p_fa`
    per cell and what no confirmed track gated in the last 20 pings, or the first alone (`cell`).
    `estimate_noise`: each track learns factors on its process and its measurement noise from its
    innovations. `sigma_d_m` and `sigma_delta_deg` are by default the cell and the beam; `extent_sd_m` is
    how far an echo's centre wanders over the body, in any direction.

    `sharing`: with `joint`, tracks share the events in their gates out by the probabilities of joint events,
    in which no event is two tracks' own; with `own`, each weighs them as if it were alone, as the thesis
    does. Objects nearer to each other than `resolution_m` (None: `group_m`) may make one event together: it
    then moves the mean of their tracks and leaves their difference (`joint` only).
    `amplitude_sd`: how much ln(amplitude) of one object's echoes varies; each track learns the mean of its
    own over some five seconds, and events weigh by how they agree with it, e_j N(ln a_j; level,
    amplitude_sd) / p(ln a_j | false), the latter even (None: not weighed). So a track goes on with its
    swimmer rather than with the weaker bubbles that it leaves.

    Every event that is no track's (`joint`), or in no track's gate (`own`), starts a tentative track,
    confirmed with n1 updates in m1 pings and a log likelihood ratio of `start_score`; until then it gets only
    events that more likely are no confirmed track's. `hit`: what counts as an update, an event in the gate
    (`gated`), or one also more likely than none (`probable`). A confirmed track is propagated through misses;
    its score is `max_propagate` after an update and falls by one per miss, and a miss at 0 ends it (with
    p_d = 0.65, 5 ends a track after some 800 pings on average). A position less certain than max_sd_m ends it
    too.

    Tracks as near as if they followed one object are fused into the older: `algebraic`, or by
    `covariance-intersection`, which allows for the events they shared. With `own`, when they had the same
    most probable event in `max_common_events` common updates in a row (0: never); with `joint`, when they
    shared one event rather than had two so many times more than the younger was updated before, at most 40,
    so that two swimmers who meet and part keep their tracks.

    `meeting_m`: confirmed tracks that come nearer than that to each other, and part, may leave with each
    other's swimmer. They then exchange their places, with each other or with a track that began beside them,
    when velocity, speed and strength have said so for three pings, by what they were while alone (None:
    never).

    With `frame: ned` tracks are in north and east; in a ping without position or heading they are only
    predicted.

    Raises ValueError when a stamp does not increase or a detection is not finite; the state stays as it
    was.

    Source: Brinkmann 2010, chapter 3, with its errors mended; joint events: Bar-Shalom & Li 1995, 6.2;
    common events: Koch & van Keuk 1997; amplitudes: Lerro & Bar-Shalom 1990; meetings: Gabriel et al.
    2003. Noise estimation, tentative tracks and new tracks at any time are ours.
    """


@hookimpl
def fls_node() -> type[Pdaf]:
    """Give the node class of kind `pdaf`."""
    return Pdaf
