"""CURVE keys: files, the allow-list, and who gets an answer."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
import zmq
import zmq.auth

from protocol import keys
from protocol.client import Client
from protocol.errors import Code, UmbraError
from protocol.keys import AllowList, ClientKeys, KeyPair
from protocol.messages.access import Role
from tests.protocol.fake import FakeRig

Connect = Callable[..., Client]


@pytest.fixture(autouse=True)
def _no_keys_of_ones_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("UMBRA_KEYS", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


@pytest.fixture
def server(tmp_path: Path) -> Path:
    keys.new(tmp_path / "rig", "server")
    return tmp_path / "rig"


def client_folder(folder: Path, name: str, server: Path) -> Path:
    keys.new(folder, name)
    (folder / "server.key").write_bytes((server / "server.key").read_bytes())
    return folder


# ---------------------------------------------------------------- files


def test_new_keys_are_a_pair_and_only_ones_own(tmp_path: Path) -> None:
    public_file, secret_file = keys.new(tmp_path / "k", "ada")
    assert stat.S_IMODE(secret_file.stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "k").stat().st_mode) == 0o700
    public, secret = zmq.auth.load_certificate(secret_file)  # it is ZeroMQ's own format
    assert secret is not None
    assert zmq.curve_public(secret) == public == keys.read_public(public_file)
    assert b"secret-key" not in public_file.read_bytes()
    assert secret not in public_file.read_bytes()


def test_zeromqs_own_certificates_are_read(tmp_path: Path) -> None:
    _, secret_file = zmq.auth.create_certificates(tmp_path, "server")
    Path(secret_file).chmod(0o600)
    assert keys.load_server(tmp_path).public == zmq.auth.load_certificate(secret_file)[0]


def test_a_key_is_never_replaced(tmp_path: Path) -> None:
    public_file, _ = keys.new(tmp_path, "ada")
    before = public_file.read_bytes()
    with pytest.raises(UmbraError, match="there already"):
        keys.new(tmp_path, "ada")
    assert public_file.read_bytes() == before


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "a b", 'a"b', "x" * 65])
def test_what_cannot_name_a_key(tmp_path: Path, name: str) -> None:
    with pytest.raises(UmbraError, match="can't name a key"):
        keys.new(tmp_path, name)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o622])
def test_a_secret_that_others_can_read_is_refused(server: Path, mode: int) -> None:
    secret = server / "server.key_secret"
    secret.chmod(mode)
    with pytest.raises(UmbraError, match="chmod 600") as caught:
        keys.load_server(server)
    assert caught.value.code is Code.BAD_KEYS


def test_a_missing_server_key_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(UmbraError, match="umbra keys new server"):
        keys.load_server(tmp_path)


@pytest.mark.parametrize(
    "text", [b"", b"hello", b"\xff\xfe", b'public-key = "short"', b'public-key = "' + b" " * 40]
)
def test_what_is_no_key_file(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "x.key").write_bytes(text)
    with pytest.raises(UmbraError, match="is not a key file"):
        keys.read_public(tmp_path / "x.key")


def test_halves_that_do_not_belong_together(server: Path, tmp_path: Path) -> None:
    keys.new(tmp_path / "other", "server")
    other = keys.read_public(tmp_path / "other" / "server.key")
    secret = server / "server.key_secret"
    own = keys.load_server(server).public
    secret.write_text(secret.read_text().replace(own.decode(), other.decode()))
    with pytest.raises(UmbraError, match="don't belong together"):
        keys.load_server(server)


def test_secrets_are_not_shown(server: Path, tmp_path: Path) -> None:
    pair = keys.load_server(server)
    client = ClientKeys.load(client_folder(tmp_path / "me", "ada", server))
    assert pair.secret.decode() not in repr(pair)
    assert client.secret.decode() not in repr(client)


# ---------------------------------------------------------------- a client's folder


def test_a_clients_folder(server: Path, tmp_path: Path) -> None:
    folder = tmp_path / "me"
    with pytest.raises(UmbraError, match="umbra keys new"):
        ClientKeys.load(folder)
    keys.new(folder, "ada")
    with pytest.raises(UmbraError, match=r"server\.key is missing"):
        ClientKeys.load(folder)
    (folder / "server.key").write_bytes((server / "server.key").read_bytes())
    loaded = ClientKeys.load(folder)
    assert loaded.name == "ada"
    assert loaded.server == keys.load_server(server).public
    keys.new(folder, "bob")
    with pytest.raises(UmbraError, match="several keys"):
        ClientKeys.load(folder)


def test_which_keys_are_used_where_none_were_named(
    server: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ClientKeys.default(local=False) is None
    client_folder(keys.default_folder(), "home", server)
    assert ClientKeys.default(local=True) is None
    home = ClientKeys.default(local=False)
    assert home is not None
    assert home.name == "home"
    monkeypatch.setenv("UMBRA_KEYS", str(client_folder(tmp_path / "env", "env", server)))
    for local in (True, False):
        named = ClientKeys.default(local=local)
        assert named is not None
        assert named.name == "env"


def test_no_keys_at_all_where_there_are_some(
    fake: FakeRig,
    connect: Connect,
    server: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("UMBRA_KEYS", str(client_folder(tmp_path / "env", "env", server)))
    with pytest.raises(UmbraError, match="keys it doesn't allow"):
        connect(fake.endpoint, timeout_s=0.3)  # the rig speaks plainly
    with connect(fake.endpoint, keys=False) as rig:
        assert rig.status().rig == "fake"


# ---------------------------------------------------------------- the allow-list


def test_authorize_and_revoke(server: Path, tmp_path: Path) -> None:
    public_file, _ = keys.new(tmp_path / "a", "ada")
    public = keys.read_public(public_file).decode()
    assert keys.allowed(server) == {}
    keys.authorize(server, public_file, Role.OBSERVER)
    assert keys.allowed(server) == {public: (Role.OBSERVER, "ada")}
    keys.authorize(server, public_file, Role.OPERATOR)  # the former role ends
    assert keys.allowed(server) == {public: (Role.OPERATOR, "ada")}
    keys.authorize(server, public_file, Role.OPERATOR)
    keys.revoke(server, "ada")
    assert keys.allowed(server) == {}
    with pytest.raises(UmbraError, match="no key named ada"):
        keys.revoke(server, "ada")


def test_a_secret_file_never_gets_into_the_allow_list(server: Path, tmp_path: Path) -> None:
    _, secret_file = keys.new(tmp_path / "a", "ada")
    path = keys.authorize(server, secret_file, Role.OPERATOR)
    assert "secret-key" not in path.read_text()


def test_another_key_of_the_same_name_is_refused(server: Path, tmp_path: Path) -> None:
    keys.authorize(server, keys.new(tmp_path / "a", "ada")[0], Role.OPERATOR)
    with pytest.raises(UmbraError, match="another key already"):
        keys.authorize(server, keys.new(tmp_path / "b", "ada")[0], Role.OPERATOR)


def test_a_key_in_both_folders_is_an_observer(server: Path, tmp_path: Path) -> None:
    path = keys.authorize(server, keys.new(tmp_path / "a", "ada")[0], Role.OPERATOR)
    (server / "observers").mkdir()
    (server / "observers" / "ada.key").write_bytes(path.read_bytes())
    assert [role for role, _ in keys.allowed(server).values()] == [Role.OBSERVER]


def test_the_list_is_read_again_when_files_change(server: Path, tmp_path: Path) -> None:
    entries = AllowList(server)
    assert entries.current() == {}
    ada = keys.authorize(server, keys.new(tmp_path / "a", "ada")[0], Role.OPERATOR)
    assert [name for _, name in entries.current().values()] == ["ada"]
    assert entries.current() is entries.current()  # unchanged: not read again
    bob = keys.read_public(keys.new(tmp_path / "b", "bob")[0])
    text = ada.read_text().replace(keys.read_public(ada).decode(), bob.decode())
    ada.write_text(text)
    os.utime(ada, ns=(1, 1))
    assert list(entries.current()) == [bob.decode()]
    keys.revoke(server, "ada")
    assert entries.current() == {}


def test_a_broken_entry_lets_nobody_in_and_keeps_nobody_out(
    server: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keys.authorize(server, keys.new(tmp_path / "a", "ada")[0], Role.OPERATOR)
    (server / "operators" / "broken.key").write_text("hello")
    assert [name for _, name in keys.allowed(server).values()] == ["ada"]
    assert "broken.key" in caplog.text


# ---------------------------------------------------------------- over the wire


@pytest.fixture
def pair(server: Path) -> KeyPair:
    return keys.load_server(server)


def test_an_allowed_key_is_answered(
    connect: Connect, server: Path, pair: KeyPair, tmp_path: Path
) -> None:
    folder = client_folder(tmp_path / "me", "ada", server)
    mine = ClientKeys.load(folder)
    with (
        FakeRig(server_keys=pair, allow=[mine.public]) as fake,
        connect(fake.endpoint, keys=folder) as rig,
    ):
        assert rig.status().rig == "fake"
        rig.subscribe("queue").close()  # events are behind the same door


@pytest.mark.parametrize("whose", ["stranger", "wrong server", "none"])
def test_other_keys_get_no_answer_and_a_hint(
    connect: Connect, server: Path, pair: KeyPair, tmp_path: Path, whose: str
) -> None:
    mine = ClientKeys.load(client_folder(tmp_path / "me", "ada", server))
    keys.new(tmp_path / "elsewhere", "server")
    used = {
        "stranger": client_folder(tmp_path / "he", "eve", server),
        "wrong server": client_folder(tmp_path / "me2", "ada", tmp_path / "elsewhere"),
        "none": None,
    }[whose]
    with FakeRig(server_keys=pair, allow=[mine.public]) as fake:
        with pytest.raises(UmbraError) as caught:
            connect(fake.endpoint, keys=used, timeout_s=0.5)
        assert fake.requests == []
    assert caught.value.code is Code.UNREACHABLE
    assert ("keys" in caught.value.message) is (used is not None)  # or it is a rig on loopback
