"""Dispatch of operators: a torch function, the reference, and an optional compiled kernel of the same result.

    @operator(
        kernel=lambda x, *, factor: run_kernel("scale", [x], torch.empty_like(x), factor),
        dtypes={"x": torch.float32},
    )
    def scale(x, *, factor):
        return x * factor

``scale(x, factor=2.0)`` runs the kernel if a library is installed or compiled (:mod:`dhtorch.ops.loader`;
DHTORCH_OPS=0 leaves it unused) and all tensors are eligible, else the reference. The tensors of an operator are its
positional parameters, its options keywords. A kernel allocates the outputs and calls the C++ operator that
``TORCH_LIBRARY`` registers in ``csrc``; it has no condition of its own.

Eligible are plain contiguous CPU tensors of the stated dtypes that are not being differentiated or transformed: no
gradient (backward or forward), no ``torch.compile``, no ``torch.func``.
"""

import inspect
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad

from dhtorch.ops import loader

P = ParamSpec("P")
T = TypeVar("T")

#: A tensor parameter's dtypes, and whether it may have any strides.
_Parameter = tuple[tuple[torch.dtype, ...], bool]

#: That of a tensor within an option.
_NESTED: _Parameter = ((torch.float32,), False)


def operator(
    *,
    kernel: Callable[..., Any],
    dtypes: Mapping[str, torch.dtype | tuple[torch.dtype, ...]],
    any_layout: Collection[str] = (),
    nested: Callable[..., Sequence[Tensor]] | None = None,
    when: Callable[..., bool] | None = None,
) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorator: a torch function -> the same function, dispatched to ``kernel`` for eligible arguments.

    Args:
        kernel: called with the function's own arguments; returns what the function returns.
        dtypes: dtypes that the kernel reads, for each positional parameter of the function, or each of its
            ``*tensors``. Such a parameter is a tensor or None.
        any_layout: parameters that need not be contiguous.
        nested: called with the function's own arguments -> float32 tensors within its options that the kernel reads.
        when: further condition on shapes and options, called with the function's own arguments.

    Raises:
        TypeError: ``dtypes`` does not name the positional parameters.
    """

    def decorate(reference: Callable[P, T]) -> Callable[P, T]:
        signature = inspect.signature(reference)
        names = [name for name, p in signature.parameters.items() if p.kind is p.POSITIONAL_OR_KEYWORD]
        names = names or list(dtypes)  # *tensors
        if names != list(dtypes) or not set(any_layout) <= set(names):
            raise TypeError(f"{reference.__name__}: found dtypes of {', '.join(dtypes)}, expected {', '.join(names)}")
        parameters = tuple(
            ((allowed,) if isinstance(allowed, torch.dtype) else allowed, name in any_layout)
            for name, allowed in dtypes.items()
        )

        @wraps(reference)
        def dispatched(*args: P.args, **kwargs: P.kwargs) -> T:
            if not is_in_use():
                return reference(*args, **kwargs)
            if len(args) < len(names):  # tensors passed by keyword
                bound = signature.bind(*args, **kwargs)
                bound.apply_defaults()
                args, kwargs = bound.args, bound.kwargs  # type: ignore[assignment]
            inner = () if nested is None else nested(*args, **kwargs)
            is_eligible = _can_dispatch(args, parameters) and _can_dispatch(tuple(inner), (_NESTED,) * len(inner))
            if is_eligible and (when is None or when(*args, **kwargs)):
                return kernel(*args, **kwargs)
            return reference(*args, **kwargs)

        return dispatched

    return decorate


def run_kernel(name: str, inputs: Iterable[Tensor], outputs: Any, *numbers: Any) -> Any:
    """Run ``torch.ops.dhtorch.<name>`` on the inputs, made contiguous, outputs (a tensor or several) and numbers -> the
    outputs."""
    filled = (outputs,) if isinstance(outputs, Tensor) else outputs
    getattr(torch.ops.dhtorch, name).default(*(x.contiguous() for x in inputs), *filled, *numbers)
    return outputs


def is_in_use() -> bool:
    """Whether kernels may run: the library can be loaded, and no compiler traces this code.

    ``torch.autograd.forward_ad`` keeps tangents within plain tensors, so none are eligible while it is active.

    Raises:
        OSError: DHTORCH_OPS=1, and no library can be loaded.
    """
    if torch.compiler.is_compiling() or forward_ad._current_level >= 0:
        return False
    return loader.load_if_present()


def _can_dispatch(tensors: tuple[Any, ...], parameters: tuple[_Parameter, ...]) -> bool:
    """Whether tensors are eligible for a kernel with such parameters; see the module's last paragraph."""
    grad_enabled = torch.is_grad_enabled()
    for x, (dtypes, any_layout) in zip(tensors, parameters, strict=False):
        if x is None:
            continue
        if type(x) is not Tensor or x.dtype not in dtypes or not x.is_cpu or not (any_layout or x.is_contiguous()):
            return False
        if (grad_enabled and x.requires_grad) or x.is_neg() or torch._C._functorch.is_functorch_wrapped_tensor(x):
            return False
    return True
