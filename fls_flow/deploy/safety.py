"""Whether the Zenoh settings of a deployment keep strangers out and let its hosts find each other."""

from __future__ import annotations

import ssl
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fls_flow.deploy import endpoints
from fls_flow.deploy.endpoints import Endpoint
from fls_flow.deploy.session import Tls, Zenoh, passwords
from fls_flow.deploy.settings import Part, Sessions
from fls_flow.document import Value
from fls_flow.errors import InputError

__all__ = ["check"]


def check(found: Sessions, parts: Iterable[Part], where: Value, host: str | None) -> None:
    """Add what is wrong to `found`; the files of `host` are looked at."""
    for part in parts:
        settings = found.settings[part.name]
        before = len(found.problems)
        _closed(part, settings)
        if len(found.settings) > 1 and settings.mode != "router":
            what = f"mode is {settings.mode}; among several hosts each is a router, for its processes"
            part.wrong("mode", what)
        if part.name == host and len(found.problems) == before:
            _files(part, settings)
    if host is None and any(one.tls or one.password_file for one in found.settings.values()):
        found.notes.append("files of certificates and passwords are looked at only for one host: name it")
    if not found.problems:
        _ways(found, where)
        _lists(found)


def _closed(part: Part, settings: Zenoh) -> None:
    """Nobody comes in unasked, and what should be encrypted is."""
    listen, connect = (list(map(endpoints.parse, texts)) for texts in (settings.listen, settings.connect))
    _encryption(part, settings, listen, connect)
    for one, text in zip(listen, settings.listen, strict=True):
        if not one.loopback:
            _entrance(part, settings, one, text)
    for one, text in zip([*listen, *connect], [*settings.listen, *settings.connect], strict=True):
        if one.protocol == "udp":
            part.note(f"uses '{text}': udp loses most large messages; tcp, tls and quic do not")
    if settings.users is not None and settings.user is None:
        part.wrong("access_control", "access_control by users needs user and password_file")
    if settings.users is not None and set(settings.connect) - set(settings.listen):
        what = (
            "access_control by users is for hosts that only listen: who connects is not told the other's user"
        )
        part.wrong("access_control", f"{what}; use certificates")
    if settings.certificates is not None and not (settings.tls and settings.tls.mutual):
        part.wrong("access_control", "access_control by certificates needs tls, with mutual: true")


def _entrance(part: Part, settings: Zenoh, endpoint: Endpoint, text: str) -> None:
    asks = (endpoint.encrypted and settings.tls and settings.tls.mutual) or settings.user is not None
    if asks and not endpoint.encrypted:
        part.note(f"asks for passwords on '{text}', but all can be read and altered on the way; use tls")
    elif not asks and settings.open:
        part.note(f"listens on '{text}' and lets in whoever can reach it")
    elif not asks:
        what = (
            f"listen '{text}' would let in whoever can reach it; give tls (mutual) or user and "
            "password_file, or say open: true if nobody else is on that network"
        )
        part.wrong("listen", what)


def _encryption(part: Part, settings: Zenoh, listen: list[Endpoint], connect: list[Endpoint]) -> None:
    encrypted = [one for one in [*listen, *connect] if one.encrypted]
    if encrypted and settings.tls is None:
        key = "listen" if any(one.encrypted for one in listen) else "connect"
        part.wrong(key, f"{encrypted[0].protocol} needs tls: {{ca, certificate, key}}")
    if settings.tls is None:
        return
    if any(one.encrypted for one in listen) and settings.tls.certificate is None:
        part.wrong("tls", "tls needs certificate and key to listen")
    if settings.open:
        return
    for one, text in zip(connect, settings.connect, strict=True):
        if not (one.encrypted or one.loopback):
            part.wrong("connect", f"connect '{text}' goes past tls; write tls/... or quic/...")
    if not encrypted:
        part.wrong("tls", "tls is given, but no endpoint uses it; write tls/HOST:PORT or quic/HOST:PORT")


