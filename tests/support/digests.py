"""Records, arrays and numbers as short lists of numbers that are compared with a tolerance."""

import dataclasses
import json
import math
import re

import numpy as np
import torch

#: Difference of two numbers that counts as none, as a share of their size or of the mean size of their leaf.
TOLERANCE = 1e-6

#: Mean size of a leaf below which its numbers are rounding errors.
MIN_SIZE = 1e-6

_NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")


def digest(value, path="", out=None):
    """Path of every leaf → its shape, kind, number of finite values and four weighted means of these; or its text."""
    out = {} if out is None else out
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            digest(getattr(value, field.name), f"{path}.{field.name}", out)
    elif hasattr(value, "_asdict"):
        digest(value._asdict(), path, out)
    elif isinstance(value, dict):
        for key, item in value.items():
            digest(item, f"{path}.{key}", out)
    elif isinstance(value, list | tuple) and not all(isinstance(x, int | float) for x in value):
        for k, item in enumerate(value):
            digest(item, f"{path}.{k}", out)
    elif isinstance(value, torch.Tensor | np.ndarray | list | tuple) or (
        isinstance(value, int | float) and not isinstance(value, bool)
    ):
        out[path] = summary(value)
    else:
        out[path] = repr(value) if isinstance(value, str | bool | None) else type(value).__name__
    return out


def summary(value):
    """An array of numbers: shape, finite values, and their mean, mean size, and means with two waves of weights."""
    array = value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
    flat = array.astype(np.float64).ravel()
    place = np.arange(len(flat)) + 1.0
    finite = np.isfinite(flat)
    x = np.where(finite, flat, 0.0)
    n = max(int(finite.sum()), 1)
    waves = [np.ones_like(x), np.cos(0.7 * place), np.sin(0.013 * place)]
    means = [float((x * w).sum() / n) for w in waves]
    numbers = [float(np.abs(x).sum() / n), *means]
    return [list(array.shape), int(finite.sum()), *(float(f"{number:.10g}") for number in numbers)]


def alike(a, b, absolute, relative):
    """Whether two lines of text differ in numbers alone, and in these by no more than stated."""
    x, y = ([float(n) for n in _NUMBER.findall(line)] for line in (a, b))
    return a == b or (_NUMBER.sub("#", a) == _NUMBER.sub("#", b) and np.allclose(x, y, atol=absolute, rtol=relative))


def dump(value):
    """JSON text with a line for every leaf."""
    text = json.dumps(value, indent=1, ensure_ascii=False)
    for _ in range(2):  # shapes, then the lists that hold them
        text = re.sub(
            r"\[\s+([^\[\]{}\"]*(?:\[[^\[\]]*\][^\[\]{}\"]*)?)\s+\]", lambda m: f"[{' '.join(m[1].split())}]", text
        )
    return f"{text}\n"


def differences(found, stored, tolerance=TOLERANCE):
    """Lines for the leaves that differ."""
    lines = [f"{path}: only {'found' if path in found else 'stored'}" for path in found.keys() ^ stored.keys()]
    for path in found.keys() & stored.keys():
        a, b = found[path], stored[path]
        if isinstance(a, str) or isinstance(b, str):
            same = a == b
        else:
            size = max(abs(b[2]), MIN_SIZE)
            same = a[0] == b[0] and all(
                math.isclose(x, y, rel_tol=tolerance, abs_tol=tolerance * size)
                for x, y in zip(a[1:], b[1:], strict=True)
            )
        if not same:
            lines.append(f"{path}: found {a}, stored {b}")
    return sorted(lines)
