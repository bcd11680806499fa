"""A fake rig, and both clients in one shape."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable, Iterator
from typing import Any, cast

import pytest

from protocol.aio import AsyncClient
from protocol.client import Client
from tests.protocol.fake import FakeRig


@pytest.fixture
def fake() -> Iterator[FakeRig]:
    with FakeRig() as rig:
        yield rig


class OnLoop:
    """An AsyncClient whose coroutines are run to their end: the blocking client's shape."""

    def __init__(self, endpoint: str | None = None, **options: Any) -> None:
        self._runner = asyncio.Runner()
        try:
            self._rig = self._runner.run(self._open(endpoint, options))
        except BaseException:
            self._runner.close()
            raise

    async def _open(self, endpoint: str | None, options: dict[str, Any]) -> AsyncClient:
        return await AsyncClient(endpoint, **options).open()

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._rig, name)
        return self._blocking(value) if callable(value) else value

    @property
    def token(self) -> str:
        return self._rig.token

    @token.setter
    def token(self, token: str) -> None:
        self._rig.token = token

    def _blocking(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            result = method(*args, **kwargs)
            return self._runner.run(result) if inspect.iscoroutine(result) else result

        return call

    def __repr__(self) -> str:
        return repr(self._rig)

    def __enter__(self) -> OnLoop:
        return self

    def __exit__(self, *error: object) -> None:
        self._runner.run(self._rig.close())
        self._runner.close()


@pytest.fixture(params=[Client, OnLoop], ids=["blocking", "asyncio"])
def connect(request: pytest.FixtureRequest) -> Callable[..., Client]:
    """What makes a client: each test runs with both."""
    return cast("Callable[..., Client]", request.param)


@pytest.fixture
def rig(fake: FakeRig, connect: Callable[..., Client]) -> Iterator[Client]:
    with connect(fake.endpoint, name="me", timeout_s=5.0) as client:
        yield client


@pytest.fixture
def hasty(fake: FakeRig, connect: Callable[..., Client]) -> Iterator[Client]:
    """A client that asks again after 0.5 s: by then an answer that was given is here."""
    with connect(fake.endpoint, name="me", timeout_s=1.5) as client:
        yield client
