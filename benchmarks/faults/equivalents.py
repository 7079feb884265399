"""Changes that the rules of ``mutants.py --sweep`` draw and that change no answer, with the reason."""

# ruff: noqa: E501  (lines of other files)

#: (module, function, text, text that takes its place) → reason.
EQUIVALENT: dict[tuple[str, str, str, str], str] = {
    (
        "stages.kornia.pose",
        "_search",
        "order = (~usable).to(torch.uint8).argsort(stable=True, dim=-1)  # usable points first",
        "order = (~usable).to(torch.uint8).argsort(stable=True)  # usable points first",
    ): "the last axis is the default of argsort",
    (
        "geometry.plane_sweep",
        "sample_bilinear",
        '@operator(kernel=_sample_bilinear_kernel, dtypes={"image": torch.float32, "uv": torch.float32}, any_layout=("uv",))',
        '@operator(kernel=_sample_bilinear_kernel, dtypes={"image": torch.float32, "uv": torch.float32})',
    ): "torch computes the same where the kernel does not run",
    (
        "viz.plots.canvas",
        "Canvas.axes",
        "axes = self.figure.add_axes((0, 0, 1, 1), zorder=1e6)",
        "axes = self.figure.add_axes((0, 0, 1, 1), zorder=2000000.0)",
    ): "above all other artists at either value",
    (
        "stages.track",
        "refine_tracks",
        "source = build_pyramid(image_0, 1, window)",
        "source = build_pyramid(image_0, 2, window)",
    ): "one step on the finest level reads no other",
    (
        "stages.backproject",
        "_appearance",
        "bands = zip(*(doubts_of(*brightness) for brightness in _whole_brightness(image, size)), strict=True)",
        "bands = zip(*(doubts_of(*brightness) for brightness in _whole_brightness(image, size)), strict=False)",
    ): "the sequences are of one length",
    (
        "geometry.plane_sweep",
        "_second_best",
        "plane_index = torch.arange(costs.shape[-1], dtype=torch.int16, device=costs.device)",
        "plane_index = torch.arange(costs.shape[-1], device=costs.device)",
    ): "the same whole numbers in a wider type",
    (
        "stages.track",
        "refine_tracks",
        "o = lk.SearchOptions(window, 1, 0.0, min_eigenvalue, normalise)",
        "o = lk.SearchOptions(window, 2, 0.0, min_eigenvalue, normalise)",
    ): "one step reads no number of iterations",
    (
        "experiments.compare_methods",
        "cut_to_equal_coverage",
        "cut_theirs[scene] = [risk.keep_surest(b, n) for (_, b), n in zip(pairs, sizes, strict=True)]",
        "cut_theirs[scene] = [risk.keep_surest(b, n) for (_, b), n in zip(pairs, sizes, strict=False)]",
    ): "the sequences are of one length",
    (
        "geometry.se3",
        "log",
        "square = torch.where(small[..., None], (1 + theta2 / 60 * (1 + theta2 / 42)) / 12, whole)",
        "square = torch.where(small[..., None], (1 + theta2 / 60 * (1 + theta2 / 43)) / 12, whole)",
    ): "of angles below a hundredth it is the fourteenth digit",
    (
        "geometry.camera",
        "warp",
        "p2, p1 = (q * distortion[:, None, [3, 2]]).sum(-1).unbind(-1)",
        "p2, p1 = (q * distortion[:, None, [3, 2]]).sum(-1).unbind( 1)",
    ): "the last axis of two",
    (
        "data.readers.sun3d",
        "read",
        'stated = (image_table.read_K(file), file, "K") if file.is_file() else None',
        "stated = (image_table.read_K(file), file) if file.is_file() else None",
    ): "K is the default name of the field",
    (
        "data.codecs.parquet",
        "_open_table",
        "if min(counts, default=0) < 0 or sum(counts) != meta.num_rows or meta.num_rows > _MAX_ROWS:",
        "if min(counts, default=1) < 0 or sum(counts) != meta.num_rows or meta.num_rows > _MAX_ROWS:",
    ): "neither is below zero",
    (
        "geometry.lucas_kanade",
        "_search_level",
        "for radius, steps in zip(radii[1:], further, strict=True):",
        "for radius, steps in zip(radii[1:], further, strict=False):",
    ): "the sequences are of one length",
    (
        "stages.track",
        "_levels_for_flow",
        "cell_px = max(n / cells for n, cells in zip(hw, flow.support.shape[1:], strict=True))",
        "cell_px = max(n / cells for n, cells in zip(hw, flow.support.shape[1:], strict=False))",
    ): "the sequences are of one length",
}
