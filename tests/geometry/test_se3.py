"""Rigid motions against exact series, matrix exponentials and kornia; functions whose rounding is steady."""

import math
from fractions import Fraction

import pytest
import torch

from dhtorch.geometry import se3
from dhtorch.geometry.determinism import ELEMENTWISE_LANES, pad_elementwise, round_up
from dhtorch.geometry.se3 import Pose

#: Rotation angles on both sides of where the series end (0.1 rad), up to beyond half a turn.
BELOW = [0.0, 1e-160, 1e-9, 1e-4, 0.01, 0.03, *(0.09 + 0.0005 * k for k in range(20)), 0.0999999]
ABOVE = [0.1000001, *(0.102 + 0.002 * k for k in range(20)), 0.5, 1.5, 3.0, 3.3, 6.0]


def double(*values):
    return torch.tensor(values, dtype=torch.float64)


def drawn(batch=4, seed=0, scale=1.0):
    return scale * torch.randn(batch, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def poses(batch=4, seed=0):
    """Poses that owe nothing to the code under test."""
    xi = drawn(batch, seed)
    return Pose(torch.linalg.matrix_exp(cross_matrix(xi[:, :3])), xi[:, 3:])


def cross_matrix(v):
    """v × each of the three axes, as columns."""
    eye = torch.eye(3, dtype=v.dtype)
    return torch.stack([torch.linalg.cross(v, eye[k].expand_as(v)) for k in range(3)], -1)


def generators(xi):
    """(B, 4, 4) whose matrix exponential is the motion."""
    top = torch.cat((cross_matrix(xi[:, :3]), xi[:, 3:, None]), -1)
    return torch.cat((top, torch.zeros_like(top[:, :1])), 1)


def series(theta, first):
    """Σ (−1)ᵏ θ²ᵏ / (2k + first)! in exact fractions: sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³ for first = 1, 2, 3."""
    square = Fraction(theta) ** 2
    return float(sum((-square) ** k / math.factorial(2 * k + first) for k in range(22)))


def coefficients(theta):
    """The three coefficients as exp uses them, each read from an entry of R or t where it stands alone."""
    theta = double(*theta)
    zero, one = torch.zeros_like(theta), torch.ones_like(theta)
    p, q = 0.6 * theta, 0.8 * theta
    flat = se3.exp(torch.stack((p, q, zero, zero, one, zero), -1))  # an axis in the plane of x and y
    return flat.R[:, 0, 2] / q, flat.R[:, 0, 1] / (p * q), flat.t[:, 0] / (p * q)


# ------------------------------------------------------------------------------------------------ exponential map


@pytest.mark.parametrize(("angles", "rtol"), [(BELOW[2:], (5e-14, 8e-15, 2e-15)), (ABOVE, (5e-15, 1e-13, 4e-13))])
def test_every_coefficient_is_that_of_the_exact_series(angles, rtol):
    """Near the switch a single wrong factor of a series differs by more than 2e-13; what they leave out is less."""
    for k, found in enumerate(coefficients(angles)):
        exact = double(*(series(theta, k + 1) for theta in angles))
        torch.testing.assert_close(found, exact, rtol=rtol[k], atol=0)


def test_the_whole_motion_is_the_matrix_exponential():
    for scale in (1e-3, 0.03, 1.0, 2.0):
        xi = drawn(scale=scale)
        torch.testing.assert_close(
            se3.to_matrix(se3.exp(xi)), torch.linalg.matrix_exp(generators(xi)), rtol=0, atol=1e-13
        )


def test_gradients_at_zero_are_exact_up_to_the_second():
    zero, eye = torch.zeros(6, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    G = torch.stack([cross_matrix(e) for e in eye])  # generators of rotations

    def R(xi):
        return se3.exp(xi[None]).R[0]

    def t(xi):
        return se3.exp(xi[None]).t[0]

    by_rotation = torch.func.jacrev(R)(zero)
    assert torch.equal(by_rotation[..., :3], G.movedim(0, -1)) and not by_rotation[..., 3:].any()
    by_translation = torch.func.jacrev(t)(zero)
    assert torch.equal(by_translation[:, 3:], eye) and not by_translation[:, :3].any()
    curved = torch.func.jacfwd(torch.func.jacrev(R))(zero)[..., :3, :3]
    torch.testing.assert_close(curved, (torch.einsum("iab,jbc->acij", G, G) + torch.einsum("jab,ibc->acij", G, G)) / 2)
    mixed = torch.func.jacfwd(torch.func.jacrev(t))(zero)[:, :3, 3:]  # half the cross product
    torch.testing.assert_close(mixed, G.permute(1, 0, 2) / 2)


def test_a_rotation_that_drifted_is_one_again_and_keeps_its_first_row():
    R = poses(seed=5).R
    torch.testing.assert_close(se3.orthonormal(R), R, rtol=0, atol=1e-14)
    drifted = R + 1e-3 * drawn(12, seed=6).view(-1, 3, 3)[:4]
    found = se3.orthonormal(drifted)
    torch.testing.assert_close(found @ found.mT, torch.eye(3, dtype=R.dtype).expand(4, 3, 3), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(4, dtype=R.dtype))
    torch.testing.assert_close(found[:, 0], torch.nn.functional.normalize(drifted[:, 0], dim=-1))
    assert (found - R).abs().max() < 5e-3


# ------------------------------------------------------------------------------------------------ motions as matrices


def test_motions_are_products_of_matrices():
    A, B, xi, matrix = poses(seed=2), poses(seed=3), drawn(seed=1), se3.to_matrix
    xyz = drawn(4 * 5, seed=4)[:, :3].reshape(4, 5, 3)
    torch.testing.assert_close(se3.rotate(A.R, xyz), torch.einsum("bij,bnj->bni", A.R, xyz))
    torch.testing.assert_close(se3.apply(A, xyz), torch.einsum("bij,bnj->bni", A.R, xyz) + A.t[:, None])
    for T, want in (
        (A, torch.cat((torch.cat((A.R, A.t[..., None]), -1), double(0, 0, 0, 1).expand(4, 1, 4)), 1)),
        (se3.from_matrix(matrix(A)), matrix(A)),
        (se3.from_matrix(matrix(A)[:, :3]), matrix(A)),
        (se3.identity(4, A.t), torch.eye(4, dtype=torch.float64).expand(4, 4, 4)),
        (se3.compose(A, B), matrix(A) @ matrix(B)),
        (se3.invert(A), torch.linalg.inv(matrix(A))),
        (se3.relative(A, B), torch.linalg.inv(matrix(B)) @ matrix(A)),
        (se3.retract(A, xi), torch.linalg.matrix_exp(generators(xi)) @ matrix(A)),
        (se3.exp(se3.log(A)), matrix(A)),
    ):
        torch.testing.assert_close(matrix(T), want)
    moved = torch.linalg.matrix_exp(generators((se3.adjoint(A) @ xi[..., None])[..., 0])) @ matrix(A)
    torch.testing.assert_close(moved, matrix(A) @ torch.linalg.matrix_exp(generators(xi)))


# ------------------------------------------------------------------------------------------------ angles


def turn(axis, angle):
    """Rodrigues' formula with the axis' own unit length."""
    axis = axis / axis.norm()
    return (
        math.cos(angle) * torch.eye(3, dtype=torch.float64)
        + math.sin(angle) * cross_matrix(axis)
        + (1 - math.cos(angle)) * axis[:, None] * axis
    )


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.3, math.pi / 2, 2.0, math.pi - 1e-6, math.pi - 1e-9, math.pi])
def test_the_angle_of_a_rotation_is_accurate_everywhere(angle):
    R = torch.stack(
        [turn(double(*axis), angle) for axis in ((1, 2, 3), (-1, 0, 0.2), (0, 0, 1), (0, -1, 0), (1, 0, 0))]
    )
    found = se3.rotation_angle(R.view(5, 1, 3, 3))
    torch.testing.assert_close(found, torch.full((5, 1), angle, dtype=torch.float64), rtol=1e-12, atol=1e-15)