def _files(part: Part, settings: Zenoh) -> None:
    """The files of the host that is here: there, readable, fitting together, the key private."""
    if settings.password_file is not None:
        try:
            if settings.user not in passwords(settings.password_file):
                what = f"{settings.password_file}: has no line for user '{settings.user}'"
                part.wrong("password_file", f"{what}; add {settings.user}:PASSWORD")
        except InputError as error:
            part.wrong("password_file", str(error))
    tls = settings.tls
    for key, path in _paths(tls).items():
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            part.wrong("tls", f"{key} {path}: cannot be read: {error.strerror}")
            return
    if tls is not None and tls.key is not None and tls.key.stat().st_mode & 0o007:
        part.wrong("tls", f"key {tls.key}: everybody on this machine can read it; chmod o-rwx {tls.key}")
    if tls is not None:
        _fitting(part, tls)


def _paths(tls: Tls | None) -> dict[str, Path]:
    files: dict[str, Any] = (
        {} if tls is None else {"ca": tls.ca, "certificate": tls.certificate, "key": tls.key}
    )
    return {key: path for key, path in files.items() if path is not None}


def _fitting(part: Part, tls: Tls) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(cafile=tls.ca)
    except ssl.SSLError:
        part.wrong("tls", f"ca {tls.ca}: is no certificate in PEM")
    if tls.certificate is None or tls.key is None:
        return
    try:
        context.load_cert_chain(tls.certificate, tls.key, password=lambda: b"-")
    except ssl.SSLError as error:
        reason = (
            "do not belong together" if error.reason == "KEY_VALUES_MISMATCH" else "are not two PEM files"
        )
        hint = "" if error.reason == "KEY_VALUES_MISMATCH" else ", the key without a passphrase"
        part.wrong("tls", f"certificate {tls.certificate} and key {tls.key} {reason}{hint}")


# --- ways ----------------------------------------------------------------------------------------


def _ways(found: Sessions, where: Value) -> None:
    """Every host reaches every other: by an address that one listens on, or by a router outside."""
    if len(found.settings) < 2:
        return
    listens = {name: list(map(endpoints.parse, one.listen)) for name, one in found.settings.items()}
    joined = {name: {name} for name in found.settings}
    outside: dict[str, set[str]] = {}
    for name, one in found.settings.items():
        for text in one.connect:
            others = [host for host in listens if host != name and _reached(text, listens[host])]
            if others:
                _join(joined, [name, *others])
            elif not _reached(text, listens[name]):
                outside.setdefault(text, set()).add(name)
    for names in outside.values():
        _join(joined, list(names))
    connected = set().union(*outside.values()) if outside else set()
    if len({frozenset(group) for group in joined.values()}) > 1 and len(connected) > 1:
        _join(joined, sorted(connected))
        routers = ", ".join(sorted(outside))
        found.notes.append(f"hosts reach each other only if these addresses are one router's: {routers}")
    groups = sorted({tuple(sorted(group)) for group in joined.values()})
    if len(groups) > 1:
        text = " | ".join(", ".join(group) for group in groups)
        what = f"zenoh: these hosts have no way to each other: {text}; let one listen where another connects"
        found.problems.append(where.at(what))


def _reached(text: str, listens: list[Endpoint]) -> bool:
    return any(endpoints.parse(text).reaches(one) for one in listens)


def _join(joined: dict[str, set[str]], names: list[str]) -> None:
    group = set().union(*(joined[name] for name in names))
    for name in group:
        joined[name] = group


def _lists(found: Sessions) -> None:
    """A note when a host does not let in the user of another."""
    for name, one in found.settings.items():
        for other, settings in found.settings.items():
            if one.users is not None and settings.user is not None and settings.user not in one.users:
                found.notes.append(f"host '{name}' does not list user '{settings.user}' of host '{other}'")
