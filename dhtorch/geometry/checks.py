"""Shape checks: tensors and axis patterns -> sizes of the named axes; and tests of masks and finiteness.

*Shapes raise, values flag*: a wrong shape is an error of the caller and raises here, with the argument's name.
"""

import inspect
from collections.abc import Callable, Sequence
from functools import lru_cache, wraps
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

#: Largest number of kept constants of accelerators.
MAX_CONSTANTS = 512

_Function = TypeVar("_Function", bound=Callable[..., Any])


def check(where: str, **args: tuple[Tensor | None, str]) -> dict[str, int]:
    """Tensors and axis patterns such as ``"B N 2"`` -> sizes of the axes; equal letters must have equal sizes.

    Args:
        where: name of the calling function, for the message.
        args: ``name=(tensor, pattern)``. A pattern is axis names and integers separated by blanks; a leading ``*``
            accepts any leading dimensions; a ``None`` tensor is skipped.

    Returns:
        The sizes bound to the axis names.

    Raises:
        ValueError: the number of axes, a fixed size or a shared axis differs from the pattern.
    """
    shapes = tuple([(name, pattern, None if x is None else x.shape) for name, (x, pattern) in args.items()])
    if torch.compiler.is_compiling():
        return _bind_axes.__wrapped__(where, shapes)
    try:
        return dict(_bind_axes(where, shapes))
    except TypeError:  # a symbolic size is not hashable
        return _bind_axes.__wrapped__(where, shapes)


def shaped(patterns: str, where: str | None = None) -> Callable[[_Function], _Function]:
    """Decorator: a function -> the same function, which raises ValueError unless its arguments have these shapes.

    Args:
        patterns: ``"samples.xyz: B N 3, source.levels.0: B C H W"``: arguments, or tensors in them, and their patterns
            as of :func:`check`; what is None is skipped.
        where: name of the function for the message, where it is not its own.
    """
    rows = [tuple(part.strip() for part in row.split(":")) for row in patterns.split(",")]

    def decorate(fn: _Function) -> _Function:
        names = list(inspect.signature(fn).parameters)
        paths = [(name, names.index(name.split(".")[0]), name.split("."), pattern) for name, pattern in rows]

        @wraps(fn)
        def checked(*args: Any, **kwargs: Any) -> Any:
            tensors = {}
            for name, position, (first, *parts), pattern in paths:
                x = args[position] if position < len(args) else kwargs.get(first)
                for part in parts:
                    x = None if x is None else x[int(part)] if part.isdigit() else getattr(x, part)
                tensors[name] = x, pattern
            check(where or fn.__qualname__, **tensors)
            return fn(*args, **kwargs)

        return cast(_Function, checked)

    return decorate


@lru_cache(maxsize=4096)
def _bind_axes(where: str, shapes: tuple[tuple[str, str, torch.Size | None], ...]) -> dict[str, int]:
    """Sizes of axes; cached, as an iterative fit repeats the same checks at every step."""
    sizes: dict[str, int] = {}
    for name, pattern, full in shapes:
        if full is None:
            continue
        axes, shape = pattern.split(), tuple(full)
        if axes[0] == "*":
            axes = axes[1:]
            shape = shape[len(shape) - len(axes) :] if len(shape) >= len(axes) else shape
        ok = len(axes) == len(shape)
        for axis, size in zip(axes, shape, strict=False):
            ok = ok and (int(axis) == size if axis.isdigit() else sizes.setdefault(axis, size) == size)
        if not ok:
            bound = ", ".join(f"{k}={v}" for k, v in sizes.items())
            raise ValueError(
                f"{where}: {name} has shape {tuple(full)}, expected ({pattern}) with {bound or 'any sizes'}"
            )
    return sizes


def is_static(x: Tensor) -> bool:
    """Whether values must not be read, and shapes not depend on them: under ``torch.compile`` and the transforms of
    ``torch.func``; and on an accelerator, for which the host would wait."""
    return torch.compiler.is_compiling() or torch._C._functorch.is_functorch_wrapped_tensor(x) or not x.is_cpu


def constant(like: Tensor, values: Sequence[Any]) -> Tensor:
    """Numbers, or rows of them -> tensor of the device and dtype of ``like``; not to be written to.

    On an accelerator the tensor is cached, because the host waits for every copy from its memory.
    """
    if like.is_cpu or is_transformed():
        return like.new_tensor(values)
    return _kept(tuple(v if isinstance(v, int | float) else tuple(v) for v in values), like.dtype, like.device)


@lru_cache(maxsize=MAX_CONSTANTS)
def keep_beside(x: Tensor, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Copy of a cached CPU tensor on an accelerator, itself cached by the tensor's identity; not to be written to."""
    with torch.inference_mode(False):
        return x.to(dtype).to(device)


def move_from_host(x: Tensor, like: Tensor) -> Tensor:
    """``x.to(like)`` of a CPU tensor, without waiting for the transfer."""
    x = x.to(like.dtype)
    if like.is_cpu:
        return x
    return (x.pin_memory() if like.is_cuda else x).to(like.device, non_blocking=True)


@lru_cache(maxsize=MAX_CONSTANTS)
def _kept(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # else it could enter no graph later
        return torch.tensor(values, dtype=dtype, device=device)


def all_known(mask: Tensor) -> bool:
    """Whether a mask is true everywhere; false where values must not be read."""
    return not is_static(mask) and bool(mask.all())


def any_possible(mask: Tensor) -> bool:
    """Whether a mask is true anywhere; true where values must not be read."""
    return is_static(mask) or bool(mask.any())


def all_finite(x: Tensor, dim: int) -> Tensor:
    """Whether all values along ``dim`` are finite; faster than ``x.isfinite().all(dim)``. Gradient: none."""
    return x.detach().abs().amax(dim) < torch.inf


def is_transformed() -> bool:
    """Whether this runs inside ``torch.compile`` or a transform of ``torch.func``, for any arguments."""
    return torch.compiler.is_compiling() or torch._C._functorch.maybe_current_level() is not None
