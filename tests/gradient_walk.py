"""Finds every public function of the numerical layers, and makes arguments for it.

What a function takes and gives is read from its annotations: ``Float[Array, "n 3"]`` becomes random
numbers with the sizes of ``SIZES``, a record the one of ``RECORDS`` or one made field by field, an
index table the one of ``TABLES``. A function that needs something else has an entry in
``gradient_cases``.
"""

import dataclasses
import importlib
import inspect
import pkgutil
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import AbstractArray, PyTree
from jaxtyping._array_types import _MetaAbstractArray

import jaxface

LAYERS = ("_numerics", "geometry", "imaging", "networks", "models", "render", "energies", "stages")

SIZES = {
    **{"n": 25, "m": 25, "v": 25, "f": 32},  # a grid of 5 x 5 vertices, as the records have it
    **{"h": 6, "w": 7, "r": 8, "s": 8, "l": 12, "p": 40, "k": 3, "c": 3},
}
"""of named axes; 4 where none is named"""


VARIADIC = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


class NoCaseError(LookupError):
    """No argument can be made from an annotation."""


def modules() -> Iterator[types.ModuleType]:
    """Every module of the layers."""
    for layer in LAYERS:
        module = importlib.import_module(f"jaxface.{layer}")
        yield module
        for found in pkgutil.walk_packages(getattr(module, "__path__", []), module.__name__ + "."):
            yield importlib.import_module(found.name)


def functions() -> dict[str, tuple[Callable[..., Any], type | None]]:
    """Public functions, and methods with their public classes, by dotted name in the package."""
    found: dict[str, tuple[Callable[..., Any], type | None]] = {}
    for module in modules():
        prefix = module.__name__.removeprefix(jaxface.__name__ + ".")
        for name, value in vars(module).items():
            if name.startswith("_") or getattr(value, "__module__", None) != module.__name__:
                continue
            if inspect.isclass(value):
                if issubclass(value, Exception):
                    continue
                for member, stored in vars(value).items():
                    method = getattr(stored, "__func__", stored)
                    own = not member.startswith("_") or member == "__call__"
                    # A NamedTuple's own methods are its author's, not those of the tuple.
                    if own and inspect.isroutine(method) and written_in(method, module):
                        owner = None if isinstance(stored, staticmethod) else value
                        found[f"{prefix}.{name}.{member}"] = method, owner
            elif callable(value) and inspect.isroutine(inspect.unwrap(value)):
                found[f"{prefix}.{name}"] = value, None
    return found


def written_in(method: Any, module: types.ModuleType) -> bool:
    """Whether a method's code stands in a module."""
    code = getattr(inspect.unwrap(method), "__code__", None)
    return code is not None and code.co_filename == module.__file__


def hints(function: Callable[..., Any]) -> dict[str, Any]:
    """Annotations of a function or class, resolved."""
    return typing.get_type_hints(inspect.unwrap(function))


def parts(annotation: Any) -> Iterator[Any]:
    """The annotations within one: of a union, a tuple, a mapping, a record's fields."""
    arguments = typing.get_args(annotation)
    if arguments:
        for argument in arguments:
            yield from parts(argument)
    elif is_record(annotation):
        for field in hints(annotation).values():
            yield from parts(field)
    else:
        yield annotation


def is_array(annotation: Any) -> bool:
    """Whether it is a jaxtyping array."""
    return inspect.isclass(annotation) and (
        issubclass(type(annotation), _MetaAbstractArray) or AbstractArray in annotation.__mro__
    )


def holds_arrays(annotation: Any) -> bool:
    """Whether it is an array of jaxtyping or NumPy."""
    return is_array(annotation) or annotation is np.ndarray


def is_record(annotation: Any) -> bool:
    """Whether it is a dataclass or named tuple of ours."""
    ours = getattr(annotation, "__module__", "").startswith(jaxface.__name__)
    fields = dataclasses.is_dataclass(annotation) or hasattr(annotation, "_fields")
    return inspect.isclass(annotation) and ours and fields


