"""Data sets with depth beside every picture."""

WHOLE = [
    "tests/extract/test_written_rows.py",
    "tests/cli/test_enrich.py",
    "tests/extract/test_enrich_guarantees.py",
]

TESTS: dict[str, list[str]] = {
    f"extract.{name}": WHOLE
    for name in (
        "cut",
        "enriched",
        "instants",
        "nerf_target",
        "origin",
        "pixel_columns",
        "robot_target",
        "step_set",
        "targets",
    )
} | {"extract.policy_columns": ["tests/extract/test_policy_columns.py"]}

FAULTS: dict[str, list[tuple[str, ...]]] = {
    "extract.cut": [
        ("subsample_scenes", "scenes if every == 1 and max_frames is None else", "scenes if every == 1 else"),
        ("subsample_recording", "recording.number[part]", "recording.number"),
    ],
    "extract.enriched": [
        ("MAP_STEPS", "8", "4"),
        ("camera_feature", '.replace("/", "_")', ""),
        ("MapRowDataset.features", "if reference.hw != view.hw:", "if False:"),
        ("MapRowDataset.features", "if get_distortion(reference) != view.lens:", "if False:"),
        ("MapRowDataset.features", "reason[source == Source.NONE]", "reason[source != Source.NONE]"),
        ("MapRowDataset.features", "self.step / MAP_STEPS.get(name, 1)", "self.step"),
        ("_refuted_code", "1 + convention if", "convention if"),
        ("_quantise", ".clip(1)", ""),
        ("_compute_moments", "(depth, sigma)", "(sigma, depth)"),
        ("MapRowDataset.features", "poses[i : i + 1]", "poses[max(i - 1, 0) : max(i, 1)]"),
    ],
    "extract.instants": [
        ("PeekableRows.take", 'row["frame_index"] != frame', 'row["frame_index"] > frame'),
        ("iter_instants", 'rows.row["frame_index"] < latest', 'rows.row["frame_index"] <= latest'),
        ("iter_groups", "if group:\n        yield group", "pass"),
    ],
    "extract.nerf_target": [
        ("NerfstudioTarget.own", 'summary["key"] != self.key', "False"),
        ("NerfstudioTarget.assemble", 'row["depth"] and np.isfinite(row["pose"]).all()', 'row["depth"]'),
        ("_write_shot", "np.where(steps > 0, depth, 0)", "depth"),
        ("_write_shot", "K, pose, view.lens, row", "K, pose, (), row"),
    ],
    "extract.origin": [
        ("LeRobotSource.splits", "int(first) <= k < int(last)", "int(first) <= k <= int(last)"),
        ("LeRobotSource.features", "if k not in missing", "if k"),
        ("LeRobotSource.clips", "length / self.meta.fps", "length"),
        ("LeRobotSource._scan", "part.slice(0, self.limit - done)", "part"),
        ("LeRobotSource.more", "and p.name not in _REWRITTEN_META_FILES", ""),
        ("_with_frame_index", "done + np.arange(len(stamp))", "np.arange(len(stamp))"),
        ("frame_rate", "recording.times.diff() / recording.number.diff()", "recording.times.diff()"),
    ],
    "extract.policy_columns": [
        ("encode_geometry", "(2 * np.arange(n) + 1) * m // (2 * n)", "(2 * np.arange(n) + 1) * m // (2 * n) - 1"),
        ("encode_geometry", "v[:, None], u", "v[:, None], u[::-1]"),
        ("sample_cloud", "view.hw, view.map_hw", "view.map_hw, view.hw"),
        ("PolicyColumnWriter.add", "self.append(picture, time)", "self.append(picture, times[0])"),
        ("make_modality", '**modality.get("video", {}), **added', "**added"),
        ("_default_modality", '("action", "action")', '("action", "observation.state")'),
    ],
    "extract.robot_target": [
        ("LeRobotTarget.own", 'summary["key"] == self.key', "True"),
        ("LeRobotTarget.assemble", 'sum(each["length"] for each in before)', "0"),
        ("LeRobotTarget._join_rows", "start + done)", "start)"),
        ("LeRobotTarget._recording_rows", "done += len(kept)", "pass"),
        ("LeRobotTarget._renumber", "table.append_column(kept, table.column(name))", "table"),
        ("LeRobotTarget._summary", "list(tasks) if episode_tasks is None else episode_tasks", "list(tasks)"),
        ("LeRobotTarget._splits", "{indices[-1] + 1}", "{indices[-1]}"),
        ("LeRobotTarget._write_lenses", "if view.lens", ""),
        ("LeRobotTarget._recording_rows", "start + index,", "index,"),
        ("LeRobotTarget._recording_rows", "start + index,", "start + np.arange(len(kept)),"),
        ("LeRobotTarget._recording_rows", "[shots[key] for shots in kept]", "[next(iter(x.values())) for x in kept]"),
        ("LeRobotTarget._recording_rows", "all(row[", "any(row["),
        ("LeRobotTarget._recording_rows", "(index / self.fps)", "(index * self.fps)"),
        ("LeRobotTarget._recording_rows", "np.full(len(kept), k)", "np.full(len(kept), 0)"),
    ],
    "extract.step_set": [
        ("RldsSource.batches", "at / self.fps", "at"),
        ("RldsSource.batches", "if text not in tasks]", "]"),
        ("RldsSource.batches", "at = np.array(part)", "at = np.arange(len(part))"),
        ("RldsSource.batches", "_read_cells(steps, name, part)", "_read_cells(steps, name, range(len(part)))"),
        ("RldsSource.batches", "tasks.index(text)", "texts.index(text)"),
        ("_read_cells", "size = values.shape[1]", "size = values.shape[0]"),
        ("_column_name", 'f"source.{column}" if column in _RESERVED_COLUMNS else column', "column"),
        ("_read_cells", "content[:2] == _JPEG", "content[:2] != _JPEG"),
    ],
    "extract.targets": [
        ("MapCounts.summary", "max(1, pixels[at].sum())", "1"),
        ("MapCounts.summary", "pixels.sum(0)", "pixels[0]"),
        ("MapCounts.map_stats", "x[k : k + 1]", "x[1 - k : 2 - k]"),
        ("MapCounts.image_moments", "x[2:5]", "x[1:4]"),
    ],
    "extract.pixel_columns": [
        ("find_one_channel", ".channels == 1", ".channels == 3"),
        ("read_pixel_feature", "str(pixels.dtype)", '"uint16"'),
        ("colour_moments", "/ 255", "/ 256"),
    ],
}
