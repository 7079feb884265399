"""Data sets with depth beside every picture."""

WHOLE = ["tests/cli/test_enrich.py", "tests/extract/test_enrich_guarantees.py"]

TESTS: dict[str, list[str]] = {
    f"extract.{name}": WHOLE
    for name in ("cut", "enriched", "instants", "nerf_target", "origin", "robot_target", "step_set", "targets")
}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "extract.cut": [
        ("cut", "scenes if frames is None else", "scenes if frames else"),
        ("shorter", "number=recording.number[:frames]", "number=recording.number"),
    ],
    "extract.enriched": [
        ("SIGMA_STEPS", "8", "4"),
        ("camera_feature", '.replace("/", "_")', ""),
        ("MapRows.features", "if anchor.hw != view.hw:", "if False:"),
        ("MapRows.features", "if lens_of(anchor) != view.lens:", "if False:"),
        ("MapRows.features", "why[source == Source.NONE]", "why[source != Source.NONE]"),
        ("MapRows.features", "self.step / SIGMA_STEPS", "self.step"),
        ("_refuted", "1 + looks if", "looks if"),
        ("_stepped", ".clip(1)", ""),
        ("_moments", "(depth, sigma)", "(sigma, depth)"),
    ],
    "extract.instants": [
        ("Ahead.take", 'row["frame_index"] != frame', 'row["frame_index"] > frame'),
        ("together", 'rows.row["frame_index"] < latest', 'rows.row["frame_index"] <= latest'),
        ("groups", "if group:\n        yield group", "pass"),
    ],
    "extract.nerf_target": [
        ("NerfTarget.own", 'each["key"] != self.key', "False"),
        ("NerfTarget.assemble", 'row["depth"] and np.isfinite(row["pose"]).all()', 'row["depth"]'),
        ("_write_shot", "np.where(steps > 0, depth, 0)", "depth"),
    ],
    "extract.origin": [
        ("RobotSet.splits", "int(first) <= k < int(last)", "int(first) <= k <= int(last)"),
        ("RobotSet.features", "if k not in gone", "if k"),
        ("RobotSet.clips", "length / self.meta.fps", "length"),
        ("RobotSet.batches", "part.slice(0, self.limit - done)", "part"),
        ("RobotSet.more", "and p.name not in _META", ""),
        ("_numbered", "done + np.arange(len(stamp))", "np.arange(len(stamp))"),
        ("rate", "recording.times.diff() / recording.number.diff()", "recording.times.diff()"),
    ],
    "extract.robot_target": [
        ("RobotTarget.own", 'found["key"] == self.key', "True"),
        ("RobotTarget.assemble", 'sum(each["length"] for each in before)', "0"),
        ("RobotTarget._joined", "start + done)", "start)"),
        ("RobotTarget._plain", "done += len(kept)", "pass"),
        ("RobotTarget._renumbered", 'table.append_column(f"source.{name}", table.column(name))', "table"),
        ("RobotTarget._summary", "list(tasks) if said is None else said", "list(tasks)"),
        ("RobotTarget._splits", "{places[-1] + 1}", "{places[-1]}"),
        ("RobotTarget._write_lenses", "if view.lens", ""),
    ],
    "extract.step_set": [
        ("StepSet.batches", "at / self.fps", "at"),
        ("StepSet.batches", "if text not in tasks]", "]"),
        ("_column", 'f"source.{found}" if found in _TAKEN else found', "found"),
        ("_cells", "content[:2] == _JPEG", "content[:2] != _JPEG"),
    ],
    "extract.targets": [
        ("Tally.summary", "max(1, pixels[at].sum())", "1"),
        ("Tally.summary", "pixels.sum(0)", "pixels[0]"),
        ("Tally.of_maps", "slice(0, 1), slice(1, 2)", "slice(1, 2), slice(0, 1)"),
    ],
}
