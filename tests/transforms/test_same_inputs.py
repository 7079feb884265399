"""One table of dtypes, channels and ranges: the same answer or the same message of Frame, Method and ExtendDepth."""

import pytest
import torch

from dhtorch import PAPER, Frame
from dhtorch.codes import Source
from dhtorch.geometry.camera import Camera
from dhtorch.pipeline.completion import complete_depth
from dhtorch.synthetic import SyntheticRoom
from dhtorch.transforms import ExtendDepth

WHOLE = "expected uint8, or floating point in [0, 1]"
CHANNELS = "1 or 3"
RANGE = "expected [0, 1] (of [0, 255]: image / 255)"
METRES = "expected floating point, m"
N = 64

#: Image of bytes (3, H, W) and depth (h, w) in m -> the same in another dtype, and what is said of it; None = an answer.
IMAGES = {
    "uint8": (lambda x: x, None),
    "float32": (lambda x: x.float() / 255, None),
    "float64": (lambda x: x.double() / 255, None),
    "float16": (lambda x: (x.float() / 255).half(), None),
    "bfloat16": (lambda x: (x.float() / 255).bfloat16(), None),
    "grey": (lambda x: x[:1], None),
    "grey floats": (lambda x: x[:1].float() / 255, None),
    "int64": (lambda x: x.long(), f"int64, {WHOLE}"),
    "int32": (lambda x: x.int(), f"int32, {WHOLE}"),
    "int16": (lambda x: x.short(), f"int16, {WHOLE}"),
    "uint16": (lambda x: x.to(torch.uint16), f"uint16, {WHOLE}"),
    "int8": (lambda x: (x // 2).to(torch.int8), f"int8, {WHOLE}"),
    "bool": (lambda x: x > 99, f"bool, {WHOLE}"),
    "RGBA": (lambda x: torch.cat((x, x[:1])), CHANNELS),
    "two channels": (lambda x: x[:2], CHANNELS),
    "RGBA of floats": (lambda x: torch.cat((x, x[:1])).float() / 255, CHANNELS),
    "0 to 255": (lambda x: x.float(), RANGE),
    "0 to 65535": (lambda x: 257.0 * x.float(), RANGE),
}
DEPTHS = {
    "float32": (lambda z: z, None),
    "float64": (lambda z: z.double(), None),
    "float16": (lambda z: z.half(), None),
    "uint16": (lambda z: (1000 * z).round().int().to(torch.uint16), f"uint16, {METRES}"),
    "int16": (lambda z: (1000 * z).round().short(), f"int16, {METRES}"),
    "int32": (lambda z: (1000 * z).round().int(), f"int32, {METRES}"),
    "int64": (lambda z: (1000 * z).round().long(), f"int64, {METRES}"),
    "uint8": (lambda z: z.round().to(torch.uint8), f"uint8, {METRES}"),
}
TABLE = [("image", *row) for row in IMAGES.items()] + [("depth", *row) for row in DEPTHS.items()]


@pytest.fixture(scope="module")
def pair():
    """Two views of the room: images (3, H, W) uint8, depth (h, w) m, intrinsics."""
    room = SyntheticRoom(n_frames=7, hw=(96, 128), depth_hw=(96, 128), lidar="exact", supersample=1)
    frames = room[0], room[6]
    images = [x if x.dtype == torch.uint8 else (255 * x).round().to(torch.uint8) for x in (f.image[0] for f in frames)]
    camera = frames[0].camera
    return *images, frames[0].depth[0], torch.cat((camera.f[0], camera.c[0]))


def by_frames(run):
    """Run of two Frames, with cameras of float32, for the values of a pair."""

    def ask(first, second, depth, numbers):
        camera = Camera(numbers[None, :2], numbers[None, 2:])
        return run(Frame(first[None], depth[None], camera), Frame(second[None], depth[None], camera)).depth

    return ask


def by_transform(first, second, depth, numbers, unit="m"):
    sample = {"image": first, "before": second, "depth": depth, "intrinsics": numbers.numpy()}
    out = ExtendDepth(method="paper", n=N, other_image="before", depth_unit=unit, layout="chw")(sample)
    assert (out["dhtorch.source"] != Source.NONE).any()
    return out["dhtorch.depth"]


ASK = {
    "method": by_frames(PAPER.replace(n=N)),
    "frame": by_frames(lambda a, b: complete_depth(a, [b], method=PAPER.replace(n=N), planes=16)),
    "transform": by_transform,
}


@pytest.mark.parametrize("ask", ASK)
@pytest.mark.parametrize(("field", "name", "row"), TABLE, ids=lambda x: x if isinstance(x, str) else "")
def test_the_same_answer_or_message(pair, field, name, row, ask):
    change, message = row
    first, second, depth, numbers = pair
    values = (change(first), change(second), depth) if field == "image" else (first, second, change(depth))
    if message is None:
        depth = ASK[ask](*values, numbers)
        assert depth.is_floating_point() and bool((depth.nan_to_num() > 0).any())
        return
    with pytest.raises(ValueError) as refused:
        ASK[ask](*values, numbers)
    text = str(refused.value)
    assert message in text and field in text and "\n" not in text, text


def test_whole_numbers_of_a_stated_unit_are_read_alike(pair):
    """Depth in mm of any integer dtype, with its unit, is that in metres; the method requires metres."""
    first, second, depth, numbers = pair
    mm = (1000 * depth).round().int()
    kinds = (torch.uint16, torch.int16, torch.int32, torch.int64, torch.float32)
    answers = [by_transform(first, second, mm.to(kind), numbers, "mm") for kind in kinds]
    assert all(torch.equal(x, answers[0]) for x in answers)
