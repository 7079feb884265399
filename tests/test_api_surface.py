"""The public surface: what users may rely on, held with signatures in ``api_surface.json``.

``DHTORCH_STORE=1 pytest tests/test_api_surface.py`` stores it anew, after a change that is meant.
"""

import dataclasses
import importlib
import inspect
from pathlib import Path

import pytest
from support.stored_values import stored_values

FILE = Path(__file__).with_name("api_surface.json")

#: Packages whose ``__all__`` is the public surface.
PACKAGES = (
    "dhtorch",
    "dhtorch.stages",
    "dhtorch.geometry",
    "dhtorch.transforms",
    "dhtorch.data",
    "dhtorch.alignment",
    "dhtorch.validation",
    "dhtorch.metrics",
    "dhtorch.functional",
    "dhtorch.export",
)


def signature(value):
    """What a caller of a public name depends on: parameters and defaults, fields of a record, methods of a class."""
    if inspect.ismodule(value):
        return {name: signature(getattr(value, name)) for name in public_names(value)}
    if inspect.isclass(value):
        members = {
            n: m for n, m in vars(value).items() if not n.startswith("_") and (callable(m) or isinstance(m, property))
        }
        shown = {
            n: "property" if isinstance(m, property) else parameters(getattr(value, n)) for n, m in members.items()
        }
        fields = [f.name for f in dataclasses.fields(value)] if dataclasses.is_dataclass(value) else []
        return {"fields": fields, "members": shown} if fields else {"call": parameters(value), "members": shown}
    return parameters(value) if callable(value) else type(value).__name__


def parameters(function):
    try:
        found = inspect.signature(function)
    except (TypeError, ValueError):
        return "callable"
    plain = (str, int, float, bool, tuple, type(None))
    parts = []
    for p in found.parameters.values():
        default = "" if p.default is p.empty else f"={p.default!r}" if isinstance(p.default, plain) else "=…"
        parts.append({p.VAR_POSITIONAL: "*", p.VAR_KEYWORD: "**"}.get(p.kind, "") + p.name + default)
    kinds = [p.kind for p in found.parameters.values()]
    if inspect.Parameter.KEYWORD_ONLY in kinds and inspect.Parameter.VAR_POSITIONAL not in kinds:
        parts.insert(kinds.index(inspect.Parameter.KEYWORD_ONLY), "*")
    return f"({', '.join(parts)})"


def public_names(module):
    """``__all__``; of a module without one its own functions and classes without an underscore."""
    if hasattr(module, "__all__"):
        return sorted(module.__all__)
    own = ((n, v) for n, v in vars(module).items() if callable(v) and getattr(v, "__module__", None) == module.__name__)
    return sorted(name for name, _ in own if not name.startswith("_"))


def surface():
    """Package → public name → signature."""
    packages = {name: importlib.import_module(name) for name in PACKAGES}
    return {name: {n: signature(getattr(module, n)) for n in public_names(module)} for name, module in packages.items()}


@pytest.mark.parametrize("package", PACKAGES)
def test_the_public_surface_is_the_one_that_is_written_down(package):
    found = surface()[package]
    wanted = stored_values(FILE, {package: found}, PACKAGES)[package]
    changes = [f"{name} is gone" for name in wanted.keys() - found.keys()]
    changes += [f"{name} is new" for name in found.keys() - wanted.keys()]
    changes += [
        f"{name} was {wanted[name]}, is {found[name]}"
        for name in wanted.keys() & found.keys()
        if wanted[name] != found[name]
    ]
    command = "DHTORCH_STORE=1 pytest tests/test_api_surface.py"
    assert not changes, f"{package}: {sorted(changes)}; meant? {command}, and say so in CHANGELOG.md"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_package_states_its_public_names(package):
    module = importlib.import_module(package)
    names = module.__all__
    assert names and len(set(names)) == len(names)
    for name in names:
        value = getattr(module, name)
        assert inspect.ismodule(value) or value.__doc__ or not callable(value), f"{package}.{name} has no docstring"
