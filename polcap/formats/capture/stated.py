"""In: plain data that a user stated, and why it is not what it should be. Out: the key, its value, the remedy."""

import difflib
import re
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

T = TypeVar("T", bound=inspect.Type)

_STEP = re.compile(r"\.([^.\[`]+)|\[(\d+)\]")  # of a path such as $.frame[0].role
_UNKNOWN = re.compile(r"Object contains unknown field `(.*)`")


def fault(error: msgspec.ValidationError, given: Any, kind: type[msgspec.Struct]) -> str:
    """What msgspec has against `given` as a `kind`: the key and its value, then its limit or what was perhaps meant."""
    message, _, path = str(error).partition(" - at `$")
    value, form = given, inspect.type_info(kind)
    for name, place in _STEP.findall(path):
        value, form = value[int(place) if place else name], _inner(form, name)
    where = path.strip("`.")
    if unknown := _UNKNOWN.fullmatch(message):
        known = [field.encode_name for field in _of(form, inspect.StructType).fields]
        near = difflib.get_close_matches(unknown[1], known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
        return f"{f'{where}.' if where else ''}{unknown[1]}: there is no such key; {hint}"
    if message.startswith("Invalid enum value"):
        message = f"not one of {', '.join(map(str, _of(form, inspect.LiteralType).values))}"
    said = f"{message[:1].lower()}{message[1:]}"
    if not where or isinstance(value, (dict, list, tuple)):
        return f"{where}: {said}" if where else said
    return f"{where} = {value!r}: {said}"


def _inner(form: inspect.Type, name: str) -> inspect.Type:
    """What stands at a key of a table, or at a place of a list."""
    if name:
        return next(field.type for field in _of(form, inspect.StructType).fields if field.encode_name == name)
    for kind in (inspect.VarTupleType, inspect.ListType):
        if (found := _found(form, kind)) is not None:
            return found.item_type
    return inspect.AnyType()  # of a list of fixed length: numbers, which need no further look


def _of(form: inspect.Type, kind: type[T]) -> T:
    found = _found(form, kind)
    assert found is not None, f"{form} is no {kind.__name__}"
    return found


def _found(form: inspect.Type, kind: type[T]) -> T | None:
    """The arm of a union that is of this kind, or the form itself."""
    arms = form.types if isinstance(form, inspect.UnionType) else (form,)
    for arm in arms:
        while isinstance(arm, inspect.Metadata):
            arm = arm.type
        if isinstance(arm, kind):
            return arm
    return None
