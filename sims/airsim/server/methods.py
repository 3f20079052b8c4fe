"""From a call's name and arguments to a handler: the table of methods.

A group of methods is a class whose functions are marked with `rpc`. The name, the annotated
parameters and the docstring of each give arity, conversion, errors and documentation.
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Awaitable, Callable, Iterable
from typing import Annotated, Any, Literal, NamedTuple, Protocol, TypeVar

import msgspec

from runtime.errors import CommandError
from sims.airsim.server.absent import reason_of_absence

Flavour = Literal["airsim", "cosys"]

Finite = Annotated[float, msgspec.Meta(ge=-3.5e38, le=3.5e38)]
"""A number within those of AirSim's clients (float32) that is neither NaN nor infinite, for the
parameters of handlers and for fields of structures: others are refused with the field's place."""

F = TypeVar("F", bound=Callable[..., Any])


LONGEST_NAME = 100
"""Characters of an unknown method's name that are repeated in the answer."""


class RpcError(Exception):
    """A call that cannot be served; the text is sent to the client."""


EXPECTED_ERRORS = (RpcError, ValueError, msgspec.ValidationError, CommandError)
"""Errors of handlers that are the client's to mend; any other is a bug of the server."""


class Caller(Protocol):
    """The client that calls.

    Attributes:
        address: Of the client, for messages.
        flavour: Whose structures it expects; a handler may set it.
    """

    address: str
    flavour: Flavour


def rpc(name: str, *, cosys: int | None = None) -> Callable[[F], F]:
    """Mark a function of a group as the handler of a method.

    Its parameters are converted as annotated (whole numbers to floats; maps to structures). One
    that is annotated with `Caller` gets the client and is no argument. Defaults stand for
    arguments that one of the flavours does not have.

    What a handler does before its first wait is done when it is called, in the order in which
    the requests came: one that waits is a plain function that returns an awaitable.

    Args:
        name: Of the method, on the wire.
        cosys: Number of arguments of Cosys-AirSim's clients, if it is another than AirSim's; a
            call then tells whose client it is.
    """

    def mark(function: F) -> F:
        function.__dict__["rpc"] = name, cosys
        return function

    return mark


class Method(NamedTuple):
    """One method.

    Attributes:
        name: On the wire.
        call: The handler.
        parameters: Types of its arguments by their names.
        shapes: Type of the tuple of its arguments, by their number.
        wants_caller: Whether the client is its first argument.
        expected: Number of arguments by flavour, for messages.
        flavours: The flavour of clients that send so many arguments, if it shows.
        description: First line of the handler's docstring.
    """

    name: str
    call: Callable[..., Any]
    parameters: dict[str, Any]
    shapes: dict[int, Any]
    wants_caller: bool
    expected: dict[Flavour, int]
    flavours: dict[int, tuple[Flavour]]
    description: str


class Table:
    """All methods by name.

    Args:
        groups: Objects with functions that are marked with `rpc`.
    """

    def __init__(self, groups: Iterable[object]) -> None:
        self.methods: dict[str, Method] = {}
        for group in groups:
            found = methods_of(group)
            assert not found.keys() & self.methods.keys(), found.keys() & self.methods.keys()
            self.methods |= found

    def call(self, caller: Caller, name: str, arguments: list[Any]) -> Awaitable[Any] | Any:
        """Call a method, and return its result or an awaitable of it.

        Raises:
            RpcError: There is no such method, or the arguments are not those it takes, or it
                cannot be served; the text is that of rpclib.
        """
        method = self.methods.get(name)
        count = len(arguments)
        if method is None:
            name = name[:LONGEST_NAME]
            if reason := reason_of_absence(name):
                raise RpcError(thrown(name, count, f"not supported by visnav-runtime: {reason}"))
            raise RpcError(
                f"rpclib: server could not find function '{name}' with argument count {count}."
            )
        shape = method.shapes.get(count)
        if shape is None:
            expected = method.expected[caller.flavour]
            raise RpcError(
                f"rpclib: Function '{name}' was called with an invalid number of arguments. "
                f"Expected: {expected}, got: {count}"
            )
        for flavour in method.flavours.get(count, ()):
            caller.flavour = flavour
        try:
            converted = msgspec.convert(arguments, shape)
            first = (caller,) if method.wants_caller else ()
            return method.call(*first, *converted)
        except RecursionError:
            raise RpcError(thrown(name, count, "the arguments are nested too deeply")) from None
        except EXPECTED_ERRORS as error:
            raise RpcError(thrown(name, count, str(error))) from None


def thrown(name: str, count: int, text: str) -> str:
    """Return rpclib's text of an exception in a handler."""
    return (
        f"rpclib: function '{name}' (called with {count} arg(s)) threw an exception. "
        f"The exception contained this information: {text}."
    )


def methods_of(group: object) -> dict[str, Method]:
    """Return the methods of a group by name; those of its class, too, for the documentation."""
    marked = (function for _, function in inspect.getmembers(group, callable))
    methods = (_method(each, *each.rpc) for each in marked if hasattr(each, "rpc"))
    return {method.name: method for method in methods}


def _method(function: Callable[..., Any], name: str, cosys: int | None) -> Method:
    hints = typing.get_type_hints(function, include_extras=True)
    signature = [
        each for each in inspect.signature(function).parameters.values() if each.name != "self"
    ]
    wants_caller = bool(signature) and hints[signature[0].name] is Caller
    parameters = signature[wants_caller:]
    types = [hints[each.name] for each in parameters]
    least = sum(each.default is inspect.Parameter.empty for each in parameters)
    shapes = {
        count: tuple.__class_getitem__(tuple(types[:count]) or ((),))
        for count in range(least, len(types) + 1)
    }
    expected: dict[Flavour, int] = {"airsim": len(types), "cosys": cosys or len(types)}
    first = (inspect.getdoc(function) or "").partition("\n")[0]
    named = {each.name: hints[each.name] for each in parameters}
    flavours: dict[int, tuple[Flavour]] = {}
    if cosys is not None:
        flavours = {len(types): ("airsim",), cosys: ("cosys",)}
    return Method(name, function, named, shapes, wants_caller, expected, flavours, first)
