"""Who may come in: CURVE with a ZAP allow-list, and the refusal to be open to the network.

CURVE alone encrypts for any stranger; the allow-list (`umbra keys authorize`) is what shuts the
door. It is read again when it changes, and each request is held against it once more, so a key
that is revoked ends at once, its open connections included.
"""

from __future__ import annotations

import ipaddress
from typing import Any
from urllib.parse import urlsplit

import structlog
import zmq
import zmq.asyncio
from zmq.auth.asyncio import AsyncioAuthenticator

from daemon.config import ConfigError
from daemon.serving.server import Caller
from protocol.errors import Code, UmbraError
from protocol.keys import AllowList, KeyPair, load_server
from protocol.messages.access import Role

DOMAIN = "umbra"

log = structlog.get_logger(__name__)


def is_local(endpoint: str) -> bool:
    """Whether only processes of this machine can reach an endpoint."""
    parts = urlsplit(endpoint)
    if parts.scheme in {"ipc", "inproc"}:
        return True
    host = parts.hostname or "*"
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_exposure(endpoints: tuple[str, ...], keys: str) -> None:
    """Raise ConfigError for an endpoint that the network could reach without keys."""
    for endpoint in endpoints:
        if not is_local(endpoint) and not keys:
            raise ConfigError(
                f"network: {endpoint} can be reached by anyone on the network: make keys "
                "(`umbra keys new server --into DIR`) and name their folder in network.keys, "
                "or bind tcp://127.0.0.1"
            )


def check_keys(keys: str) -> None:
    """Raise ConfigError when the daemon's own keys are not to be had."""
    if keys:
        _own_pair(keys)


def _own_pair(keys: str) -> KeyPair:
    try:
        return load_server(keys)
    except UmbraError as error:
        raise ConfigError(f"network.keys: {error.message}") from error


class Access:
    """Locks sockets and knows callers. Without keys everybody on this machine is an operator."""

    def __init__(self, context: zmq.asyncio.Context, keys: str) -> None:
        """Raises ConfigError when the daemon's own keys are not to be had."""
        self._allowed: AllowList | None = None
        self._pair: KeyPair | None = None
        self._authenticator: AsyncioAuthenticator | None = None
        if not keys:
            return
        self._pair = _own_pair(keys)
        self._allowed = AllowList(keys)
        self._authenticator = AsyncioAuthenticator(context)
        self._authenticator.configure_curve_callback(DOMAIN, _Provider(self._allowed))

    def start(self) -> None:
        """Begin to answer the library's questions; before any socket is bound."""
        if self._authenticator is not None:
            self._authenticator.start()

    def stop(self) -> None:
        """Answer no more."""
        if self._authenticator is not None:
            self._authenticator.stop()

    def lock(self, socket: zmq.Socket[Any]) -> None:
        """Make a socket that is not yet bound a CURVE server of this daemon."""
        if self._pair is None:
            return
        socket.curve_publickey = self._pair.public
        socket.curve_secretkey = self._pair.secret
        socket.curve_server = True
        socket.zap_domain = DOMAIN.encode()

    def caller(self, frame: zmq.Frame) -> Caller | None:
        """Who sent a frame; None for a key that has been revoked since it connected."""
        if self._allowed is None:
            return Caller(Role.OPERATOR, "")
        try:
            key = str(frame.get("User-Id"))
        except zmq.ZMQError:
            return None
        entry = self._allowed.current().get(key)
        return Caller(*entry) if entry else None


class _Provider:
    """The library's question, whether a public key may come in."""

    def __init__(self, allowed: AllowList) -> None:
        self._allowed = allowed

    def callback(self, domain: str, key: bytes) -> bool:
        """True for a key on the list."""
        del domain
        try:
            entry = self._allowed.current().get(key.decode("ascii"))
        except UmbraError as error:
            log.warning("the list of keys cannot be read", error=error.message)
            return False
        if entry is None:
            log.warning(
                "unknown key refused", key=key.decode("ascii", "replace"), code=Code.FORBIDDEN
            )
        return entry is not None
