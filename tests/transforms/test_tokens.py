"""Tokens against plain loops: which patch a sample falls in, and what is said of the samples there."""

import numpy as np
import pytest
import torch

from dhtorch import MergedDepth
from dhtorch.codes import Hole, Source, names
from dhtorch.transforms import TOKEN_CHANNELS, patch_tokens, token_grid


def drawn(hw, n=300, batch=2, seed=0, dtype=torch.float64):
    """Samples all over the picture, a third each from the sensor, recovered and without an answer."""
    g = torch.Generator().manual_seed(seed)
    uv = torch.rand(batch, n, 2, generator=g, dtype=dtype) * torch.tensor([hw[1], hw[0]]) - 0.5
    depth = 0.5 + 4 * torch.rand(batch, n, generator=g, dtype=dtype)
    source = torch.randint(0, 3, (batch, n), dtype=torch.int32, generator=g)
    other = torch.randint(1, 7, (batch, n), dtype=torch.int32, generator=g)
    hole = torch.where(source == Source.SENSOR, Hole.NONE, other)
    sigma = depth * (0.02 + 0.2 * torch.rand(batch, n, generator=g, dtype=dtype))
    return MergedDepth(uv, torch.where(source > 0, depth, 0.0), sigma, depth, source), hole


def pooled(found, hole, rows, columns, patch, place):
    """The tokens, one patch and one sample at a time; ``place`` takes a pixel to the network's picture."""
    tokens = np.zeros((len(found.uv), rows * columns, len(TOKEN_CHANNELS)))
    known = np.zeros(tokens.shape[:2], bool)
    for b in range(len(found.uv)):
        for r in range(rows):
            for c in range(columns):
                inverse, noise, classes = [], [], []
                for k, (u, v) in enumerate(found.uv[b].tolist()):
                    x, y = place(u + 0.5, v + 0.5)  # from the corner of the picture
                    if not (c * patch <= x < (c + 1) * patch and r * patch <= y < (r + 1) * patch):
                        continue
                    classes.append(int(hole[b, k]))
                    if found.source[b, k] != Source.NONE:
                        z = float(found.depth[b, k])
                        inverse.append(1 / z)
                        noise.append(float(found.sigma[b, k]) / z**2)  # d(1/z) = dz / z²
                token = tokens[b, r * columns + c]
                if inverse:
                    known[b, r * columns + c] = True
                    token[0] = np.mean(inverse)
                    token[1] = np.sqrt(np.mean(np.square(noise)) + np.var(inverse))
                if classes:
                    token[2] = len(inverse) / len(classes)
                    token[3:] = [classes.count(code) / len(classes) for code in names(Hole)]
    return tokens, known


def test_channels_are_depth_then_answers_then_holes():
    assert TOKEN_CHANNELS == (
        "inverse_depth",
        "sigma",
        "answered",
        "hole_none",
        "hole_trackable_no_lidar",
        "hole_low_texture",
        "hole_too_bright",
        "hole_too_dark",
        "hole_highlight",
        "hole_at_border",
    )