def may_be(annotation: Any, kind: str) -> bool:
    """Whether an annotation stands for JAX arrays of numbers ("float"), indices or masks."""
    if annotation in (jax.Array, Any, PyTree):
        return True
    if isinstance(annotation, TypeVar):
        return any(may_be(one, kind) for one in annotation.__constraints__)
    if not is_array(annotation) or annotation.array_type is np.ndarray:
        return False
    dtypes = annotation.dtypes
    return not isinstance(dtypes, list | tuple) or any(kind in str(dtype) for dtype in dtypes)


def is_host(function: Callable[..., Any]) -> bool:
    """Whether a function is NumPy's: some annotation of its signature allows its arrays alone."""
    for annotation in hints(function).values():
        kinds = [getattr(p, "array_type", p) for p in parts(annotation) if holds_arrays(p)]
        if kinds and all(kind is np.ndarray for kind in kinds):
            return True
    return False


def is_smooth(function: Callable[..., Any], owner: type | None) -> bool:
    """Whether a function goes from floating-point JAX arrays to floating-point JAX arrays."""
    known = hints(function)
    back = known.pop("return", None)
    given = [*known.values(), *([owner] if owner else [])]
    takes = any(may_be(p, "float") for one in given for p in parts(one))
    return takes and any(may_be(p, "float") for p in parts(back))


class Maker:
    """Makes arguments, the same sizes for the same names within one call."""

    def __init__(self, seed: int, records: Mapping[Any, Callable[[], Any]], tables: dict[str, Any]):
        self.rng = np.random.default_rng(seed)
        self.records, self.tables = records, tables

    def arguments(self, function: Callable[..., Any], owner: type | None) -> dict[str, Any]:
        """Keyword arguments for all parameters without a default."""
        known = {**hints(function), "self": owner}
        signature = inspect.signature(inspect.unwrap(function))
        needed = {
            name: known[name]
            for name, parameter in signature.parameters.items()
            if parameter.default is inspect.Parameter.empty and parameter.kind not in VARIADIC
        }
        return {name: self.make(annotation, name) for name, annotation in needed.items()}

    def numbers(self, *shape: int) -> Any:
        """Random numbers between 0.2 and 0.8, away from most kinks."""
        return jnp.asarray(self.rng.uniform(0.2, 0.8, shape))

    def make(self, annotation: Any, name: str) -> Any:
        """One argument."""
        if annotation in self.records:
            return self.records[annotation]()
        origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
        if origin in (types.UnionType, typing.Union):
            return self.make(max(inner, key=is_array), name)
        if is_array(annotation):
            return self.array(annotation, name)
        if origin is tuple and inner[-1] is not Ellipsis:
            return tuple(self.make(part, name) for part in inner)
        if origin is tuple:
            return (self.make(inner[0], name),)
        if origin in (dict, Mapping) and inner[0] is str:
            return {"conv1_1": self.make(inner[1], name)}
        if is_record(annotation):
            return annotation(**{k: self.make(v, k) for k, v in hints(annotation).items()})
        if annotation is float:
            return 0.5
        if name in self.tables:
            return self.tables[name]
        raise NoCaseError(f"no {name} of type {annotation} can be made")

    def array(self, annotation: Any, name: str) -> Any:
        """Random numbers between 0.2 and 0.8, a table of indices, or a mask."""
        shape = self.shape(annotation.dim_str)
        if may_be(annotation, "float"):
            return self.numbers(*shape)
        if name in self.tables:
            return self.tables[name]
        if may_be(annotation, "bool"):
            return jnp.asarray(self.rng.random(shape) < 0.7)
        if name == "triangle":
            return jnp.asarray(self.rng.integers(-1, SIZES["f"], shape), jnp.int32)
        raise NoCaseError(f"no {name} of type {annotation.__name__} can be made")

    def shape(self, dimensions: str) -> tuple[int, ...]:
        """Sizes of axes."""
        sizes: list[int] = []
        for word in dimensions.split():
            bare = word.lstrip("#*?_") or "_"
            if word == "...":
                sizes.append(4)
            elif word.isdigit():
                sizes.append(int(word))
            elif "*" in word:
                sizes += [2, 3]
            else:
                sizes.append(SIZES.get(bare, 4))
        return tuple(sizes)
