"""Tokens by hand: which patch a sample falls in, and what a token says of its samples; many: test_stored_answers.py."""

import pytest
import torch

from dhtorch import MergedDepth
from dhtorch.codes import Hole, Source
from dhtorch.transforms import patch_tokens, token_grid


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


def tokens_of(uv, depth, sigma=0.0, source=1, hole=None, hw=(10, 10)):
    """Tokens of one image of patches of 10 px, and which are known."""
    uv, depth = torch.tensor([uv], dtype=torch.float64), torch.tensor([depth], dtype=torch.float64)
    source = torch.tensor(source, dtype=torch.int32).expand(depth.shape)
    hole = torch.zeros(depth.shape) if hole is None else torch.tensor([hole])
    tokens, known = patch_tokens(MergedDepth(uv, depth, depth * 0 + sigma, depth, source), hole, hw, patch=10)
    return tokens[0], known[0]


@pytest.mark.parametrize(
    ("uv", "place"),
    [
        *(((0, 0), 0), ((10, 0), 1), ((29, 9), 2), ((0, 10), 3), ((29, 19), 5), ((9.49, 0), 0), ((9.5, 0), 1)),
        *(((0, 9.49), 0), ((0, 9.5), 3), ((-0.5, -0.5), 0), ((29.49, 19.49), 5)),
        *((uv, None) for uv in ((-0.51, 5), (29.5, 5), (5, -0.51), (5, 19.5))),
    ],
)
def test_patches_go_row_by_row_and_a_pixel_on_the_edge_is_in_the_later_one(uv, place):
    tokens, known = tokens_of([uv], [2.0], hw=(20, 30))  # two rows of three
    assert known.nonzero().tolist() == ([] if place is None else [[place]])
    assert tokens[:, 0].tolist() == [0.5 * (k == place) for k in range(6)]


UV = [(2, 2), (4, 4), (6, 6), (8, 8)]


@pytest.mark.parametrize(
    ("samples", "wanted"),
    [
        ((UV[:1], [2.0], 0.4), [0.5, 0.1, 1.0]),  # noise: d(1/z) = dz / z²
        ((UV[:2], [1.0, 2.0]), [0.75, 0.25, 1.0]),  # spread
        ((UV[:2], [2.0, 2.0]), [0.5, 0.0, 1.0]),
        # What has no source or no depth is no answer.
        (
            (UV, [1.0, 2.0, 0.0, 5.0], 0.0, [1, 2, 1, 0], [0, 1, 2, 6]),
            [0.75, 0.25, 0.5, 0.25, 0.25, 0.25, 0, 0, 0, 0.25],
        ),
        ((UV, [1.0, 2.0, 0.0, 5.0], 0.1, 0, [3, 3, 3, 3]), [0, 0, 0, 0, 0, 0, 1, 0, 0, 0]),
    ],
)
def test_a_token_by_hand(samples, wanted):
    tokens, known = tokens_of(*samples)
    assert tokens[0, : len(wanted)].tolist() == pytest.approx(wanted) and bool(known[0]) == (wanted[2] > 0)


def test_gradient_of_tokens_against_finite_differences():
    found, hole = drawn((20, 30), n=12, batch=1, seed=3)

    def of(depth, sigma):
        answers = torch.where(found.source > 0, depth, 0.0)
        return patch_tokens(found.replace(depth=answers, sigma=sigma), hole, (20, 30), patch=10)[0]

    depth = found.score.clone().requires_grad_()
    assert torch.autograd.gradcheck(of, (depth, found.sigma.clone().requires_grad_()))
    flat = torch.ones(1, 3, requires_grad=True)
    same = MergedDepth(torch.full((1, 3, 2), 4.0), flat, 0 * flat.detach(), flat, torch.ones(1, 3, dtype=torch.int32))
    tokens = patch_tokens(same, torch.zeros(1, 3), (10, 10), patch=10)[0]
    tokens.sum().backward()
    assert flat.grad.isfinite().all(), "no spread and no noise: the root has no slope, the tokens have"
    assert tokens.dtype == torch.float32, "the type of the depth"


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


NOTHING = MergedDepth(*(torch.zeros(1, 0, 2), *torch.zeros(3, 1, 0), torch.zeros(1, 0, dtype=torch.int32)))


@pytest.mark.parametrize(
    ("hw", "options", "hole", "words"),
    [
        ((10, 28), {}, (1, 0), "found an image of 10x28, expected at least one patch of 14 px"),
        ((28, 28), {"fit": "squash"}, (1, 0), "fit is 'squash', expected one of stretch, pad, crop"),
        *(((28, 28), {}, hole, "patch_tokens") for hole in ((2, 0), (1, 1), (1, 0, 1))),
        *(((40, 40), {"patch": k}, (1, 0), f"expected at least one patch of {k} px") for k in (0, -1)),
        ((40, 13), {}, (1, 0), "found an image of 40x13"),
        ((400, 400), {"tokens_hw": (9, 50)}, (1, 0), "found an image of 9x50"),
    ],
)
def test_tokens_refuse_what_cannot_be(hw, options, hole, words):
    with pytest.raises(ValueError, match=words):
        patch_tokens(NOTHING, torch.zeros(hole), hw, **options)
    tokens, known = patch_tokens(NOTHING, torch.zeros(1, 0), (28, 28))
    assert tokens.shape == (1, 4, 10) and not known.any() and (tokens == 0).all()
    assert token_grid((28, 43)) == (2, 3) and token_grid((480, 640), patch=16, tokens_hw=(31, 64)) == (1, 4)
    assert token_grid((14, 14)) == (1, 1) and token_grid((3, 3), patch=3, tokens_hw=(5, 3)) == (1, 1)