@pytest.mark.parametrize(
    ("hw", "patch", "seen", "fit", "place"),
    [
        ((30, 45), 10, None, "stretch", lambda x, y: (x, y)),
        ((33, 48), 7, None, "crop", lambda x, y: (x, y)),  # what is left of the size is dropped
        ((30, 40), 8, (16, 48), "stretch", lambda x, y: (x * 48 / 40, y * 16 / 30)),
        ((20, 40), 8, (32, 24), "pad", lambda x, y: (x * 0.6, (y - 10) * 0.6 + 16)),
        ((40, 20), 8, (24, 32), "pad", lambda x, y: ((x - 10) * 0.6 + 16, y * 0.6)),
        ((20, 40), 8, (32, 24), "crop", lambda x, y: ((x - 20) * 1.6 + 12, y * 1.6)),
        ((40, 20), 8, (24, 32), "crop", lambda x, y: (x * 1.6, (y - 20) * 1.6 + 12)),
    ],
)
def test_tokens_are_those_of_a_plain_loop(hw, patch, seen, fit, place):
    found, hole = drawn(hw)
    tokens, known = patch_tokens(found, hole, hw, patch=patch, tokens_hw=seen, fit=fit)
    rows, columns = (size // patch for size in (seen or hw))
    wanted, some = pooled(found, hole, rows, columns, patch, place)
    assert tokens.shape == (2, rows * columns, 10) and token_grid(hw, patch=patch, tokens_hw=seen) == (rows, columns)
    assert np.array_equal(known.numpy(), some) and some.any()
    np.testing.assert_allclose(tokens.numpy(), wanted, rtol=1e-9, atol=1e-12)
    assert torch.allclose(tokens[..., 3:].sum(-1), (tokens[..., 3:].sum(-1) > 0).double()), "shares of holes sum to 1"


def told(uv, depth, sigma=0.0, source=1):
    uv = torch.tensor([uv], dtype=torch.float64)
    depth = torch.tensor([depth], dtype=torch.float64)
    return MergedDepth(uv, depth, depth * 0 + sigma, depth, torch.full(depth.shape, source, dtype=torch.int32))


def test_patches_go_row_by_row_and_a_pixel_on_the_edge_is_in_the_later_one():
    hw, patch = (20, 30), 10  # two rows of three
    for (u, v), place in {
        (0, 0): 0, (10, 0): 1, (29, 9): 2, (0, 10): 3, (29, 19): 5, (9.49, 0): 0, (9.5, 0): 1, (0, 9.49): 0, (0, 9.5): 3,
        (-0.5, -0.5): 0, (29.49, 19.49): 5,
    }.items():  # fmt: skip
        tokens, known = patch_tokens(told([(u, v)], [2.0]), torch.zeros(1, 1), hw, patch=patch)
        assert known[0].nonzero().tolist() == [[place]] and tokens[0, place, 0] == 0.5, (u, v)
    for outside in ((-0.51, 5), (29.5, 5), (5, -0.51), (5, 19.5)):
        tokens, known = patch_tokens(told([outside], [2.0]), torch.zeros(1, 1), hw, patch=patch)
        assert not known.any() and not tokens.any(), outside


def test_sigma_is_noise_and_spread_of_inverse_depth():
    one = told([(3, 3)], [2.0], 0.4)
    assert patch_tokens(one, torch.zeros(1, 1), (10, 10), patch=10)[0][0, 0, 1] == pytest.approx(0.1)
    two = told([(3, 3), (6, 6)], [1.0, 2.0], 0.0)
    tokens, _ = patch_tokens(two, torch.zeros(1, 2), (10, 10), patch=10)
    assert tokens[0, 0, :3].tolist() == pytest.approx([0.75, 0.25, 1.0])
    calm = told([(3, 3), (6, 6)], [2.0, 2.0], 0.0)
    assert patch_tokens(calm, torch.zeros(1, 2), (10, 10), patch=10)[0][0, 0, 1] == 0


def test_what_has_no_source_or_no_depth_is_no_answer():
    uv = [(2, 2), (4, 4), (6, 6), (8, 8)]
    found = told(uv, [1.0, 2.0, 0.0, 5.0], 0.1)
    found = found.replace(source=torch.tensor([[1, 2, 1, 0]], dtype=torch.int32))
    tokens, known = patch_tokens(found, torch.tensor([[0, 1, 2, 6]]), (10, 10), patch=10)
    assert tokens[0, 0, [0, 2]].tolist() == pytest.approx([0.75, 0.5]) and known.all()
    assert tokens[0, 0, 3:].tolist() == pytest.approx([0.25, 0.25, 0.25, 0, 0, 0, 0.25])
    silent = found.replace(source=found.source * 0)
    tokens, known = patch_tokens(silent, torch.tensor([[3, 3, 3, 3]]), (10, 10), patch=10)
    assert not known.any() and tokens[0, 0].tolist() == [0, 0, 0, 0, 0, 0, 1, 0, 0, 0]


def test_gradient_of_tokens_against_finite_differences():
    found, hole = drawn((20, 30), n=12, batch=1, seed=3)

    def of(depth, sigma):
        answers = torch.where(found.source > 0, depth, 0.0)
        return patch_tokens(found.replace(depth=answers, sigma=sigma), hole, (20, 30), patch=10)[0]

    depth = found.score.clone().requires_grad_()
    assert torch.autograd.gradcheck(of, (depth, found.sigma.clone().requires_grad_()))
    flat = torch.ones(1, 3, dtype=torch.float64, requires_grad=True)
    same = told([(2, 2), (5, 5), (7, 7)], [1.0, 1.0, 1.0]).replace(depth=flat)
    patch_tokens(same, torch.zeros(1, 3), (10, 10), patch=10)[0].sum().backward()
    assert flat.grad.isfinite().all(), "no spread and no noise: the root has no slope, the tokens have"


def test_tokens_have_the_type_of_the_depth():
    for dtype in (torch.float32, torch.float64):
        found, hole = drawn((20, 20), dtype=dtype)
        assert patch_tokens(found, hole, (20, 20), patch=10)[0].dtype == dtype


@pytest.mark.parametrize("fit", ["stretch", "pad", "crop"])
def test_tokens_lie_where_the_network_sees_them(fit):
    """Grey values of the picture as the network gets it, and tokens of the same picture, agree about the place."""
    hw, side = (60, 120), 56
    uv = torch.cartesian_prod(torch.arange(120.0), torch.arange(60.0))[None]
    value = 1 / (1 + uv[..., 0] + 200 * uv[..., 1])  # a depth that tells the pixel
    one = torch.ones_like(value)
    found = MergedDepth(uv, value, 0 * one, one, one.int())
    tokens, known = patch_tokens(found, one.int() * 0, hw, tokens_hw=(side, side), fit=fit)
    picture = (1 / value).view(120, 60).T[None, None]
    if fit == "crop":
        picture = picture[..., 30:90]
    shape = (side // 2, side) if fit == "pad" else (side, side)
    picture = torch.nn.functional.interpolate(picture, shape, mode="area")
    if fit == "pad":
        picture = torch.nn.functional.pad(picture, (0, 0, side // 4, side // 4))
    wanted = torch.nn.functional.avg_pool2d(picture, 14).flatten()
    got = tokens[0, :, 0]
    assert torch.equal(known[0], wanted > 0) and (got[~known[0]] == 0).all()
    assert torch.allclose(got[known[0]], wanted[known[0]], rtol=0.05)


def test_tokens_refuse_what_cannot_be():
    found = MergedDepth(*(torch.zeros(1, 0, 2), *torch.zeros(3, 1, 0), torch.zeros(1, 0, dtype=torch.int32)))
    tokens, known = patch_tokens(found, torch.zeros(1, 0), (28, 28))
    assert tokens.shape == (1, 4, 10) and not known.any() and (tokens == 0).all()
    with pytest.raises(ValueError, match="found an image of 10x28, expected at least one patch of 14 px"):
        patch_tokens(found, torch.zeros(1, 0), (10, 28))
    with pytest.raises(ValueError, match="fit is 'squash', expected one of stretch, pad, crop"):
        patch_tokens(found, torch.zeros(1, 0), (28, 28), fit="squash")
    for wrong in (torch.zeros(2, 0), torch.zeros(1, 1), torch.zeros(1, 0, 1)):
        with pytest.raises(ValueError, match="patch_tokens"):
            patch_tokens(found, wrong, (28, 28))


def test_a_grid_counts_whole_patches():
    assert token_grid((28, 43)) == (2, 3) and token_grid((480, 640), patch=16, tokens_hw=(31, 64)) == (1, 4)
    assert token_grid((14, 14)) == (1, 1) and token_grid((3, 3), patch=3, tokens_hw=(5, 3)) == (1, 1)
    for hw, patch in (((13, 40), 14), ((40, 13), 14), ((40, 40), 0), ((40, 40), -1)):
        with pytest.raises(ValueError, match=f"found an image of {hw[0]}x{hw[1]}, expected .* patch of {patch} px"):
            token_grid(hw, patch=patch)
    with pytest.raises(ValueError, match="found an image of 9x50"):
        token_grid((400, 400), tokens_hw=(9, 50))
