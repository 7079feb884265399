"""Robot data of RH20T scenes: streams with their own time stamps, and poses of the camera on the hand.

Alphabet: ``E`` world → camera (the world is the calibration marker); ``T`` tool centre point (tcp) → robot base; ``X``
tcp → camera, constant for a camera on the hand. Poses in files are x y z qw qx qy qz, metres, scalar first.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dhtorch.data import convert
from dhtorch.data.codecs.pickles import read_npy
from dhtorch.data.io import decode as files

_HALF_TURN_ABOUT_X = np.diag([1.0, -1.0, -1.0, 1.0])


class RobotArm(NamedTuple):
    """Calibration of one of the seven robot set-ups, from the configuration file of the data set's tools."""

    robot: str
    in_hand: tuple[str, ...]  # serials of the cameras on the hand; X belongs to the first
    X: np.ndarray  # (4, 4)
    align_tcp: np.ndarray  # (4, 4) published tcp axes → the robot's own
    align_base: np.ndarray  # (4, 4) published base axes → the robot's own


def _make_arm(robot: str, in_hand: str, X: str, tcp: float = 0, base: float = 0) -> RobotArm:
    """``X``: quarter turns about z, then x y z; ``tcp``, ``base``: quarter turns about z."""
    turns, *t = map(float, X.split())
    matrix = _rotate_quarter_turns(turns)
    matrix[:3, 3] = t
    return RobotArm(robot, tuple(in_hand.split()), matrix, _rotate_quarter_turns(tcp), _rotate_quarter_turns(base))


def _rotate_quarter_turns(n: float) -> np.ndarray:
    matrix = np.eye(4)
    c, s = np.round([np.cos(n * np.pi / 2), np.sin(n * np.pi / 2)])
    matrix[:2, :2] = [[c, -s], [s, c]]
    return matrix


ROBOT_ARMS = {
    1: _make_arm("flexiv", "043322070878", "1 0 .077 .2665"),
    2: _make_arm("flexiv", "104422070042", "1 0 .077 .2915"),
    3: _make_arm("ur5", "045322071843", "0 .027 .0775 .240", tcp=1, base=2),
    4: _make_arm("ur5", "045322071843", "0 .027 .0775 .210", tcp=1, base=2),
    5: _make_arm("franka", "104422070042 135122079702", "3 .033 -.05 .09", tcp=2),
    6: _make_arm("kuka", "135122075425 135122070361", "1 .035 .055 .20"),
    7: _make_arm("kuka", "135122075425 135122070361", "1 .035 .055 .20"),
}


