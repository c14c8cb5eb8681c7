"""Settings of one host's Zenoh session, and the configuration that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fls_flow.deploy import endpoints
from fls_flow.errors import InputError

__all__ = ["CONTROL_WORDS", "Mode", "Tls", "Zenoh", "config", "passwords"]

Mode = Literal["peer", "client", "router"]

# chunks of keys that begin with @: no wildcard matches them, so access control names each
CONTROL_WORDS = ("@alive", "@answer", "@control", "@counters", "@host", "@latest", "@run", "@state", "@tap")

# measured: by default large messages are lost on slow links (after 50 ms) and a stall of 5 s closes the
# link, without a word; opening waits half a second for others to turn up; a host that comes late, or back
# after a cut, is met after up to 4 s; Zenoh's shared memory stays behind after a kill (and `links.ring`
# carries what is large)
_FIXED: dict[str, Any] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "scouting/delay": 0,  # ms
    "connect/retry": {"period_init_ms": 20, "period_max_ms": 1000, "period_increase_factor": 2},
    "timestamping/enabled": True,
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 1_000_000,  # us
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,  # us
    "transport/shared_memory/enabled": False,
}


@dataclass(frozen=True, slots=True)
class Tls:
    """Certificates of a host, PEM: who signs, who it is, its key; `mutual`: it asks the others for theirs."""

    ca: Path
    certificate: Path | None = None
    key: Path | None = None
    mutual: bool = True


@dataclass(frozen=True, slots=True)
class Zenoh:
    """How a host reaches the others and whom it lets in; nobody, unless told so.

    password_file: lines of `user:password`; the line of `user` is this host's own, and a host that listens
    lets in all users of its file. users, certificates: access control, whom of those that got in may
    exchange messages; both None: everybody. open: it may listen beyond this machine without asking who comes.
    """

    mode: Mode = "router"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    tls: Tls | None = None
    user: str | None = None
    password_file: Path | None = None
    users: tuple[str, ...] | None = None
    certificates: tuple[str, ...] | None = None
    open: bool = False

    def to_document(self) -> dict[str, Any]:
        """Plain values for JSON; no password is among them."""
        tls = self.tls and {
            "ca": str(self.tls.ca),
            "certificate": _text(self.tls.certificate),
            "key": _text(self.tls.key),
            "mutual": self.tls.mutual,
        }
        return {
            "mode": self.mode,
            "listen": list(self.listen),
            "connect": list(self.connect),
            "tls": tls,
            "user": self.user,
            "password_file": _text(self.password_file),
            "users": None if self.users is None else list(self.users),
            "certificates": None if self.certificates is None else list(self.certificates),
            "open": self.open,
        }

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> Zenoh:
        """The settings that `to_document` wrote."""
        values = dict(document)
        for name in ("listen", "connect", "users", "certificates"):
            values[name] = None if values[name] is None else tuple(values[name])
        values["password_file"] = _path(values["password_file"])
        if values["tls"] is not None:
            tls = values["tls"]
            files = {name: _path(tls[name]) for name in ("certificate", "key")}
            values["tls"] = Tls(ca=Path(tls["ca"]), mutual=tls["mutual"], **files)
        return cls(**values)


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)


def passwords(path: Path) -> dict[str, str]:
    """Password by user, from lines of `user:password`.

    Raises InputError when the file cannot be read, is another user's to read, or has another line.
    """
    try:
        if path.stat().st_mode & 0o007:
            raise InputError(f"{path}: everybody on this machine can read it; chmod o-rwx {path}")
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    found: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        user, colon, password = line.partition(":")
        if not (user and colon and password) or user in found:
            reason = f"user '{user}' stands twice" if user in found else "write user:password"
            raise InputError(f"{path}:{number}: {reason}")  # never the line: it may hold a password
        found[user] = password
    return found


def config(settings: Zenoh, listen: Sequence[str] = (), connect: Sequence[str] = ()) -> dict[str, Any]:
    """Paths and values for `insert_json5`; `listen` and `connect` are further endpoints on this host.

    Raises InputError when the password file cannot be used.
    """
    outside = [one for one in settings.connect if one not in settings.listen]  # nobody connects to itself
    made: dict[str, Any] = {
        **_FIXED,
        "mode": settings.mode,
        "listen/endpoints": [*settings.listen, *listen],
        "connect/endpoints": [*outside, *connect],
    }
    if settings.tls is not None:
        made |= _tls(settings.tls)
    if settings.user is not None and settings.password_file is not None:
        made |= _user(settings.user, settings.password_file)
    if settings.users is not None or settings.certificates is not None:
        made |= {
            f"access_control/{name}": value for name, value in _access(settings, listen, connect).items()
        }
    return made


def _tls(tls: Tls) -> dict[str, Any]:
    made: dict[str, Any] = {
        "root_ca_certificate": str(tls.ca),
        "enable_mtls": tls.mutual,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    if tls.certificate is not None and tls.key is not None:
        for side in ("listen", "connect") if tls.mutual else ("listen",):
            made |= {f"{side}_certificate": str(tls.certificate), f"{side}_private_key": str(tls.key)}
    return {f"transport/link/tls/{name}": value for name, value in made.items()}


def _user(user: str, path: Path) -> dict[str, Any]:
    known = passwords(path)
    if user not in known:
        raise InputError(f"{path}: has no line for user '{user}'; add {user}:PASSWORD")
    made = {"user": user, "password": known[user], "dictionary_file": str(path)}
    return {f"transport/auth/usrpwd/{name}": value for name, value in made.items()}


def _access(settings: Zenoh, listen: Sequence[str], connect: Sequence[str]) -> dict[str, Any]:
    """Nothing for nobody, but all of fls/ for those named and for the host's own processes."""
    named: dict[str, Any] = {"id": "named"}  # both lists: who is in both
    if settings.users is not None:
        named["usernames"] = list(settings.users)
    if settings.certificates is not None:
        named["cert_common_names"] = list(settings.certificates)
    subjects = [named] if all(named.values()) else []
    protocols = {endpoints.parse(one).protocol for one in [*listen, *connect]}
    if "unixsock-stream" in protocols:
        subjects.append({"id": "own sockets", "link_protocols": ["unixsock-stream"]})
    if protocols - {"unixsock-stream"}:
        subjects.append({"id": "own machine", "interfaces": ["lo"]})
    rule = {
        "id": "fls",
        "permission": "allow",
        "flows": ["egress", "ingress"],
        "messages": [
            "put",
            "delete",
            "declare_subscriber",
            "query",
            "reply",
            "declare_queryable",
            "liveliness_token",
            "declare_liveliness_subscriber",
            "liveliness_query",
        ],
        "key_exprs": ["fls/**", *(f"fls/**/{word}/**" for word in CONTROL_WORDS)],
    }
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule],
        "subjects": subjects,
        "policies": [{"rules": ["fls"], "subjects": [one["id"] for one in subjects]}] if subjects else [],
    }
