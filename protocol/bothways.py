"""A method of both clients, written once: a blocking call of one, a coroutine of the other."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Coroutine
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, cast, overload

from protocol.connection import Ask

P = ParamSpec("P")
T = TypeVar("T")


class Blocking:
    """A client whose `perform` comes back with what an Ask is for."""


class Awaited:
    """A client whose `perform` is a coroutine."""


class command(Generic[P, T]):  # noqa: N801  (a decorator, as property is)
    """Makes a function that returns an Ask into a method of both clients."""

    def __init__(self, make: Callable[Concatenate[Any, P], Ask[T]]) -> None:
        functools.update_wrapper(cast("Any", self), make)
        self._make = make

    @overload
    def __get__(self, rig: None, owner: type) -> Callable[Concatenate[Any, P], Ask[T]]: ...
    @overload
    def __get__(self, rig: Blocking, owner: type) -> Callable[P, T]: ...
    @overload
    def __get__(self, rig: Awaited, owner: type) -> Callable[P, Coroutine[Any, Any, T]]: ...
    def __get__(self, rig: Any, owner: type) -> Any:
        if rig is None:
            return self._make

        @functools.wraps(self._make)
        def call(*args: P.args, **kwargs: P.kwargs) -> Any:
            return rig.perform(self._make(rig, *args, **kwargs))

        call.__signature__ = _bound(self._make)  # type: ignore[attr-defined]
        return call


@functools.cache
def _bound(make: Callable[..., Any]) -> inspect.Signature:
    """The signature that a person sees: without self, and with what comes back."""
    whole = inspect.signature(make)
    back = str(whole.return_annotation).removeprefix("Ask[").removesuffix("]")
    return whole.replace(parameters=list(whole.parameters.values())[1:], return_annotation=back)