class RobotStream(NamedTuple):
    """One quantity with its own time stamps."""

    times: np.ndarray  # (m,) s, increasing
    values: np.ndarray  # (m, d) as stored
    pose: bool = False  # values are x y z qw qx qy qz

    def at(self, times: np.ndarray, max_gap: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
        """Values (n, d) interpolated at ``times`` (n,), and the mask (n,) of the times that the stream covers.

        Between two entries at most ``max_gap`` s apart: linear, rotations along the shortest arc at constant speed. The
        nearest entry where it is less than a millisecond away. Elsewhere the time is not covered and the value is that
        of the nearest entry.
        """
        after = np.searchsorted(self.times, times).clip(min(1, len(self.times) - 1), len(self.times) - 1)
        before = (after - 1).clip(0)
        a, b, span = self.values[before], self.values[after], self.times[after] - self.times[before]
        weight = ((times - self.times[before]) / np.where(span > 0, span, 1)).clip(0, 1)
        inside = (times >= self.times[0]) & (times <= self.times[-1]) & (span <= max_gap)
        weight = np.where(inside, weight, np.round(weight))
        values = a + weight[:, None] * (b - a)
        if self.pose:
            q_a, q_b = (x[:, 3:] / np.linalg.norm(x[:, 3:], axis=-1, keepdims=True) for x in (a, b))
            values[:, 3:] = convert.slerp(q_a, q_b, weight)
        is_near = np.minimum(np.abs(times - self.times[before]), np.abs(times - self.times[after])) < 1e-3
        return values, inside | is_near


#: File → fields of its entries that are streams → (name of the stream, length; None = as stored). Files whose names end
#: in ``_base`` hold values common to all cameras, others one list per camera.
_STREAM_FIELDS: dict[str, dict[str, tuple[str, int | None]]] = {
    "tcp": {"tcp": ("tcp", 7)},
    "tcp_base": {"tcp": ("tcp_base", 7), "robot_ft": ("robot_ft", None)},
    "force_torque": {"zeroed": ("force_torque", 6), "raw": ("force_torque_raw", 6)},
    "force_torque_base": {"zeroed": ("force_torque_base", 6), "raw": ("force_torque_base_raw", 6)},
}


def read_robot_streams(root: str | Path) -> dict[str, RobotStream]:
    """Read the robot's streams of one scene folder.

    Returns:
        ``read_tcp_in_base`` (m, 7) in the robot's base frame and ``tcp/<serial>`` (m, 7) in that camera's frame;
        ``force_torque_base`` and ``force_torque/<serial>`` (m, 6) of the sensor at the wrist with its zero subtracted,
        ``force_torque_base_raw`` and ``force_torque_raw/<serial>`` without; ``robot_ft``, the robot's own measurement;
        ``joint`` (m, d) rad, with velocities where the set-up has them; ``gripper_command`` and ``gripper_info``
        (m, d) as stored, element 0 the width, by its use in mm (unconfirmed). Entries of all cameras' clocks are
        merged, except in streams of one camera. Streams that a scene lacks are absent: in human
        demonstrations (``_human``) perhaps all (unconfirmed). ``high_freq_data`` is not read: its layout is
        undocumented.

    Raises:
        FormatError: a damaged file.
    """
    folder = Path(root) / "transformed"
    streams: dict[str, RobotStream] = {}
    for kind, fields in _STREAM_FIELDS.items():
        if (file := folder / f"{kind}.npy").is_file():
            for field, (name, width) in fields.items():
                streams |= _read_field_streams(file, field, name, width)
    if (file := folder / "joint.npy").is_file():
        streams["joint"] = _make_stream(file, _iter_stamped(file, None))
    if (file := folder / "gripper.npy").is_file():
        streams |= {part: _make_stream(file, _iter_stamped(file, part)) for part in ("gripper_command", "gripper_info")}
    return {name: stream for name, stream in streams.items() if len(stream.times)}


def read_tcp_in_base(root: Path) -> RobotStream:
    """Tcp poses in the base frame, merged over all cameras' clocks; entries that are zero or NaN are left out.

    Raises:
        FormatError: missing or damaged file.
    """
    return _read_field_streams(root / "transformed" / "tcp_base.npy", "tcp", "tcp_base", 7)["tcp_base"]


def hand_camera_poses(
    arm: RobotArm,
    serial_E: np.ndarray,  # (4, 4) of the camera, at calibration
    hand_E: np.ndarray,  # (4, 4) of the first camera on the hand, at calibration
    tcp_calibration: np.ndarray,  # (4, 4) T at calibration
    tcp: np.ndarray,  # (n, 7) published tcp in the base frame
    file: Path,
) -> np.ndarray:
    """Camera-to-world (n, 4, 4) of a camera on the hand while the tcp moves.

    Calibration with the marker gives E of every camera. From E of the first camera on the hand, X and T follows the
    pose of the base: E⁻¹ X T⁻¹ maps base to world. A camera on the hand is fixed relative to the tcp.
    """
    world_from_base = np.linalg.inv(hand_E) @ arm.X @ np.linalg.inv(tcp_calibration)
    cam_from_tcp = serial_E @ np.linalg.inv(hand_E) @ arm.X
    published = convert.to_c2w(tcp[:, [4, 5, 6, 3]], tcp[:, :3], file, "tcp")
    T = arm.align_base @ published @ np.linalg.inv(arm.align_tcp)
    return world_from_base @ T @ np.linalg.inv(cam_from_tcp)


def read_calibration_tcp(file: Path, arm: RobotArm) -> np.ndarray:
    """T (4, 4) at calibration, from ``tcp.npy`` of the calibration folder in the robot's own notation.

    Flexiv and UR5 store a quaternion; KUKA mm and Euler angles (about x, y, z in this order, fixed axes); Franka a
    rotation vector, with the tool's axis reversed.

    Raises:
        FormatError: missing or damaged file, or an unexpected number of values for this robot.
    """
    value = read_npy(file)
    size = {"flexiv": 7, "ur5": 7}.get(arm.robot, 6)
    pose = files.to_array(value, (size,), file, "tcp")
    if size == 7:
        return convert.to_c2w(pose[None, [4, 5, 6, 3]], pose[None, :3], file, "tcp")[0]
    turns = (
        [pose[3:]] if arm.robot == "franka" else [axis * angle for axis, angle in zip(np.eye(3), pose[3:], strict=True)]
    )
    T = np.eye(4)
    for q in convert.to_quaternions(np.stack(turns)):
        T = convert.to_c2w(q[None], np.zeros((1, 3)), file, "tcp")[0] @ T
    T[:3, 3] = pose[:3] if arm.robot == "franka" else pose[:3] / 1000
    return T @ _HALF_TURN_ABOUT_X if arm.robot == "franka" else T


def ms_to_seconds(value: Any, file: Path, field: str) -> float:
    """Unix milliseconds → s.

    Raises:
        FormatError: not a number, or a time outside 1970 to 2100.
    """
    # the year 2100
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 4_102_444_800_000:
        raise files.FormatError(
            file, field, value if isinstance(value, float) else type(value).__name__, "Unix milliseconds"
        )
    return value / 1000


# ---------------------------------------------------------------------------------------------------------- entries


def _make_stream(file: Path, entries: Iterator[tuple[float, np.ndarray]], pose: bool = False) -> RobotStream:
    """Stream of entries in any order; of several with one stamp the last."""
    merged = dict(entries)
    files.refuse_if(
        len({len(value) for value in merged.values()}) > 1, file, "entries", "vectors of several lengths", "one length"
    )
    times = np.array(sorted(merged), dtype=np.float64)
    return RobotStream(times, np.stack([merged[t] for t in times.tolist()]) if merged else np.zeros((0, 0)), pose)


def _read_field_streams(file: Path, field: str, name: str, width: int | None) -> dict[str, RobotStream]:
    """One field of all entries as one stream, or as one stream per camera."""
    by_camera = _check_mapping(read_npy(file), file, "content")
    joint = {name: list(by_camera.values())}
    groups = joint if file.stem.endswith("_base") else {f"{name}/{s}": [entries] for s, entries in by_camera.items()}
    pose = field == "tcp"
    return {key: _make_stream(file, _iter_entries(file, lists, field, width), pose) for key, lists in groups.items()}


def _iter_entries(file: Path, lists: list[Any], field: str, width: int | None) -> Iterator[tuple[float, np.ndarray]]:
    """(time in s, values) of the entries with the field; without non-finite values and zero poses."""
    for entries in lists:
        files.refuse_if(
            not isinstance(entries, list), file, "entries", type(entries).__name__, "a list for each camera"
        )
        for entry in entries:
            files.refuse_if(
                not isinstance(entry, dict) or "timestamp" not in entry,
                file,
                "entries",
                "something else",
                "objects with a timestamp",
            )
            time, value = ms_to_seconds(entry["timestamp"], file, "timestamp"), entry.get(field)
            if value is None:
                continue
            value = _parse_vector(value, file, field)
            files.refuse_if(width is not None and len(value) != width, file, field, f"{len(value)} numbers", width)
            if np.isfinite(value).all() and (field != "tcp" or np.linalg.norm(value[3:]) > 1e-6):
                yield time, value


def _iter_stamped(file: Path, part: str | None) -> Iterator[tuple[float, np.ndarray]]:
    """(time in s, values) of the entries, or of their field ``part``, of a dict serial → stamp → entry."""
    for serial, entries in _check_mapping(read_npy(file), file, "content").items():
        for stamp, entry in _check_mapping(entries, file, serial, texts=False).items():
            value = entry.get(part) if part and isinstance(entry, dict) else entry
            yield ms_to_seconds(stamp, file, "timestamp"), _parse_vector(value, file, part or "entry")


def _parse_vector(value: Any, file: Path, field: str) -> np.ndarray:
    is_list = isinstance(value, list | tuple) and all(isinstance(x, int | float) for x in value)
    flat = np.array(value) if is_list else value if isinstance(value, np.ndarray) else None
    if flat is None or flat.dtype.kind not in "fiu" or flat.ndim != 1 or len(flat) > 64:
        raise files.FormatError(file, field, type(value).__name__, "a vector of numbers")
    return flat.astype(np.float64)


def _check_mapping(value: Any, file: Path, field: str, texts: bool = True) -> dict[Any, Any]:
    """Checked dict; with ``texts`` its keys as strings, since a serial may be stored as a number."""
    files.refuse_if(not isinstance(value, dict), file, field, type(value).__name__, "a dict")
    return {str(key): entry for key, entry in value.items()} if texts else value
