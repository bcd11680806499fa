"""CURVE keys: who may talk to a rig, and how a client proves itself.

A key file is ZeroMQ's certificate format: lines ``public-key = "…"`` and, in the secret file,
``secret-key = "…"``, each 40 characters of Z85. `NAME.key` may be given away; `NAME.key_secret`
stays where it was made and only its owner may read it.

The daemon's folder ([network] keys)      A client's folder (UMBRA_KEYS, or ~/.config/umbra/keys)
    server.key, server.key_secret             NAME.key, NAME.key_secret    its own pair, one only
    operators/NAME.key                        server.key                   the rig's public key
    observers/NAME.key
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import stat
from dataclasses import dataclass, field
from pathlib import Path

import zmq
from zmq.utils import z85

from protocol.errors import Code, UmbraError
from protocol.messages.access import Role

SERVER = "server"
FOLDERS = {Role.OPERATOR: "operators", Role.OBSERVER: "observers"}

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_LINE = re.compile(r'^\s*(public-key|secret-key)\s*=\s*"([^"\s]*)"\s*$', re.MULTILINE)

log = logging.getLogger("umbra")


def _bad(message: str) -> UmbraError:
    return UmbraError(Code.BAD_KEYS, message)


@dataclass(frozen=True)
class KeyPair:
    """Both halves of a key, as Z85 text."""

    name: str
    public: bytes
    secret: bytes = field(repr=False)


@dataclass(frozen=True)
class ClientKeys:
    """What a client needs: its own pair and the rig's public key."""

    name: str
    public: bytes
    secret: bytes = field(repr=False)
    server: bytes
    where: str = ""

    @classmethod
    def load(cls, folder: Path | str) -> ClientKeys:
        """The keys in a client's folder. Raises UmbraError(bad_keys)."""
        folder = Path(folder).expanduser()
        secrets = [p for p in sorted(folder.glob("*.key_secret")) if p.stem != SERVER]
        if not secrets:
            raise _bad(f"{folder} holds no key of yours: make one with 'umbra keys new'")
        if len(secrets) > 1:
            names = ", ".join(p.stem for p in secrets)
            raise _bad(f"{folder} holds several keys ({names}): give each a folder of its own")
        server = folder / f"{SERVER}.key"
        if not server.is_file():
            raise _bad(f"{server} is missing: copy the rig's server.key there")
        pair = _pair(secrets[0])
        return cls(pair.name, pair.public, pair.secret, read_public(server), str(folder))

    @classmethod
    def default(cls, *, local: bool) -> ClientKeys | None:
        """The keys to use where none were named.

        UMBRA_KEYS always counts. The folder in the home directory counts for rigs beyond this
        machine: a rig on loopback has no keys unless it was given some.
        """
        if named := os.environ.get("UMBRA_KEYS"):
            return cls.load(named)
        folder = default_folder()
        return None if local or not folder.is_dir() else cls.load(folder)


def default_folder() -> Path:
    """Where a client's keys are: UMBRA_KEYS, or umbra/keys in the user's configuration."""
    if named := os.environ.get("UMBRA_KEYS"):
        return Path(named)
    base = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(base).expanduser() / "umbra" / "keys"


# ---------------------------------------------------------------- making and allowing


def new(folder: Path | str, name: str) -> tuple[Path, Path]:
    """Make a key pair: the paths of NAME.key and NAME.key_secret. Never replaces a key.

    Raises UmbraError(bad_keys) for a name that is no file name or where a key is already.
    """
    folder = Path(folder).expanduser()
    public_file, secret_file = folder / f"{_name(name)}.key", folder / f"{name}.key_secret"
    for path in (public_file, secret_file):
        if path.exists():
            raise _bad(f"{path} is there already: remove it first, or choose another name")
    public, secret = (half.decode() for half in zmq.curve_keypair())
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        _write(secret_file, _text(name, public, secret), 0o600)
        _write(public_file, _text(name, public), 0o644)
    except OSError as error:
        raise _bad(f"the key {name} can't be written to {folder}: {error.strerror}") from error
    return public_file, secret_file


def authorize(keys_dir: Path | str, public_key_file: Path | str, role: Role) -> Path:
    """Let a client's public key in, with a role; a role that it had before ends.

    The key's name is the file's. Answers with the file written. Raises UmbraError(bad_keys).
    """
    source = Path(public_key_file).expanduser()
    public, name = read_public(source), _name(source.stem)
    path = Path(keys_dir) / FOLDERS[role] / f"{name}.key"
    if path.exists() and read_public(path) != public:
        raise _bad(f"{name} is another key already: rename {source}, or revoke {name} first")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = path.with_suffix(".new")
        fresh.unlink(missing_ok=True)
        _write(fresh, _text(name, public.decode()), 0o644)
        fresh.replace(path)
        for file, _, _, key in _entries(Path(keys_dir)):
            if key == public and file != path:
                file.unlink()
    except OSError as error:
        raise _bad(f"{path} can't be written: {error.strerror}") from error
    return path


