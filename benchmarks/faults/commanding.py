"""Commands: options, what is written beside the maps, numbers on pages."""

NUMBERS = ["tests/cli/test_numbers.py"]

TESTS: dict[str, list[str]] = {
    f"cli.{name}": NUMBERS
    for name in (
        "align",
        "capture_checks",
        "complete",
        "completed_folder",
        "enrich",
        "enrich_page",
        "errors",
        "fetch",
        "inspect",
        "layouts",
        "option_checks",
        "pin",
        "process_capture",
        "recover_page",
        "recover_pictures",
        "scale",
        "stream",
        "sweep_state",
        "validate",
        "view",
    )
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "cli.align": [
        ("_summarise_frame", "aligned.depth / x", "x / aligned.depth"),
        ("_summarise_frame", "(ratio - 1).abs()", "ratio.abs()"),
        ("_summarise_frame", "aligned.sigma / aligned.depth", "aligned.sigma"),
        ("_summarise_frame", "float(selection.weight[0, best])", "float(selection.weight[0, likeliest])"),
        ("_masked_share", "part & whole", "part | whole"),
        ("_summarise_recording", "1 - len(answered) / len(alignments)", "len(answered) / len(alignments)"),
        (
            "_summarise_recording",
            'for row in alignments),\n        "unaligned"',
            'for row in answered),\n        "unaligned"',
        ),
        ("_summarise_recording", 'abs(medians["scale"] - 1)', 'medians["scale"] - 1'),
        ("_severity", "1.0 if row", "0.0 if row"),
    ],
    "cli.capture_checks": [
        ("_count_without_depth", ".any()", ".all()"),
    ],
    "cli.complete": [
        ("_solved_motions", "bool(fit.ok[0])", "True"),
        ("_solved_motions", "zip(views, fits, strict=False)", "zip(views[::-1], fits, strict=False)"),
        ("_count_pixels", "share and name", "name"),
        ("_count_pixels", "depth_map.gate == code", "depth_map.gate >= code"),
        ("resize_picture", "* 255", "* 256"),
        ("resize_picture", 'mode="area"', 'mode="nearest"'),
    ],
    "cli.completed_folder": [("count_pixels", ".get(name.lower(), 0)", ".get(name, 0)")],
    "cli.enrich": [
        ("_KEY_OPTIONS", '"pose_sigma",', ""),
        ("_KEY_OPTIONS", ', "on_error", "sensor"', ', "on_error"'),
        ("_KEY_OPTIONS", '"maps", ', ""),
        ("_KEY_OPTIONS", '"causal", ', ""),
        ("_build_metadata", '"name": name, "files"', '"files"'),
        ("_pose_options", '"pose_cov": settings["pose_sigma"]', '"pose_cov": None'),
        ("_pose_options", 'settings["pose"] == "start"', 'settings["pose"] != "near"'),
        (
            "_group_shards",
            "spans[n].start <= p.rows.start < spans[n].stop",
            "spans[n].start <= p.rows.start <= spans[n].stop",
        ),
        ("_group_by_episode", "groups.setdefault(number, [])", "groups.setdefault(n, [])"),
    ],
    "cli.enrich_page": [
        ("_pixel_shares", "if share >= _MIN_REASON_SHARE", "if share >= 0.1"),
        ("_pixel_shares", "key=lambda x: -x[1]", "key=lambda x: x[1]"),
        ("summarise_cameras", 'own["cameras"][name] for own in owns if', 'own["cameras"][name] for own in owns[:1] if'),
        ("_average_over_episodes", "np.linspace(0, 1, len(x)), x[:, c]", "np.linspace(0, 1, len(x)), x[:, 0]"),
        ("_average_over_episodes", "np.mean(resampled, 0)", "np.sum(resampled, 0)"),
    ],
    "cli.errors": [("format_error", "isinstance(error, KeyError) and", "False and")],
    "cli.fetch": [
        ("_cut", "int(last) + 1", "int(last)"),
        ("_cut", 'line.startswith(b"#") or ', ""),
    ],
    "cli.inspect": [
        ("_extent", "half_width * hw[0] / hw[1]", "half_width * hw[1] / hw[0]"),
        ("_nearest_per_block", "-depth, -torch.inf", "depth, -torch.inf"),
        ("_depth_limits", "low + 1e-3", "low"),
    ],
    "cli.layouts": [
        ("Layout.sigma_unit", "self.unit / SIGMA_STEPS_PER_DEPTH_STEP", "self.unit"),
        ("Layout.reach", "self.unit * MAX_DEPTH_CODE", "MAX_DEPTH_CODE"),
        ("Layout.stem", "recording.number[i]", "i"),
        ("Layout.stem", "recording.times[i]", "recording.times[0]"),
        ("has_varying_camera", "any(", "all("),
        ("_frame_rate", "recording.number.double() / rate", "recording.number.double() * rate"),
        ("_find_lack", 'name == "tum" and not same', 'name == "tum" and same'),
    ],
    "cli.option_checks": [
        ("_whole_number", "v >= low", "v > low"),
        ("_above_zero", "v > 0", "v >= 0"),
        ("_or_null", "is None", "is not None"),
    ],
    "cli.pin": [
        ("_spread", "k * n // wanted", "k * n // wanted + 1"),
        ("Episode.verdict", "2 * counts[PinVerdict.CANNOT_KNOW]", "3 * counts[PinVerdict.CANNOT_KNOW]"),
        ("Episode.verdict", "if self.changes:", "if not self.changes:"),
    ],
    "cli.process_capture": [
        ("order_evenly", "[::-1]", ""),
        ("order_evenly", "[n // 2, 0, n - 1, *sequence]", "[0, n // 2, n - 1, *sequence]"),
        ("_choose_cutoff", "math.ceil(", "math.floor("),
    ],
    "cli.recover_page": [
        ("measure_recovery", "(2, 98)", "(20, 80)"),
        ("measure_recovery", "sum(n.values()) for n in counts", "sum(counts[0].values()) for n in counts"),
        ("measure_recovery", "/ len(counts)", ""),
        ("measure_median_return", "float(np.median(returns))", "float(np.mean(returns))"),
        ("_average_no_answer_shares", "share / len(rows)", "share"),
    ],
    "cli.recover_pictures": [("_pick_evenly", "(k + 0.5)", "k")],
    "cli.scale": [
        ("_regions", "/ np.sqrt(len(log))", ""),
        ("_regions", "np.expm1(np.median(log))", "np.median(log)"),
        ("_regions", "- np.log(result.scale)", ""),
        ("_distinct", "first.setdefault(fault.kind, fault)", "first[fault.kind] = fault"),
    ],
    "cli.stream": [
        ("stream_scene", 'trace["back"][:, 0]', 'trace["back"][:1, 0]'),
        ("stream_scene", 'sorted(trace["back"][:, 0].tolist())', "sorted(stream.steps)"),
        ("stream_scene", "estimate.keep & hole", "estimate.keep"),
        ("stream_scene", "len(stream.cuts) > cuts", "len(stream.cuts) > 0"),
        ("stream_scene", "n / seconds", "seconds / n"),
        ("stream_scene", "int(recording.number[k])", "k"),
    ],
    "cli.sweep_state": [
        ("record_progress", "n_finished + (k + 1) / max(total, 1)", "(k + 1) / max(total, 1)"),
        ("_read_progress", "s >= 1 for s", "s > 0 for s"),
    ],
    "cli.validate": [
        ("list_exceeded_limits", "value > limit", "value >= limit"),
        ("list_exceeded_limits", "value is not None and ", ""),
        ("_summarise_frame", "(validation.state == code) & has_depth", "validation.state == code"),
        ("_summarise_frame", "evidence.abs() > 3", "evidence > 3"),
        ("_summarise_frame", "has_depth & (validation.state == State.WRONG)", "validation.state == State.WRONG"),
        ("_severity", "-1.0", "1.0"),
        ("RecordingValidation.frame_positions", "[::every]", ""),
    ],
    "cli.view": [("_select_item", "items[names.index(str(wanted))]", "items[0]")],
}
