"""Tracks through images between: what a jump loses, wrong hops, lost points, covariances, options."""

from functools import partial

import pytest
import torch

from dhtorch.pipeline.presets import KORNIA, MAP, PAPER, PAPER_DIRECT
from dhtorch.records import TrackHint, Tracks
from dhtorch.stages.kornia.track import lucas_kanade_kornia
from dhtorch.stages.track import lucas_kanade, lucas_kanade_affine
from dhtorch.stages.track_chain import frames_between, images_used, track_chain

FIELDS = ("uv_0", "uv_1", "error", "photometric", "cov", "valid")
MOTION = torch.tensor([30.0, -18.0])
H, W = 120, 160


def texture(shift, dtype=torch.float64):
    """Waves of 10 to 50 px moved by ``shift``: a jump over more than a wave finds a wrong one."""
    draw = torch.Generator().manual_seed(3)
    length, turn, phase = torch.rand(3, 60, 1, 1, generator=draw, dtype=torch.float64)
    length, turn, phase = 10 * 5**length, 6.2832 * turn, 6.2832 * phase
    v, u = torch.meshgrid(torch.arange(H) - shift[1], torch.arange(W) - shift[0], indexing="ij")
    wave = (6.2832 / length * (turn.cos() * u + turn.sin() * v) + phase).sin()
    return (0.5 + 0.03 * wave.sum(0))[None, None].to(dtype)


def sequence(hops, noise=0.0, seed=0):
    """Images of ``hops`` equal steps of the motion, the first at rest; ``noise`` is in those between alone."""
    draw = torch.Generator().manual_seed(seed)
    first, *images, last = [texture(MOTION * k / hops) for k in range(hops + 1)]
    noisy = [image + noise * torch.randn(image.shape, generator=draw, dtype=image.dtype) for image in images]
    return [first, *noisy, last]


def points(n=40, dtype=torch.float64):
    draw = torch.Generator().manual_seed(1)
    room = torch.tensor([W - 70.0, H - 60.0], dtype=dtype)
    return torch.rand(1, n, 2, generator=draw, dtype=dtype) * room + torch.tensor([18.0, 36.0], dtype=dtype)


def through(images, uv, track=lucas_kanade, **options):
    hint = TrackHint(between=images[1:-1])
    return track_chain(images[0], images[-1], uv, track=track, hint=hint, **options)


def distance(tracks):
    return (tracks.uv_1 - tracks.uv_0 - MOTION.to(tracks.uv_0)).norm(dim=-1)


def right(tracks):
    return float((tracks.valid & (distance(tracks) < 0.1)).double().mean())


# --- what is found ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("track", [lucas_kanade, lucas_kanade_affine, lucas_kanade_kornia])
def test_the_chain_finds_what_the_jump_loses(track):
    images, uv = sequence(6), points()
    search = {} if track is not lucas_kanade_affine else {"track": partial(lucas_kanade, levels=1)}
    search = {"levels": 1, **search}
    jump = track(images[0], images[-1], uv, **search)
    chain = through(images, uv, partial(track, **search), between=5)
    assert right(jump) < 0.1 and right(chain) > 0.95
    assert not (chain.valid & (distance(chain) > 0.1)).any()


@pytest.mark.parametrize("track", [lucas_kanade, lucas_kanade_affine, lucas_kanade_kornia])
@pytest.mark.parametrize("hint", [{}, {"between": sequence(4)[1:-1]}], ids=["none", "unused"])
def test_without_images_between_it_is_the_tracker_bit_for_bit(track, hint):
    images, uv = sequence(4), points()
    start = uv + MOTION * 0.9
    plain = track(images[0], images[-1], uv, hint=TrackHint(start, levels=2))
    options = {"between": 0} if hint else {}  # no image is used, whatever the hint offers
    hint = TrackHint(start, levels=2, **hint)
    chain = track_chain(images[0], images[-1], uv, track=track, hint=hint, **options)
    assert all(torch.equal(getattr(plain, name), getattr(chain, name)) for name in FIELDS)


# --- rules, on trackers whose every answer is known ------------------------------------------------------------------


def stand_in(calls=None, hop_shift=None, lost=(), unregistered=(), round_trip=0.1):
    """A tracker of images that are numbers: a point moves by 10 px from each to the next.

    ``hop_shift``: (from, to) → what hops between these two move wrongly (N, 2); ``lost``: such pairs that lose point 0;
    ``unregistered``: images in which searches from image 0 with a start lose point 1.
    """

    def track(image_0, image_1, uv_0, *, hint):
        j, k = int(image_0[0, 0, 0, 0]), int(image_1[0, 0, 0, 0])
        uv_1 = uv_0 + torch.tensor([10.0 * (k - j), 0])
        if hint.start is None:
            uv_1 = uv_1 + (hop_shift or {}).get((j, k), 0)
        valid = (uv_0 >= 0).all(-1)
        valid[:, 0] &= (j, k) not in lost
        valid[:, 1] &= hint.start is None or k not in unregistered
        if calls is not None:
            calls.append((j, k, uv_0.clone(), hint))
        cov = 0.01 * (1 + abs(k - j)) * torch.eye(2).expand(*valid.shape, 2, 2)
        error = torch.full_like(uv_0[..., 0], round_trip)
        photometric = error + k + (0.1 if j else 0.0)
        return Tracks(uv_0, uv_1, error, photometric, cov, valid)

    return track


def numbered(count):
    return [torch.full((1, 1, 30, 90), float(k)) for k in range(count)]


UV = torch.tensor([[[5.0, 6.0], [7.0, 8.0], [9.0, 10.0]]])


