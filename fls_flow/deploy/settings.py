"""The `zenoh:` part of a deployment file as written: settings for all hosts, those of each host over them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from fls_flow.catalog import suggest
from fls_flow.deploy import endpoints
from fls_flow.deploy.session import Tls, Zenoh
from fls_flow.document import Value, shown
from fls_flow.errors import Problem

__all__ = ["KEYS", "Part", "Sessions", "read"]

KEYS = ("mode", "listen", "connect", "tls", "user", "password_file", "access_control", "open")
TLS_KEYS = ("ca", "certificate", "key", "mutual")
ACCESS_KEYS = ("users", "certificates")
MODES = ("router", "peer")  # a client cannot be reached by the processes of its own host


@dataclass
class Sessions:
    """The settings of each host, and what is wrong with them."""

    settings: dict[str, Zenoh] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class Part:
    """The settings of one host as written."""

    name: str
    values: dict[str, Value]
    where: Value  # for what is missing
    all: Sessions

    def wrong(self, key: str, what: str) -> None:
        """Add a problem, where the key stands if it is there."""
        self.all.problems.append(self.values.get(key, self.where).at(f"zenoh: {what}"))

    def note(self, what: str) -> None:
        """Add a note about this host."""
        self.all.notes.append(f"host '{self.name}' {what}")

    def get(self, key: str) -> Value | None:
        """The value of a key; None when it is missing or empty."""
        value = self.values.get(key)
        return None if value is None or value.data is None else value


def read(given: Value | None, root: Value, hosts: tuple[str, ...]) -> tuple[Sessions, list[Part]]:
    """The settings of all `hosts`, and what is written of each host whose settings can be judged."""
    found = Sessions()
    if given is not None and not isinstance(given.data, dict):
        found.problems.append(given.at(f"'zenoh' is {shown(given)}; it maps settings to values"))
        return found, []
    above = {} if given is None else given.mapping
    _unknown(above, (*KEYS, *hosts), "zenoh", found)
    sound = []
    for name in hosts:
        before = len(found.problems)
        part = _over(above, name, given or root, found)
        found.settings[name] = _settings(part)
        if len(found.problems) == before:
            sound.append(part)
    return found, sound


def _unknown(given: Mapping[str, Value], known: Iterable[str], of: str, found: Sessions) -> None:
    for key, value in given.items():
        if key not in known:
            hint = suggest(key, known) or f"; it has {', '.join(known)}"
            found.problems.append(value.at(f"{of} has no key '{key}'{hint}"))


def _over(above: Mapping[str, Value], host: str, where: Value, found: Sessions) -> Part:
    """What stands for all hosts, and over it what stands for this one; `tls` key by key."""
    values = {key: value for key, value in above.items() if key in KEYS}
    own = above.get(host)
    if own is None:
        return Part(host, values, where, found)
    if own.data is not None and not isinstance(own.data, dict):
        found.problems.append(own.at(f"zenoh: host '{host}' is {shown(own)}; it maps settings to values"))
    _unknown(own.mapping, KEYS, f"zenoh of host '{host}'", found)
    for key, value in own.mapping.items():
        if key == "tls" and isinstance(value.data, dict) and "tls" in values:
            value = Value(value.where, {**values["tls"].mapping, **value.mapping}, value.folder)
        values[key] = value
    return Part(host, values, own, found)


# --- values --------------------------------------------------------------------------------------


def _settings(part: Part) -> Zenoh:
    mode, user = part.get("mode"), part.get("user")
    if mode is not None and mode.data not in MODES:
        part.wrong("mode", f"mode is {shown(mode)}; it is one of {', '.join(MODES)}")
    if user is not None and not (isinstance(user.data, str) and user.data and ":" not in user.data):
        part.wrong("user", f"user is {shown(user)}; it is a name without a colon")
    if (user is None) != (part.get("password_file") is None):
        given, missing = ("user", "password_file") if user is not None else ("password_file", "user")
        part.wrong(given, f"{given} needs {missing}")
    access = _section(part, "access_control", ACCESS_KEYS)
    users, certificates = (_texts(part, access.get(key), key) for key in ACCESS_KEYS)
    if part.get("access_control") is not None and users is None and certificates is None:
        part.wrong("access_control", "access_control lists users or certificates that may exchange messages")
    return Zenoh(
        mode.data if mode is not None else "router",
        _endpoints(part, "listen"),
        _endpoints(part, "connect"),
        _tls(part),
        user.data if user is not None else None,
        _file(part, part.get("password_file"), "password_file"),
        users,
        certificates,
        _flag(part, part.get("open"), "open", default=False),
    )


def _section(part: Part, key: str, known: tuple[str, ...]) -> dict[str, Value]:
    value = part.get(key)
    if value is not None and not isinstance(value.data, dict):
        part.wrong(key, f"{key} is {shown(value)}; it has {', '.join(known)}")
    mapping = {} if value is None else value.mapping
    _unknown(mapping, known, f"zenoh: {key}", part.all)
    return {name: one for name, one in mapping.items() if one.data is not None}


def _problem(part: Part, value: Value, what: str) -> None:
    part.all.problems.append(value.at(f"zenoh: {what}"))


def _texts(part: Part, value: Value | None, key: str) -> tuple[str, ...] | None:
    if value is None:
        return None
    if not isinstance(value.data, list) or not all(
        isinstance(one.data, str) and one.data for one in value.data
    ):
        _problem(part, value, f"{key} is {shown(value)}; it is a list of texts")
        return ()
    return tuple(dict.fromkeys(one.data for one in value.data))


def _flag(part: Part, value: Value | None, key: str, *, default: bool) -> bool:
    if value is not None and not isinstance(value.data, bool):
        _problem(part, value, f"{key} is {shown(value)}; it is true or false")
    return default if value is None else bool(value.data)


def _file(part: Part, value: Value | None, key: str) -> Path | None:
    """The path, beside the deployment file if it is relative."""
    if value is None:
        return None
    if not (isinstance(value.data, str) and value.data):
        _problem(part, value, f"{key} is {shown(value)}; it is the path of a file")
        return None
    try:
        return (value.folder or Path.cwd()) / Path(value.data).expanduser()
    except RuntimeError:  # ~ of a user that is not there
        _problem(part, value, f"{key} is {shown(value)}; there is no such user's folder")
        return None


def _endpoints(part: Part, key: str) -> tuple[str, ...]:
    value = part.get(key)
    texts = _texts(part, value, key) or ()
    for one in value.data if value is not None and texts else ():
        try:
            endpoints.parse(one.data)
        except ValueError as error:
            _problem(part, one, f"{key} '{one.data}': {error}")
    return texts


def _tls(part: Part) -> Tls | None:
    if part.get("tls") is None:
        return None
    given = _section(part, "tls", TLS_KEYS)
    files = {key: _file(part, given.get(key), key) for key in ("ca", "certificate", "key")}
    mutual = _flag(part, given.get("mutual"), "mutual", default=True)
    if "ca" not in given:
        part.wrong("tls", "tls needs ca, the certificate of who signs the others'")
    if ("certificate" in given) != ("key" in given) or (mutual and "key" not in given):
        why = "so that the others know this host; or mutual: false" if mutual else "both or neither"
        part.wrong("tls", f"tls needs certificate and key, {why}")
    if files["ca"] is None:
        return None
    return Tls(files["ca"], files["certificate"], files["key"], mutual)
