"""Survey of focal stacks for ``inspect``: facts, warnings and sample images."""

from __future__ import annotations

from dhtorch.data.survey import Survey, Tile, describe_camera, describe_pixels, report_depths, warn_of_duplicates
from dhtorch.experiments.focal.stacks import FocalStack, FocalStacks
from dhtorch.runtime.console import format_count


def survey_stacks(stacks: FocalStacks, shown: int = 8) -> Survey:
    """Facts, warnings and at most ``shown`` image tiles of focal stacks, from the first stack."""
    out = Survey(stacks.name, stacks.format)
    stack: FocalStack = stacks[0]
    images = stack.images[0]
    s, c, h, w = images.shape
    out.add_fact("focal stacks", f"{len(stacks)}, of {format_count(s, 'picture')} each")
    out.add_fact("pictures", f"{w}x{h}, {describe_pixels(c, images)}")
    if stack.focus_m is None:
        out.warn("no focus distances: only the order of the pictures is available")
    else:
        out.add_fact("in focus at", ", ".join(f"{x:.3g}" for x in stack.focus_m[0].tolist()) + " m")
    if stack.focal_length_m is not None and stack.f_number is not None:
        out.add_fact("lens", f"f = {1e3 * float(stack.focal_length_m):g} mm, N = {float(stack.f_number):g}")
    if stack.camera is not None:
        out.add_fact("intrinsics", describe_camera(stack.camera, (h, w)))
    if stack.depth is not None:
        report_depths([stack.depth[0]], out)
    warn_of_duplicates(list(images), out, "pictures")
    out.warnings.extend(stacks.report)
    for k in sorted({round(k * (s - 1) / max(shown - 1, 1)) for k in range(shown)}):
        out.tiles.append(Tile(f"picture {k + 1}", images[k]))
    if stack.depth is not None:
        out.tiles.append(Tile("truth", depth=stack.depth[0]))
    return out