def test_covariance_and_error_are_the_registrations_or_sums():
    chain = through(numbered(5), UV, stand_in(unregistered=(3, 4)), between=3)
    assert torch.equal(chain.uv_1, UV + torch.tensor([40.0, 0])) and chain.valid.all()
    torch.testing.assert_close(chain.cov[0, 2], 0.05 * torch.eye(2))  # one track over four images
    torch.testing.assert_close(chain.cov[0, 1], (0.03 + 0.02 + 0.02) * torch.eye(2))  # registered in 2, then two hops
    torch.testing.assert_close(chain.error[0], torch.tensor([0.1, 0.3, 0.1]))
    torch.testing.assert_close(chain.photometric[0], torch.tensor([4.1, 4.2, 4.1]))  # of a registration or a hop


def test_a_wrong_hop_is_put_right_or_removed():
    wrong = torch.tensor([[0.0, 0.0], [7.0, 0.0], [1.5, 0.0]])
    track = partial(through, numbered(4), UV, between=2)
    put_right = track(stand_in(hop_shift={(1, 2): wrong}))
    assert put_right.valid.tolist() == [[True, False, True]]
    assert torch.equal(put_right.uv_1[0, 2], UV[0, 2] + torch.tensor([30.0, 0]))
    unregistered = track(stand_in(hop_shift={(2, 3): wrong}, unregistered=(2, 3)))
    assert unregistered.valid.tolist() == [[True, False, True]]
    on_the_hops_alone = track(stand_in(hop_shift={(1, 2): wrong}), register=False)
    assert on_the_hops_alone.valid.tolist() == [[True, False, True]]
    torch.testing.assert_close(on_the_hops_alone.error[0], torch.tensor([0.3, 7.0, 1.5]))
    assert track(stand_in(hop_shift={(1, 2): wrong}), max_round_trip_px=8.0, max_drift_px=8.0).valid.all()
    assert track(stand_in(hop_shift={(1, 2): wrong}), register=False, max_round_trip_px=8.0).valid.all()


def test_a_way_back_that_is_lost_is_no_way_back():
    chain = through(numbered(4), UV.flip(1), stand_in(lost=((2, 1),)), between=2, register=False)
    assert chain.valid.tolist() == [[False, True, True]]
    torch.testing.assert_close(chain.error[0], torch.tensor([0.3, 0.3, 0.3]))


def test_a_lost_point_is_tracked_directly_at_the_end_only():
    calls = []
    chain = through(numbered(5), UV, stand_in(calls, lost=((1, 2),)), between=3)
    assert chain.valid.all() and torch.equal(chain.uv_1, UV + torch.tensor([40.0, 0]))
    torch.testing.assert_close(chain.cov[0, 0], 0.05 * torch.eye(2))
    registrations = [call for call in calls if call[3].start is not None]
    assert [call[:2] for call in registrations] == [(0, 2), (0, 3), (0, 4)]
    assert (registrations[1][2][0, 0] < -1).all() and torch.equal(registrations[2][2], UV)
    assert registrations[2][3].start[0, 0].isnan().all() and registrations[2][3].start[0, 1:].isfinite().all()
    lost = through(numbered(5), UV, stand_in(lost=((1, 2), (0, 4))), between=3)
    assert lost.valid.tolist() == [[False, True, True]]
    assert not through(numbered(5), UV, stand_in(lost=((1, 2),)), between=3, register=False).valid[0, 0]


def test_hops_have_a_tracker_of_their_own():
    hops, searches = [], []
    through(numbered(4), UV, stand_in(searches, unregistered=(3,)), hop=stand_in(hops), between=2)
    assert [call[:2] for call in searches] == [(0, 1), (0, 2), (0, 3)]
    assert [call[:2] for call in hops] == [(1, 2), (2, 3), (3, 2), (2, 1), (1, 0)]
    assert (hops[2][2][0, [0, 2]] < -1).all() and (hops[2][2][0, 1] > 0).all()  # only who is not registered goes back


def test_the_hints_levels_and_options_reach_the_tracker():
    calls, options = [], []

    def track(*args, hint, **given):
        options.append(given)
        return stand_in(calls)(*args, hint=hint)

    hint = TrackHint(between=numbered(4)[1:-1], levels=3)
    track_chain(*numbered(4)[::3], UV, track=track, hint=hint, window=9)
    assert {call[3].levels for call in calls} == {3} and all(given == {"window": 9} for given in options)
    assert all(call[3].pyramid.image[0, 0, 0, 0] == call[0] for call in calls)


def test_images_are_thinned_evenly():
    assert frames_between(0, 20, 4) == [4, 8, 12, 16] and frames_between(20, 0, 4) == [16, 12, 8, 4]
    assert frames_between(3, 6, 4) == [4, 5] and frames_between(3, 4, 4) == frames_between(3, 9, 0) == []
    calls = []
    through(numbered(11), UV, stand_in(calls), between=4)
    assert [call[1] for call in calls if call[0] == 0 and call[3].start is not None] == [4, 6, 8, 10]
    assert calls[0][:2] == (0, 2)


def test_how_many_images_a_tracker_uses():
    assert [images_used(method.track) for method in (PAPER, KORNIA, PAPER_DIRECT, MAP)] == [4, 4, 0, 0]
    assert images_used(PAPER.replace(track={"between": 7}).track) == 7
    assert images_used(track_chain) == 4 and images_used(partial(lucas_kanade, levels=3)) == 0


def test_wrong_arguments():
    images, uv = sequence(3), points()
    with pytest.raises(ValueError, match="between is -1, expected at least 0"):
        through(images, uv, between=-1)
    with pytest.raises(ValueError, match="image has shape"):
        through([images[0], images[1].expand(2, -1, -1, -1), images[2]], uv)


# --- gradients, batches ----------------------------------------------------------------------------------------------
