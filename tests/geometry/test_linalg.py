"""Closed forms of small matrices against NumPy's algebra."""

import numpy as np
import pytest
import torch

from dhtorch.geometry import linalg as small


def matrices(*shape, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


def entries(A):
    """Of (…, 2, 2), one tensor each."""
    return A.flatten(-2).unbind(-1)


def test_determinant_and_adjugate_are_those_of_numpy():
    A = matrices(50, 2, 2)
    found = torch.stack(small.adjugate_2x2(*entries(A)), -1).unflatten(-1, (2, 2))
    det = small.determinant_2x2(*entries(A))
    np.testing.assert_allclose(det.numpy(), np.linalg.det(A.numpy()), rtol=1e-12)
    np.testing.assert_allclose((found @ A).numpy(), det[:, None, None].numpy() * np.eye(2), atol=1e-12)


def test_the_inverse_of_a_singular_matrix_is_its_adjugate_over_the_least_determinant():
    A = matrices(50, 2, 2)
    found = small.inverse_2x2(*entries(A), least=1e-12).movedim(0, -1).unflatten(-1, (2, 2))
    np.testing.assert_allclose(found.numpy(), np.linalg.inv(A.numpy()), rtol=1e-10)
    one, two = torch.ones(2), torch.tensor([2.0, torch.nan])
    assert small.inverse_2x2(one, two, one, two, least=0.5)[:, 0].tolist() == [4.0, -4.0, -2.0, 2.0]
    assert small.inverse_2x2(one, two, one, two, least=0.5)[[0, 2]][1, 1] == -2.0, "no number counts as the least, too"
    half = torch.tensor([0.5, 0.25, -0.25, -1.0], dtype=torch.float64)
    zero = torch.zeros_like(half)
    found = small.inverse_2x2(half, zero, zero, torch.ones_like(half), least=0.25)[3]
    assert found.tolist() == [1.0, 1.0, -1.0, 1.0], "a determinant of the least size counts as it, with its sign lost"


@pytest.mark.parametrize("equal", [False, True])
def test_eigenvalues_are_those_of_numpy(equal):
    A = (
        torch.eye(2, dtype=torch.float64).repeat(5, 1, 1) * torch.arange(5.0)[:, None, None]
        if equal
        else matrices(9, 2, 2)
    )
    a, b, _, c = entries(A)
    found = torch.stack(small.eigenvalues_2x2(a, b, c), -1)
    np.testing.assert_allclose(found.numpy(), np.linalg.eigvalsh(A.mT.numpy()), rtol=1e-12, atol=1e-12)


def test_equal_eigenvalues_pass_the_gradient_of_their_mean():
    a, b, c = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (2.0, 0.0, 2.0))
    smaller, larger = small.eigenvalues_2x2(a, b, c)
    for found in (smaller, larger):
        assert [float(g) for g in torch.autograd.grad(found, (a, b, c), retain_graph=True)] == [0.5, 0.0, 0.5]
