"""Zenoh endpoints: their syntax, whether they stay on this machine, whether hosts find each other."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass

__all__ = ["PROTOCOLS", "Endpoint", "parse"]

PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws", "unixsock-stream")
ENCRYPTED = ("tls", "quic")
_HOST = re.compile(r"(?!-)[A-Za-z0-9_.-]{1,253}")
_OPTIONS = ("iface", "bind")  # others would override what the deployment says, TLS among them


@dataclass(frozen=True, slots=True)
class Endpoint:
    """An address to listen on or to connect to."""

    protocol: str
    host: str  # of a socket file: its path
    port: int = 0

    @property
    def encrypted(self) -> bool:
        """Whether TLS protects what it carries."""
        return self.protocol in ENCRYPTED

    @property
    def loopback(self) -> bool:
        """Whether only this machine can reach it."""
        if self.protocol == "unixsock-stream" or self.host == "localhost":
            return True
        address = _address(self.host)
        return address is not None and address.is_loopback

    def reaches(self, other: Endpoint) -> bool:
        """Whether who connects to this endpoint may reach one who listens on the other.

        Of a name beside an address nobody knows before it is looked up, which another host may do otherwise.
        """
        if (self.protocol, self.port) != (other.protocol, other.port):
            return False
        if self.host == other.host:
            return True
        here, there = _address(self.host), _address(other.host)
        return (here is None and there is not None) or (there is not None and there.is_unspecified)


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def parse(text: str) -> Endpoint:
    """The endpoint `PROTOCOL/HOST:PORT` or `unixsock-stream/PATH`; raises ValueError that says why not."""
    protocol, slash, rest = text.partition("/")
    if not slash or protocol not in PROTOCOLS:
        raise ValueError(f"write PROTOCOL/HOST:PORT, with a protocol of {', '.join(PROTOCOLS)}")
    address, hash_, options = rest.partition("#")
    if "?" in address:
        raise ValueError("metadata after ? is not allowed")
    names = [one.partition("=")[0] for one in options.split(";")] if hash_ else []
    if set(names) - set(_OPTIONS):
        raise ValueError(f"after # only {' and '.join(_OPTIONS)} may stand")
    if protocol == "unixsock-stream":
        if not address.startswith("/"):
            raise ValueError("the path of a socket file is absolute: unixsock-stream//run/fls.sock")
        return Endpoint(protocol, address)
    return _internet(protocol, address)


def _internet(protocol: str, address: str) -> Endpoint:
    host, colon, port = address.rpartition(":")
    if not (colon and port.isascii() and port.isdigit() and int(port) <= 65535):
        raise ValueError("it ends with a port from 0 to 65535, for example tcp/10.0.0.1:7447")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
        if not isinstance(_address(host), ipaddress.IPv6Address):
            raise ValueError(f"'{host}' is no IPv6 address")
    elif re.fullmatch(r"[0-9.]+", host):
        if _address(host) is None:
            raise ValueError(f"'{host}' is no IPv4 address")
    elif not _HOST.fullmatch(host):
        raise ValueError(f"'{host}' is no host; write a name, an IPv4 address or an IPv6 address in brackets")
    return Endpoint(protocol, host, int(port))
