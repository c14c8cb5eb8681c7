"""How the hosts of one run agree: on the run and its graph, on the start, on failures and the end.

The host of the clock leads. Keys: `fls/<deployment>/@run`, where the leader answers who asks for the run;
`fls/<graph>/<run>/@host/<host>`, where each host repeats how it is. A state is repeated until the end, so no
single message matters; a host that falls silent is lost.
"""

from __future__ import annotations

import importlib.metadata
import json
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import zenoh

from fls_flow.deploy import Deployment
from fls_flow.errors import RunError, UserError

__all__ = ["Beat", "Hosts", "RunTerms", "State", "ask", "offer"]

log = logging.getLogger(__name__)

State = Literal["starting", "ready", "go", "stopping", "failed", "done"]
VERSION = importlib.metadata.version("fls-flow")
BEAT_S = 0.25
ASK_S = 0.3


@dataclass(frozen=True)
class RunTerms:
    """What the leader decides and the other hosts take over."""

    run: str
    graph: str  # its digest
    deployment: str  # its digest
    window: int
    live: bool
    options: dict[str, Any] = field(default_factory=dict)
    began: bool = False  # too late to join: what was sent so far is gone
    version: str = VERSION  # of fls_flow: messages and words between hosts are those of one version


def offer(session: zenoh.Session, deployment: Deployment, terms: RunTerms, began: Callable[[], bool]) -> Any:
    """Answer hosts that ask for the run of this deployment; undeclare what is returned to stop."""
    key = f"fls/{deployment.name}/@run"

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(key, json.dumps(asdict(replace(terms, began=began()))))

    return session.declare_queryable(key, zenoh.handlers.Callback(answer, indirect=False))


def ask(
    session: zenoh.Session, deployment: Deployment, graph: str, stopped: threading.Event
) -> RunTerms | None:
    """The terms of the leader's run, waited for; a run that has begun already is let end, the next one is it.

    None when `stopped` came first. Raises UserError when its graph or deployment is another one, RunError
    when it does not answer, or does not end its run, in time.
    """
    deadline = time.monotonic() + deployment.connect_timeout_s
    while not stopped.is_set():
        late: RunTerms | None = None
        for reply in session.get(f"fls/{deployment.name}/@run", timeout=ASK_S):
            if reply.ok is not None:
                terms = _read(reply.ok.payload.to_bytes(), deployment)
                _agree(terms, deployment, graph)
                if not terms.began:
                    return terms
                late = terms
        if time.monotonic() > deadline:
            raise RunError(f"host '{deployment.leader}' {_refusal(late, deployment)}")
        stopped.wait(ASK_S)
    return None


def _refusal(late: RunTerms | None, deployment: Deployment) -> str:
    if late is None:
        waited = f"did not answer within {deployment.connect_timeout_s:g} s"
        return f"{waited}; {deployment.doubts(deployment.leader, 'there')}"
    return f"is in the middle of run {late.run}, which nobody can join any more; stop it, or wait for its end"


def _read(payload: bytes, deployment: Deployment) -> RunTerms:
    try:
        return RunTerms(**json.loads(payload))
    except (ValueError, TypeError) as error:
        what = f"host '{deployment.leader}' answers as another version of fls_flow would"
        raise UserError(f"{what}; install the same one on both hosts (here {VERSION})") from error


def _agree(terms: RunTerms, deployment: Deployment, graph: str) -> None:
    for what, theirs, ours in (
        ("graph", terms.graph, graph),
        ("deployment", terms.deployment, deployment.digest),
        ("version of fls_flow", terms.version, VERSION),
    ):
        if theirs != ours:
            raise UserError(
                f"host '{deployment.leader}' runs another {what} ({theirs}, here {ours}); "
                "give both hosts the same files, options and versions"
            )


@dataclass(frozen=True)
class Beat:
    """How a host is; `stopped` and `error` stay, whatever state follows: no single beat is sure to arrive."""

    host: str
    state: State
    pings: int = 0
    error: str | None = None
    stopped: bool = False
    seen: tuple[str, ...] = ()  # the hosts of which it knows that they are done


