"""Where frames come from and commands go to, as a person writes it: `udp://127.0.0.1:9870`, `replay:nuisi/test/3`."""

from __future__ import annotations

import difflib
import os
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import parse_qsl, urlsplit

from mild_viz.errors import UserError

LOOPBACK = "127.0.0.1"
"""The host where none is given: nobody else can reach it."""


@dataclass(frozen=True)
class Address:
    """A parsed address. `host` and `port` belong to network schemes, `place` is what follows them, or the colon."""

    text: str
    scheme: str
    host: str = ""
    port: int = 0
    place: str = ""
    options: Mapping[str, str] = field(default_factory=dict)

    def number(self, option: str, default: float, lowest: float, highest: float) -> float:
        """A numeric option."""
        text = self.options.get(option, str(default))
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not lowest <= value <= highest:
            raise UserError(f"{self.text}: {option} is '{text}'; expected: a number from {lowest:g} to {highest:g}")
        return value

    def choice(self, option: str, valid: tuple[str, ...]) -> str:
        """An option that has a few values, of which the first is the default."""
        value = self.options.get(option, valid[0])
        if value not in valid:
            raise UserError(f"{self.text}: {option} is '{value}'; valid: {', '.join(valid)}")
        return value


def parse(text: str, kind: str, schemes: Mapping[str, str]) -> Address:
    """Take an address of `kind` ('input' or 'output') apart; `schemes` gives an example of each one that is valid."""
    scheme, colon, place = text.partition(":")
    if scheme not in schemes or (text != "none" if scheme == "none" else not colon):
        raise UserError(f"{kind} '{text}' is unknown; valid: {', '.join(schemes.values())}")
    example = schemes[scheme]
    if scheme in ("csv", "none"):  # a file's name may hold anything
        return Address(text, scheme, place=place)
    try:
        parts = urlsplit(text)
        host, port = parts.hostname or LOOPBACK, parts.port
    except ValueError as error:
        raise UserError(f"{kind} '{text}' is no address ({error}); expected: {example}") from None
    options = _options(text, parts.query)
    if scheme == "replay":
        return Address(text, scheme, place=parts.path, options=options)
    if not place.startswith("//") or port is None or parts.username is not None:
        raise UserError(f"{kind} '{text}' has no host and port; expected: {example}")
    return Address(text, scheme, host, port, parts.path, options)


def check_options(address: Address, valid: tuple[str, ...]) -> None:
    """Refuse an option that is not in `valid`, naming the nearest."""
    for name in address.options:
        if name not in valid:
            close = difflib.get_close_matches(name[:40], valid, n=1)
            hint = f"did you mean '{close[0]}'?" if close else f"valid: {', '.join(valid) or 'none'}"
            raise UserError(f"{address.text}: option '{name}' is unknown; {hint}")


def resolve(address: Address, kind: socket.SocketKind) -> tuple[socket.AddressFamily, tuple]:
    """The family and socket address that an address's host and port stand for."""
    try:
        family, _, _, _, place = socket.getaddrinfo(address.host, address.port, type=kind)[0]
    except (OSError, UnicodeError):  # UnicodeError: a label that is empty or too long for any name
        raise UserError(f"{address.text}: host '{address.host}' is unknown; valid: such as {LOOPBACK}") from None
    return family, place


def host_and_port(place: tuple) -> str:
    """A socket address for people."""
    return f"[{place[0]}]:{place[1]}" if ":" in place[0] else f"{place[0]}:{place[1]}"


def bind(address: Address, kind: socket.SocketKind) -> socket.socket:
    """A socket of this machine at exactly this address.

    Raises:
        UserError: if another program has the port, or the address is not this machine's.
    """
    family, place = resolve(address, kind)
    bound = socket.socket(family, kind)
    try:
        if kind == socket.SOCK_STREAM and os.name == "posix":  # elsewhere it would share the port
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # after a restart, without waiting a minute
        bound.bind(place)
    except OSError as error:
        bound.close()
        raise UserError(
            f"{address.text} cannot be bound: {error.strerror or error}; "
            f"expected: a free port of this machine, such as {address.scheme}://{LOOPBACK}:{address.port + 1}"
        ) from None
    return bound


def _options(text: str, query: str) -> dict[str, str]:
    try:
        return dict(parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query)))
    except ValueError:
        raise UserError(f"{text}: '?{query}' is unusable; expected: ?name=value&name=value") from None
