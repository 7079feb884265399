"""On an accelerator: the CPU's answers within stated limits, and no stage for which the host waits.

Tests marked ``cuda`` need a device. The others run everywhere, on a pretended one
(:mod:`tests.support.pretend_device`).
"""

from functools import cache

import pytest
import torch
from torch.utils.data import default_collate

from dhtorch import pytree
from dhtorch.geometry import checks, determinism
from dhtorch.metrics import holdout
from dhtorch.pipeline.completion import complete_depth
from dhtorch.pipeline.presets import AUTO, METHODS
from dhtorch.transforms.extend_depth import ExtendDepth
from tests.support import sample_dicts
from tests.support.pretend_device import OnDevice, PretendDevice
from tests.support.rooms import room

#: Most samples or pixels with another gate, and most change of the median depth in sigmas: those of compiled operators.
MAX_FLIPS, MAX_CHANGE = 0.005, 0.1

N = 512

#: Different reference views of a batch.
DISTINCT = 3


@cache
def views(batch, hw=(120, 160)):
    """A reference view and its neighbours, ``batch`` of each, which repeat after ``DISTINCT``."""
    recording = room(hw=hw)
    near = [holdout.range_split(recording[k], 2.0) for k in range(11)]
    at = [[b % DISTINCT + gap for b in range(batch)] for gap in (0, 6, 7, 8)]
    reference, *others = (pytree.collate([near[k] for k in column]) for column in at)
    return reference, others


def answer(name, reference, others):
    """The answers by a method of pairs or of several views, or the depth map ``complete``."""
    if name == "complete":
        return complete_depth(reference, others, method=AUTO.replace(n=256), planes=16)
    method = METHODS[name].replace(n=N)
    return method(reference, others if method.views > 1 else others[0])


def assert_alike(there, here):
    """Whether the device's answers are the CPU's within the limits."""
    flips = (there.gate != here.gate).double().mean()
    both = (there.keep & here.keep).nonzero(as_tuple=True)
    assert len(both[0]) > 0.3 * here.keep.sum() > 10
    change = ((there.depth - here.depth).abs() / here.sigma)[both]
    ratio = (there.sigma / here.sigma)[both]
    assert flips <= MAX_FLIPS and change.median() <= MAX_CHANGE
    assert 0.99 < ratio.median() < 1.01


# ---------------------------------------------------------------------------------------------------- everywhere


@pytest.mark.slow
@pytest.mark.parametrize("name", ["map", "paper", "auto", "fused", "complete"])
def test_no_stage_makes_the_host_wait(name):
    """From the second call on, when constants lie on the device, and with nothing that mixes devices."""
    torch.manual_seed(0)
    reference, others = views(1)
    with torch.no_grad():
        here = answer(name, reference, others[:2])
        with PretendDevice() as device:
            moved = reference.map(OnDevice), [x.map(OnDevice) for x in others[:2]]
            answer(name, *moved)
            device.waits.clear()
            there = answer(name, *moved).map(lambda x: x.held)
    checks._kept.cache_clear()
    assert not device.waits
    assert_alike(there, here)


def test_a_constant_is_kept_beside_an_accelerator_and_made_anew_on_the_cpu():
    x = torch.zeros(2, dtype=torch.float64)
    assert torch.equal(checks.constant(x, [[1, 2.5]]), torch.tensor([[1, 2.5]], dtype=torch.float64))
    assert checks.constant(x, [1.0]) is not checks.constant(x, [1.0])
    with PretendDevice():
        there = OnDevice(x)
        assert checks.constant(there, [1.0]) is checks.constant(there, [1.0])
        assert checks.move_from_host(x, there).device == there.device
        assert determinism.chunk_size(256, there) == determinism.ACCELERATOR_CHUNKS * determinism.chunk_size(256, x)
    checks._kept.cache_clear()


# ---------------------------------------------------------------------------------------------------- on a device


@pytest.fixture
def device():
    """A CUDA device with the precision of float32."""
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    before = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    yield torch.device("cuda")
    torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = before


@pytest.mark.cuda
@pytest.mark.parametrize("batch", [1, 8, 64])
@pytest.mark.parametrize("name", ["paper", "kornia", "map", "auto", "fused", "complete"])
def test_answers_are_the_cpus(device, name, batch):
    reference, others = views(batch)
    with torch.no_grad():
        here = answer(name, *views(min(batch, DISTINCT)))[torch.arange(batch) % DISTINCT]  # it depends on no batch mate
        there = answer(name, reference.to(device), [x.to(device) for x in others])
    assert there.depth.device.type == "cuda"
    assert_alike(there.to("cpu"), here)


@pytest.mark.cuda
@pytest.mark.parametrize("name", ["paper", "map", "auto", "fused", "complete"])
def test_no_stage_waits_for_the_device(device, name):
    """torch raises where the host would wait."""
    reference, others = views(2)
    reference, others = reference.to(device), [x.to(device) for x in others]
    with torch.no_grad():
        answer(name, reference, others)
        torch.cuda.set_sync_debug_mode("error")
        try:
            answer(name, reference, others)
        finally:
            torch.cuda.set_sync_debug_mode("default")


@pytest.mark.cuda
@pytest.mark.parametrize("batch", [1, 8, 64])
@pytest.mark.parametrize("options", [{}, {"method": "map"}, {"dense": {"planes": 16}}], ids=["paper", "map", "dense"])
def test_the_transform_adds_the_cpus_columns(device, batch, options):
    items = sample_dicts.frames()
    pairs = [{**items[6 + k % DISTINCT], "before": items[k % DISTINCT]["image"]} for k in range(batch)]
    sample = default_collate([{k: v for k, v in pair.items() if k != "task"} for pair in pairs])
    distinct, again = default_collate(pairs[:DISTINCT]), torch.arange(batch) % DISTINCT
    transform = ExtendDepth(depth_unit="mm", other_image="before", n=256, batched=True, **options)
    here = {k: v[again] for k, v in transform(distinct).items() if torch.is_tensor(v)}
    there = transform({k: v.to(device) for k, v in sample.items()})
    assert all(there[k].is_cuda for k in here if k.startswith(transform.prefix))
    valid, depth = (transform.prefix + k for k in ("valid", "depth"))
    one, other = here[valid], there[valid].cpu()
    assert (one != other).double().mean() <= 2 * MAX_FLIPS
    a, b = here[depth][one & other], there[depth].cpu()[one & other]
    assert ((a - b).abs() / a).median() < 1e-3


@pytest.mark.cuda
@pytest.mark.parametrize("name", ["paper", "map", "auto"])
def test_gradients_are_the_cpus(device, name):
    reference, others = views(2)

    def gradient(where):
        image = (reference.image.float() / 255).to(where).requires_grad_()
        moved = [x.to(where) for x in others]
        moved = [x.replace(image=x.image.float() / 255) for x in moved]
        estimate = answer(name, reference.to(where).replace(image=image), moved)
        torch.where(estimate.keep, estimate.depth, 0.0).sum().backward()
        return image.grad.cpu()

    here, there = gradient("cpu"), gradient(device)
    assert here.abs().sum() > 0 and there.isfinite().all()
    assert torch.cosine_similarity(here.flatten(), there.flatten(), dim=0) > 0.9
