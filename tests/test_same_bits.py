"""``benchmarks/same_bits.py``: what an item is reduced to, and how two checkouts are held against each other."""

import sys
from pathlib import Path

import torch
from support.byte_damage import change_middle

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import same_bits


def dumped(**items):
    values = {}
    return same_bits.Dump(False, {name: same_bits.measured(fn, values) for name, fn in items.items()}, values)


def test_tensors_are_compared_by_bits_and_an_error_is_a_result():
    depth = torch.tensor([1.0, 2.0, torch.nan])
    old = dumped(pair=lambda: {"depth": depth, "gate": torch.zeros(3)}, broken=lambda: 1 / 0)
    assert same_bits.outcome("pair", old, dumped(pair=lambda: {"depth": depth.clone(), "gate": torch.zeros(3)})) == (
        2,
        "",
    )
    moved = dumped(pair=lambda: {"depth": depth + torch.tensor([0.0, 0.5, 0.0]), "gate": torch.zeros(3)})
    assert same_bits.outcome("pair", old, moved) == (2, "depth (max 0.5 of 3 values)")
    signed = dumped(pair=lambda: {"depth": depth, "gate": -torch.zeros(3)})
    assert same_bits.outcome("pair", old, signed) == (2, "gate (max 0 of 3 values)")
    assert same_bits.outcome("broken", old, old)[1].startswith("OLD: ZeroDivisionError")


def test_the_key_of_a_checkout_depends_on_the_bytes_of_its_code(tmp_path):
    file = tmp_path / "dhtorch" / "a.py"
    file.parent.mkdir()
    file.write_text("x = 1\n")
    first = same_bits.state(tmp_path)
    change_middle(file)
    assert same_bits.state(tmp_path) != first
    change_middle(file)
    assert same_bits.state(tmp_path) == first