class Hosts:
    """What this host tells the others, and what it knows of them; `changed` is called after news."""

    def __init__(
        self,
        session: zenoh.Session,
        deployment: Deployment,
        prefix: str,
        host: str,
        changed: Callable[[], None],
    ) -> None:
        self._deployment, self._host, self._changed = deployment, host, changed
        self._own = Beat(host, "starting")
        self._lock = threading.Lock()
        self._others: dict[str, Beat] = {}
        self._heard: dict[str, float] = {}
        self._closing = threading.Event()
        self._publisher = session.declare_publisher(
            f"{prefix}/@host/{host}",
            priority=zenoh.Priority.REAL_TIME,  # a host is not lost because its data is slow
        )
        handler = zenoh.handlers.Callback(self._take, indirect=False)
        self._subscriber = session.declare_subscriber(f"{prefix}/@host/*", handler)
        self._thread = threading.Thread(target=self._repeat, name="hosts", daemon=True)
        self._thread.start()

    def say(self, state: State, *, error: str | None = None) -> None:
        """Tell the others at once, and go on repeating it; a failure stays one."""
        with self._lock:
            if self._own.state == "failed" and state != "done":
                return
            error = error or self._own.error
            stopped = self._own.stopped or state == "stopping"
            self._own = replace(self._own, state=state, error=error, stopped=stopped)
        self._publish()

    def count(self, pings: int) -> None:
        """Let the next beats carry how far the run is."""
        with self._lock:
            self._own = replace(self._own, pings=pings)

    def state(self, host: str) -> State | None:
        """The state of another host; None before its first word."""
        beat = self._others.get(host)
        return beat.state if beat else None

    @property
    def others(self) -> tuple[str, ...]:
        """The names of the other hosts."""
        return tuple(name for name in self._deployment.hosts if name != self._host)

    def all_in(self, *states: State) -> bool:
        """Whether every other host is in one of these states."""
        return all(self.state(name) in states for name in self.others)

    def missing(self) -> list[str]:
        """The hosts that have not said a word yet."""
        return [name for name in self.others if self.state(name) is None]

    def stopped(self) -> bool:
        """Whether somebody stopped the run on another host."""
        return any(beat.stopped for beat in list(self._others.values()))

    def parted(self) -> bool:
        """Whether all hosts are done and know it of each other, so that nobody waits for a word of this one.

        A host that is done and silent has left: it knew enough.
        """
        if not self.all_in("done"):
            return False
        now, patience_s = time.monotonic(), self._deployment.lost_after_s
        return all(
            len(beat.seen) == len(self.others) or now - self._heard[name] > patience_s
            for name, beat in list(self._others.items())
        )

    def failure(self) -> str | None:
        """What went wrong on another host, with its name."""
        for beat in list(self._others.values()):
            if beat.error is not None:
                return beat.error if beat.error.startswith("host ") else f"host '{beat.host}': {beat.error}"
        return None

    def pings(self) -> int:
        """How far the leader says the run is."""
        beat = self._others.get(self._deployment.leader)
        return beat.pings if beat else 0

    def lost(self) -> str | None:
        """A host that was there and has been silent for too long."""
        now = time.monotonic()
        for name, heard in list(self._heard.items()):
            silent = now - heard
            if silent > self._deployment.lost_after_s and self._others[name].state != "done":
                return f"host '{name}' is lost: silent for {silent:.1f} s"
        return None

    def close(self) -> None:
        """Say the last word a few times more and stop."""
        for _ in range(3):
            self._publish()
            time.sleep(0.03)
        self._closing.set()
        self._thread.join(1.0)
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]  # the stub of zenoh lacks it
        self._publisher.undeclare()  # type: ignore[no-untyped-call]  # the stub of zenoh lacks it

    def _repeat(self) -> None:
        while not self._closing.wait(BEAT_S):
            self._publish()

    def _publish(self) -> None:
        seen = tuple(name for name in self.others if self.state(name) == "done")
        with self._lock:
            payload = json.dumps(asdict(replace(self._own, seen=seen)))
        self._publisher.put(payload)

    def _take(self, sample: zenoh.Sample) -> None:
        try:
            said = json.loads(sample.payload.to_bytes())
            beat = Beat(**{**said, "seen": tuple(said["seen"])})
        except (ValueError, TypeError, KeyError):
            log.warning("%s: a beat that makes no sense", sample.key_expr)
            return
        if beat.host == self._host or beat.host not in self._deployment.hosts:
            return
        before, self._others[beat.host] = self._others.get(beat.host), beat
        self._heard[beat.host] = time.monotonic()
        if before is None or before != beat:
            self._changed()