def revoke(keys_dir: Path | str, name: str) -> None:
    """Let a key in no longer, whatever its role. Raises UmbraError(bad_keys) if it wasn't."""
    files = [Path(keys_dir) / folder / f"{_name(name)}.key" for folder in FOLDERS.values()]
    found = [path for path in files if path.exists()]
    if not found:
        raise _bad(f"no key named {name} is allowed in {keys_dir}")
    for path in found:
        path.unlink()


# ---------------------------------------------------------------- the daemon's side


def load_server(keys_dir: Path | str) -> KeyPair:
    """The daemon's own pair. Raises UmbraError(bad_keys) with what to do."""
    secret = Path(keys_dir) / f"{SERVER}.key_secret"
    if not secret.is_file():
        raise _bad(f"{secret} is missing: make it with 'umbra keys new server --into {keys_dir}'")
    return _pair(secret)


def allowed(keys_dir: Path | str) -> dict[str, tuple[Role, str]]:
    """Who may come in: public key (Z85) -> role and name.

    A key in both folders is an observer. A file that can't be read lets nobody in and is logged.
    """
    found: dict[str, tuple[Role, str]] = {}
    for _, role, name, public in _entries(Path(keys_dir)):
        found[public.decode()] = (role, name)
    return found


class AllowList:
    """`allowed`, read again when a file has changed: revoking a key needs no restart."""

    def __init__(self, keys_dir: Path | str) -> None:
        self._folder = Path(keys_dir)
        self._stamp: object = None
        self._allowed: dict[str, tuple[Role, str]] = {}

    def current(self) -> dict[str, tuple[Role, str]]:
        """Who may come in now."""
        stamp = self._look()
        if stamp != self._stamp:
            self._stamp, self._allowed = stamp, allowed(self._folder)
        return self._allowed

    def _look(self) -> object:
        seen: list[tuple[str, int, int, int]] = []
        for path in _files(self._folder):
            with contextlib.suppress(FileNotFoundError):  # removed since: that is a change too
                facts = path.stat()
                seen.append((str(path), facts.st_mtime_ns, facts.st_size, facts.st_ino))
        return seen


# ---------------------------------------------------------------- files


def read_public(path: Path) -> bytes:
    """The public key in a file. Raises UmbraError(bad_keys)."""
    return _read(path, "public-key")


def _pair(secret_file: Path) -> KeyPair:
    _private(secret_file)
    public, secret = _read(secret_file, "public-key"), _read(secret_file, "secret-key")
    if zmq.curve_public(secret) != public:
        raise _bad(f"{secret_file}: the two halves don't belong together; make a new key")
    return KeyPair(secret_file.stem, public, secret)


def _private(path: Path) -> None:
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise _bad(f"{path} can't be read: {error.strerror}") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise _bad(f"{path} is a secret that others can read: chmod 600 {path}")


def _read(path: Path, half: str) -> bytes:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise _bad(f"{path} can't be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise _bad(f"{path} is not a key file") from error
    found = dict(_LINE.findall(text)).get(half, "")
    with contextlib.suppress(ValueError, KeyError, UnicodeEncodeError):
        if len(found) == 40 and len(z85.decode(found)) == 32:
            return bytes(found, "ascii")
    raise _bad(f'{path} is not a key file: it has no line {half} = "…" of 40 characters')


def _files(keys_dir: Path) -> list[Path]:
    return [p for folder in FOLDERS.values() for p in sorted((keys_dir / folder).glob("*.key"))]


def _entries(keys_dir: Path) -> list[tuple[Path, Role, str, bytes]]:
    """The readable entries, operators first."""
    roles = {folder: role for role, folder in FOLDERS.items()}
    found = []
    for path in _files(keys_dir):
        try:
            found.append((path, roles[path.parent.name], path.stem, read_public(path)))
        except UmbraError as error:
            log.warning("lets nobody in: %s", error)
    return found


def _name(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise _bad(f"{name!r} can't name a key: use letters, digits, and . _ - between them")
    return name


def _text(name: str, public: str, secret: str = "") -> str:
    lines = [
        f"# Umbra: {'SECRET' if secret else 'public'} CURVE key of {name}",
        "metadata",
        f'    name = "{name}"',
        "curve",
        f'    public-key = "{public}"',
    ]
    if secret:
        lines.append(f'    secret-key = "{secret}"')
    return "\n".join(lines) + "\n"


def _write(path: Path, text: str, mode: int) -> None:
    """A new file, never readable by more than `mode` says, not even for a moment."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
