"""Work without a graph: the same numbers, and tensors that may enter a graph afterwards."""

import torch

from dhtorch.geometry.determinism import run_without_grad


def seen(x, y):
    """What came in doubled, as it is, and whether this ran in inference mode."""
    return {"made": 2 * x, "given": y}, torch.is_inference_mode_enabled()


def test_what_comes_out_may_enter_a_graph():
    weight = torch.ones(3, requires_grad=True)
    given = torch.arange(3.0)
    out, inside = run_without_grad(seen, torch.arange(3.0), given)
    assert inside
    assert out["given"] is given
    assert not out["made"].is_inference()
    (weight * out["made"]).sum().backward()  # which a tensor of inference mode refuses
    assert weight.grad.tolist() == [0.0, 2.0, 4.0]
    out["made"] += 1


def test_transforms_and_compilers_see_the_function_itself():
    x = torch.arange(3.0)
    (_, tangent) = torch.func.jvp(lambda x: run_without_grad(seen, x, x)[0]["made"], (x,), (torch.ones(3),))
    assert tangent.tolist() == [2.0, 2.0, 2.0]
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(x, torch.ones(3))
        out = run_without_grad(seen, dual, x)[0]["made"]
        assert torch.autograd.forward_ad.unpack_dual(out).tangent.tolist() == [2.0, 2.0, 2.0]
    compiled = torch.compile(lambda x: run_without_grad(torch.mul, x, 2), backend="eager", fullgraph=True)
    assert compiled(x).tolist() == [0.0, 2.0, 4.0]
