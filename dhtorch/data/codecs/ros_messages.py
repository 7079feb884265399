"""Codec of ROS messages by rosbags: images, camera calibrations and transforms, of ROS 1 and of ROS 2 (CDR).

Definitions are fixed here and never taken from a file; rosbags compares the lengths of strings and arrays with the
bytes of the message. A definition may be the beginning of a message's: what follows is not read.
"""

import struct
from functools import cache
from pathlib import Path
from typing import Any, Final

from dhtorch.data.io.decode import FormatError, import_optional

#: Fields of messages, each in ROS's language of definitions. Vectors and quaternions (x, y, z, w) are arrays.
_DEFINITIONS: Final = {
    "ImageHead": "Header header\nuint32 height\nuint32 width\nstring encoding",
    "Image": (
        "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data"
    ),
    "CompressedHead": "Header header\nstring format",
    "CompressedImage": "Header header\nstring format\nuint8[] data",
    "CameraInfo": (
        "Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\n"
        "float64[12] p\nuint32 binning_x\nuint32 binning_y\nuint32 x_offset\nuint32 y_offset\nuint32 roi_height\n"
        "uint32 roi_width"
    ),
    "Transform": "float64[3] translation\nfloat64[4] rotation",
    "TransformStamped": "Header header\nstring child_frame_id\nfloat64[3] translation\nfloat64[4] rotation",
    "TFMessage": "TransformStamped[] transforms",
    "Odometry": "Header header\nstring child_frame_id\nfloat64[3] translation\nfloat64[4] rotation",
    "Float32": "float32 data",
}


def parse_message(data: bytes, kind: str, coding: str, file: Path) -> Any:
    """A message, or its beginning, with the fields of the definition called ``kind``.

    Args:
        data: its bytes.
        kind: name of a definition.
        coding: ``cdr`` or ``ros1``.
        file: for errors.

    Raises:
        FormatError: truncated or damaged, not plain CDR, or compressed.
    """
    is_cdr = coding == "cdr"
    if is_cdr and data.startswith(b"\x28\xb5\x2f\xfd"):  # of zstd
        raise FormatError(file, "message", "messages compressed one by one", "a bag after `ros2 bag convert`")
    if is_cdr and (len(data) < 4 or data[0] or data[1] > 1):
        raise FormatError(file, "message", repr(bytes(data[:4])), "plain CDR")
    store = _message_store(is_cdr)
    definition = store.get_msgdef(f"dhtorch/msg/{kind}")
    read = definition.deserialize_ros1
    if is_cdr:
        read = definition.deserialize_cdr_le if data[1] else definition.deserialize_cdr_be
    try:
        return read(memoryview(data)[4 * is_cdr :], 0, definition.cls, store)[0]
    except (struct.error, ValueError, import_optional("rosbags.serde").SerdeError) as error:
        raise FormatError(file, "message", f"{error} in {len(data)} bytes", f"a whole {kind}") from None


def stamp_ns(header: Any) -> int:
    """Time stamp of a message's header in ns."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


@cache
def _message_store(is_cdr: bool) -> Any:
    library = import_optional("rosbags.typesys")
    store = library.get_typestore(library.Stores.EMPTY)
    number = "" if is_cdr else "uint32 seq\n"
    types = library.get_types_from_msg(f"{number}time stamp\nstring frame_id", "std_msgs/msg/Header")
    for name, fields in _DEFINITIONS.items():
        types |= library.get_types_from_msg(fields, f"dhtorch/msg/{name}")
    store.register(types)
    return store
