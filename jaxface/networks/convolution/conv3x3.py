"""The 3x3 convolution of VGG-like networks, as a JAX primitive with a fast CPU lowering.

``conv3x3`` is one linear operation to JAX: it differentiates in both modes to any order, and maps.
How it is computed is decided when a program is lowered: on CPUs wide layers by Winograd's minimal
filtering (``winograd``), the first by ``shifted_sum``; all others by ``lax.conv_general_dilated``.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core
import jax.numpy as jnp
from jax import core, lax
from jax.interpreters import ad, batching, mlir

from jaxface._machine import processor_features
from jaxface._types import Array, Float
from jaxface.networks.convolution.shifted_sum import (
    shifted_sum_conv3x3,
    shifted_sum_conv3x3_transpose,
)
from jaxface.networks.convolution.winograd import transformed_kernel, winograd_conv3x3

Prepared = tuple[Float[Array, "p i o"], ...]
"""`winograd.transformed_kernel` of a kernel, then of it turned by 180 degrees; or empty"""

METHODS = ("auto", "winograd", "direct")
"""``auto``: on CPUs wide layers by Winograd, the first by shifted sums; direct elsewhere"""

_NARROW, _WIDE, _WIDE_AVX512 = 2, 64, 128
"""on CPUs ``auto`` means shifted sums up to the first, Winograd from the second number of channels
or, where products are twice as fast, the third; the fewer channels, the more of Winograd's time are
its transforms"""

_LARGE = 1024
"""pixels of an image from which on Winograd pays for the transform of the kernel"""


def conv3x3(
    x: Float[Array, "h w i"], kernel: Float[Array, "3 3 i o"], method: str = "auto"
) -> Float[Array, "h w o"]:
    """Correlation with a 3x3 kernel (HWIO), zeros outside the image.

    Raises:
        ValueError: the shapes do not fit, or ``method`` is none of ``METHODS``.
    """
    _check(x, kernel, method)
    how = {"gated": "no", "transpose": False, "method": method}
    return _linear_p.bind(x, kernel, jnp.zeros((), bool), **how)


def conv3x3_relu(
    x: Float[Array, "h w i"],
    kernel: Float[Array, "3 3 i o"],
    bias: Float[Array, "o"],
    method: str = "auto",
    prepared: Prepared = (),
) -> Float[Array, "h w o"]:
    """``max(conv3x3(x, kernel) + bias, 0)``; the derivative at 0 is 0.

    Bias, ReLU and, in the backward pass, the ReLU's gate cost no pass over memory of their own.

    Args:
        x: the image.
        kernel: HWIO.
        bias: of each output.
        method: one of ``METHODS``.
        prepared: of this kernel, by ``prepared_kernel``; it counts as a constant, and derivatives
            with respect to the kernel go on to be those with respect to ``kernel``.

    Raises:
        ValueError: the shapes do not fit, or ``method`` is none of ``METHODS``.
    """
    _check(x, kernel, method)
    return _LAYERS[method](x, kernel, bias, *prepared)


def prepared_kernel(kernel: Float[Array, "3 3 i o"], pixels: int) -> Prepared:
    """What Winograd's convolution and its adjoint make of a kernel, each four times its size.

    Empty where images of so many pixels are convolved with it in another way on this machine.
    """
    if _algorithm(pixels, kernel, "auto", jax.default_backend()) != "winograd":
        return ()
    return *transformed_kernel(kernel), *transformed_kernel(kernel[::-1, ::-1])


def _check(x: Array, kernel: Array, method: str) -> None:
    if x.ndim != 3 or kernel.shape[:3] != (3, 3, x.shape[-1]):
        raise ValueError(
            f"image {x.shape} and kernel {kernel.shape} do not fit: needed are (h, w, i) and "
            "(3, 3, i, o)"
        )
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; needed is one of {METHODS}")


def direct_conv3x3(
    x: Float[Array, "h w _"], kernel: Float[Array, "3 3 i o"], transpose: bool = False
) -> Float[Array, "h w _"]:
    """The same by ``lax.conv_general_dilated``, or its adjoint (from o channels to i)."""
    if transpose:
        kernel = jnp.swapaxes(kernel[::-1, ::-1], 2, 3)
    layout = ("NHWC", "HWIO", "NHWC")
    return lax.conv_general_dilated(x[None], kernel, (1, 1), "SAME", dimension_numbers=layout)[0]


def _algorithm(pixels: int, kernel: Array, method: str, platform: str) -> str:
    if method != "auto":
        return method
    if platform == "cpu" and kernel.shape[2] <= _NARROW:
        return "shifted sum"
    if platform != "cpu" or pixels < _LARGE:
        return "direct"
    wide = _WIDE_AVX512 if "avx512f" in processor_features() else _WIDE
    return "winograd" if min(kernel.shape[2:]) >= wide else "direct"


def _register(primitive: jax.extend.core.Primitive, compute: Callable[..., Array]) -> None:
    """Shape, compilation and mapping of a primitive that ``compute`` carries out."""

    def shape(x: Any, kernel: Any, *_: Any, transpose: bool = False, **how: Any) -> Any:
        channels = kernel.shape[2 if transpose else 3]
        return core.ShapedArray((*x.shape[:-1], channels), x.dtype)

    def batched(args: Any, dims: Any, **how: Any) -> Any:
        size = next(a.shape[d] for a, d in zip(args, dims, strict=True) if d is not None)

        def one(i: Array) -> Array:
            picked = [
                a if d is None else lax.dynamic_index_in_dim(a, i, d, keepdims=False)
                for a, d in zip(args, dims, strict=True)
            ]
            return primitive.bind(*picked, **how)

        return lax.map(one, jnp.arange(size)), 0

    def lowering(platform: str) -> Any:
        return mlir.lower_fun(functools.partial(compute, platform=platform), False)

    primitive.def_abstract_eval(shape)
    primitive.def_impl(
        lambda *arrays, **how: jax.jit(functools.partial(primitive.bind, **how))(*arrays)
    )
    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, lowering("any"))
    mlir.register_lowering(primitive, lowering("cpu"), "cpu")


# A convolution linear in image and kernel, with a gate: the image ("input") or the result
# ("output") counts only where the third operand is true. Transposing swaps the two. The last two
# operands are the prepared kernel, or empty.

_linear_p = jax.extend.core.Primitive("conv3x3")
_OPPOSITE = {"no": "no", "input": "output", "output": "input"}


def _linear(
    x: Array,
    kernel: Array,
    gate: Array,
    *prepared: Array,
    gated: str,
    transpose: bool,
    method: str,
    platform: str,
) -> Array:
    algorithm = _algorithm(x.shape[0] * x.shape[1], kernel, method, platform)
    if gated == "input" and algorithm != "winograd":
        x = jnp.where(gate, x, 0)
    if algorithm == "winograd":
        input_gate = gate if gated == "input" else None
        forward, backward = _both(prepared)
        points = backward if transpose else forward
        y = winograd_conv3x3(x, kernel, gate=input_gate, transpose=transpose, transformed=points)
    elif algorithm == "shifted sum":
        y = (shifted_sum_conv3x3_transpose if transpose else shifted_sum_conv3x3)(x, kernel)
    else:
        y = direct_conv3x3(x, kernel, transpose)
    return jnp.where(gate, y, 0) if gated == "output" else y


def _both(prepared: Prepared) -> tuple[Prepared, Prepared]:
    """The convolution's part and its adjoint's."""
    half = len(prepared) // 2
    return prepared[:half], prepared[half:]


def _linear_jvp(primals: Any, tangents: Any, **how: Any) -> Any:
    x, kernel, gate, *prepared = primals
    dx, dkernel, *_ = tangents
    parts = []
    if not isinstance(dx, ad.Zero):
        parts.append(_linear_p.bind(dx, kernel, gate, *prepared, **how))
    if not isinstance(dkernel, ad.Zero):
        parts.append(_linear_p.bind(x, dkernel, gate, **how))
    y = _linear_p.bind(x, kernel, gate, *prepared, **how)
    return y, functools.reduce(jnp.add, parts) if parts else jnp.zeros_like(y)


def _linear_transpose(ct: Any, x: Any, kernel: Any, gate: Any, *prepared: Any, **how: Any) -> Any:
    if isinstance(ct, ad.Zero):
        return [None] * (3 + len(prepared))
    if ad.is_undefined_primal(x):
        back = how | {"gated": _OPPOSITE[how["gated"]], "transpose": not how["transpose"]}
        return [_linear_p.bind(ct, kernel, gate, *prepared, **back), *[None] * (2 + len(prepared))]

    gated, transpose = how["gated"], how["transpose"]

    def of_kernel(k: Array) -> Array:
        how = {"gated": gated, "transpose": transpose, "method": "direct", "platform": "any"}
        return _linear(x, k, gate, *prepared, **how)

    shape = jax.ShapeDtypeStruct(kernel.aval.shape, kernel.aval.dtype)
    of_the_kernel = jax.linear_transpose(of_kernel, shape)(ct)[0]
    return [None, of_the_kernel, *[None] * (1 + len(prepared))]


_register(_linear_p, _linear)
ad.primitive_jvps[_linear_p] = _linear_jvp
ad.primitive_transposes[_linear_p] = _linear_transpose


# The whole layer. The primitive has no derivative; the custom rule around it gives it one.

_layer_p = jax.extend.core.Primitive("conv3x3_relu")


def _layer(
    x: Array,
    kernel: Array,
    bias: Array,
    *prepared: Array,
    method: str,
    platform: str,
) -> Array:
    algorithm = _algorithm(x.shape[0] * x.shape[1], kernel, method, platform)
    if algorithm == "winograd":
        return winograd_conv3x3(x, kernel, bias, transformed=_both(prepared)[0])
    if algorithm == "shifted sum":
        return shifted_sum_conv3x3(x, kernel, bias)
    return jnp.maximum(direct_conv3x3(x, kernel) + bias, 0)


_register(_layer_p, _layer)


def _layer_by(method: str) -> Callable[..., Array]:
    @jax.custom_jvp
    def layer(x: Array, kernel: Array, bias: Array, *prepared: Array) -> Array:
        return _layer_p.bind(x, kernel, bias, *prepared, method=method)

    def rule(primals: Any, tangents: Any) -> tuple[Array, Array]:
        x, kernel, bias, *prepared = primals
        dx, dkernel, dbias, *_ = tangents
        y = layer(x, kernel, bias, *prepared)
        active = y > 0  # all that a backward pass needs to keep of y: a byte for each value
        how = {"gated": "output", "transpose": False, "method": method}
        zero = jax.custom_derivatives.SymbolicZero
        parts = []
        if not isinstance(dx, zero):
            parts.append(_linear_p.bind(dx, kernel, active, *prepared, **how))
        if not isinstance(dkernel, zero):
            parts.append(_linear_p.bind(x, dkernel, active, **how))
        if not isinstance(dbias, zero):
            parts.append(jnp.where(active, dbias, 0))
        return y, functools.reduce(jnp.add, parts) if parts else jnp.zeros_like(y)

    layer.defjvp(rule, symbolic_zeros=True)
    return layer


_LAYERS = {method: _layer_by(method) for method in METHODS}