def test_the_gradient_of_an_angle_is_one_along_its_axis():
    axis = double(2 / 3, -1 / 3, 2 / 3)
    slope = torch.func.grad(
        lambda s: se3.rotation_angle(turn(axis, 0.4) @ torch.linalg.matrix_exp(s * cross_matrix(axis)))
    )
    assert float(slope(double(0.0)[0])) == pytest.approx(1)
    for angle in (0.0, math.pi):
        R = turn(axis, angle).requires_grad_()
        se3.rotation_angle(R).backward()
        assert R.grad.isfinite().all()


# ------------------------------------------------------------------------------------------------ steady rounding


@pytest.mark.parametrize("shape", [(1,), (7, 3), (ELEMENTWISE_LANES,), (2, ELEMENTWISE_LANES + 1), (0, 3), ()])
def test_functions_are_handed_whole_strides_in_one_row(shape):
    """No element is left over for the scalar loop, whose rounding differs."""
    seen = []

    def fn(a, b):
        seen.append((a.shape, b.shape))
        return torch.atan2(a, b)

    a = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    found = pad_elementwise(fn, a, 1 + a)
    count = -(-a.numel() // ELEMENTWISE_LANES) * ELEMENTWISE_LANES
    assert seen == [((count,), (count,))]
    torch.testing.assert_close(found, torch.atan2(a, 1 + a))
    alone = torch.cat([pad_elementwise(torch.atan2, v[None], 1 + v[None]) for v in a.flatten()]) if a.numel() else found
    assert torch.equal(found.flatten(), alone.flatten()), "an element's value does not depend on its place"
    for fewer in (a.new_ones(5, 5), a.new_ones(2)):
        with pytest.raises(ValueError, match="expected equal shapes"):
            pad_elementwise(torch.atan2, a, fewer)
    assert [round_up(n, 16) for n in (0, 1, 15, 16, 17, 32)] == [16, 16, 16, 16, 32, 32]
    assert round_up(1) == ELEMENTWISE_LANES and ELEMENTWISE_LANES % 32 == 0, "two registers of sixteen"
