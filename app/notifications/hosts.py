"""Where the service may send something of its own accord: hosts that the settings name, and no private address else."""

from __future__ import annotations

import ipaddress
import socket
from dataclasses import dataclass
from typing import Final
from urllib.parse import SplitResult, urlsplit

from magcal_core.errors import InputError, MagcalError

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network

PORTS: Final = {"http": 80, "https": 443}
TRANSLATED: Final = ipaddress.IPv6Network("64:ff9b::/96")
"""IPv4 addresses as a network of IPv6 alone reaches them (NAT64): the last four bytes are the address."""
TRANSLATED_LOCALLY: Final = ipaddress.IPv6Network("64:ff9b:1::/48")
"""The same as a network lays it out for itself, so that nobody else can tell which address is meant."""
LOOPBACK: Final[tuple[Network, ...]] = (ipaddress.IPv4Network("127.0.0.0/8"), ipaddress.IPv6Network("::1/128"))


class WebhookUrlError(InputError):
    """An address that a webhook cannot have."""

    code = "webhook_url"


class WebhookHostError(InputError):
    """A host that the settings do not name for webhooks."""

    code = "webhook_host"


class AddressRefusedError(MagcalError):
    """A host's address is one of a private network, and not listed."""

    code = "webhook_host"


@dataclass(frozen=True, slots=True)
class Target:
    """A URL taken apart."""

    scheme: str
    host: str
    port: int
    path: str

    @property
    def authority(self) -> str:
        """Host and, where it is not the scheme's own, port."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return host if self.port == PORTS[self.scheme] else f"{host}:{self.port}"

    def at(self, address: Address) -> str:
        """Return the URL with the host's address in its place."""
        host = f"[{address}]" if address.version == 6 else str(address)
        return f"{self.scheme}://{host}:{self.port}{self.path}"


def target_of(url: str) -> Target:
    """Return ``url`` taken apart.

    Raises
    ------
    WebhookUrlError
        It is not an http or https URL of a host, or it carries a user or a fragment.
    """
    if not url.isascii() or not url.isprintable() or " " in url:
        raise WebhookUrlError("the URL has characters that must be percent-encoded")
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise WebhookUrlError("the URL has no such host or port") from None
    if parts.scheme not in PORTS or not parts.hostname:
        raise WebhookUrlError("want http:// or https:// and a host")
    if "@" in parts.netloc or parts.fragment:
        raise WebhookUrlError("a user, a password or a fragment has no place in the URL")
    return Target(parts.scheme, parts.hostname.rstrip("."), port or PORTS[parts.scheme], _path(parts))


def _path(parts: SplitResult) -> str:
    return (parts.path or "/") + (f"?{parts.query}" if parts.query else "")


@dataclass(frozen=True, slots=True)
class AllowedHosts:
    """The hosts of a list, each with a port or for all ports (None), and the networks whose addresses it names."""

    names: frozenset[tuple[str, int | None]]
    networks: tuple[tuple[Network, int | None], ...]

    @classmethod
    def of(cls, listed: str) -> AllowedHosts:
        """Return what a comma-separated list names: hosts, addresses, networks, each with ``:port`` or without.

        Raises
        ------
        WebhookUrlError
            An entry has a port that is none.
        """
        names: set[tuple[str, int | None]] = set()
        networks: list[tuple[Network, int | None]] = []
        for entry in filter(None, (one.strip().lower() for one in listed.split(","))):
            host, port = _split(entry)
            network = _network(host)
            if network is not None:
                networks.append((network, port))
                continue
            names.add((host.rstrip("."), port))
            if host == "localhost":
                networks += [(one, port) for one in LOOPBACK]
        return cls(frozenset(names), tuple(networks))

    def require(self, target: Target) -> None:
        """Raise WebhookHostError where the list does not name the target's host."""
        address = _address(target.host)
        is_named = (target.host, None) in self.names or (target.host, target.port) in self.names
        if not (is_named or (address is not None and self._has(address, target.port))):
            raise WebhookHostError("MAGCAL_WEBHOOK_HOSTS does not name the host of the URL")

    def addresses(self, target: Target) -> list[Address]:
        """Return the addresses of the target's host, as they are now.

        Raises
        ------
        WebhookHostError, AddressRefusedError
            The list does not name the host, or an address is none of the public network and not listed.
        OSError
            The name has no address.
        """
        self.require(target)
        found = socket.getaddrinfo(target.host, target.port, type=socket.SOCK_STREAM)
        addresses = list(dict.fromkeys(ipaddress.ip_address(str(one[4][0]).partition("%")[0]) for one in found))
        for address in addresses:
            if not (is_public(address) or self._has(address, target.port)):
                raise AddressRefusedError(f"{target.host} is {address}, a private address that is not listed")
        return addresses

    def _has(self, address: Address, port: int) -> bool:
        plain = _plain(address)
        return any(
            plain.version == network.version and plain in network and on_port in {None, port}
            for network, on_port in self.networks
        )


def is_public(address: Address) -> bool:
    """Return whether an address is one of the public network."""
    plain = _plain(address)
    return plain.is_global and not plain.is_multicast and plain not in TRANSLATED_LOCALLY


def _plain(address: Address) -> Address:
    """Return the IPv4 address that an IPv6 address stands for, or the address itself."""
    if not isinstance(address, ipaddress.IPv6Address):
        return address
    if address in TRANSLATED:
        return ipaddress.IPv4Address(int(address) & 0xFFFF_FFFF)
    return address.ipv4_mapped or address.sixtofour or address


def _address(host: str) -> Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _network(host: str) -> Network | None:
    try:
        return ipaddress.ip_network(host, strict=False)
    except ValueError:
        return None


def _split(entry: str) -> tuple[str, int | None]:
    """Return host and port of an entry; an IPv6 address with a port stands in brackets."""
    if entry.startswith("["):
        host, _, rest = entry[1:].partition("]")
        port = rest.removeprefix(":")
    elif entry.count(":") == 1:
        host, _, port = entry.partition(":")
    else:
        host, port = entry, ""
    if not port:
        return host, None
    if not port.isdigit() or not 0 < int(port) < 65536:
        raise WebhookUrlError("MAGCAL_WEBHOOK_HOSTS has an entry with a port that is none")
    return host, int(port)
