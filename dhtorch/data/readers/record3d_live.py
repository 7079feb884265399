"""Live frames of Record3D over USB.

The library ``record3d`` calls back from a thread of its own and overwrites its buffers with the next frame; everything
is therefore copied inside the callback. A few frames are queued between the two threads. When the reader is slower than
the phone the oldest frame is dropped, so that frames are recent and memory is bounded.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch

from dhtorch.data import convert
from dhtorch.data.io.decode import import_optional, refuse_if
from dhtorch.records import Frame, Pose

_SOURCE = Path("record3d:usb")


class LiveFrames:
    """Frames (B = 1) from a phone, from entering the ``with`` block until the phone stops or the block ends.

    Iterating blocks until a frame comes. Colour and depth are registered; depth keeps its own resolution. ``time`` is
    this computer's clock at arrival, s since the first frame; the pose is the device's, in a world of its own.

    Args:
        stream: an object with the interface of ``record3d.Record3DStream``. None = a new one.
        device: one of ``stream.get_connected_devices()``. None = the first.
        timeout: s, longest wait for a frame.
        ahead: size of the queue; when it is full the oldest frame is dropped.
        clock: returns seconds, for the time stamps.

    Raises:
        FormatError: no phone, a refused connection, no frame within ``timeout``, or an invalid frame.
        ImportError: ``record3d`` is not installed.
    """

    def __init__(
        self,
        stream: Any = None,
        device: Any = None,
        *,
        timeout: float = 5.0,
        ahead: int = 2,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.stream = import_optional("record3d", extra="live").Record3DStream() if stream is None else stream
        self.device, self.timeout, self.clock = device, timeout, clock
        self.dropped = 0  # frames dropped because the queue was full
        self.start: float | None = None
        self._news = threading.Condition()  # guards the attributes below
        self._frames: deque[Frame] = deque(maxlen=max(ahead, 1))
        self._error: Exception | None = None
        self._stopped = False

    def __enter__(self) -> Self:
        if self.device is None:
            devices = list(self.stream.get_connected_devices())
            refuse_if(not devices, _SOURCE, "devices", "none", "a phone on the cable with Record3D in USB mode")
            self.device = devices[0]
        self.stream.on_new_frame = self._on_frame
        self.stream.on_stream_stopped = self._on_stop
        refuse_if(
            self.stream.connect(self.device) is False,
            _SOURCE,
            "connection",
            "refused",
            "a phone with Record3D in USB mode",
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stream.disconnect()
        self._on_stop()

    def __iter__(self) -> Iterator[Frame]:
        while True:
            with self._news:
                refuse_if(
                    not self._news.wait_for(lambda: self._frames or self._error or self._stopped, self.timeout),
                    _SOURCE,
                    "frames",
                    f"none within {self.timeout} s",
                    "a phone that streams",
                )
                if self._error:
                    raise self._error
                if not self._frames:
                    return
                frame = self._frames.popleft()
            yield frame

    def _on_frame(self) -> None:
        """Callback on the library's thread; exceptions are passed on to the reading thread."""
        try:
            frame = self._frame()
        except Exception as error:
            with self._news:
                self._error = error
                self._news.notify_all()
            return
        with self._news:
            self.dropped += len(self._frames) == self._frames.maxlen
            self._frames.append(frame)
            self._news.notify_all()

    def _on_stop(self) -> None:
        with self._news:
            self._stopped = True
            self._news.notify_all()

    def _frame(self) -> Frame:
        now = self.clock()
        self.start = now if self.start is None else self.start
        rgb = _copy_buffer(self.stream.get_rgb_frame(), "rgb", np.uint8, 3)
        depth = _copy_buffer(self.stream.get_depth_frame(), "depth", np.float32, 2)
        conf = _copy_buffer(self.stream.get_confidence_frame(), "confidence", np.uint8, 2)
        refuse_if(
            conf.size and (conf.shape != depth.shape or conf.max() > 2),
            _SOURCE,
            "confidence",
            f"{conf.shape} up to {conf.max(initial=0)}",
            f"{depth.shape}, 0, 1 or 2",
        )
        k = self.stream.get_intrinsic_mat()
        hw = (rgb.shape[0], rgb.shape[1])
        camera = convert.to_camera(convert.make_K(k.fx, k.fy, k.tx, k.ty), hw, _SOURCE, "intrinsics")
        usable = np.isfinite(depth) & (depth > 0)
        # 0 is the front camera, without confidence and poses
        lidar = self.stream.get_device_type() == 1
        return Frame(
            image=torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1)))[None],
            depth=torch.from_numpy(np.where(usable, depth, np.float32(0)))[None],
            camera=camera,
            conf=torch.from_numpy(conf)[None] if conf.size else None,
            time=torch.tensor([now - self.start], dtype=torch.float64),
            T_world_from_cam=self._pose() if lidar else None,
        )

    def _pose(self) -> Pose:
        p = self.stream.get_camera_pose()
        c2w = convert.to_c2w(np.array([[p.qx, p.qy, p.qz, p.qw]]), np.array([[p.tx, p.ty, p.tz]]), _SOURCE, "pose")
        return convert.to_poses(convert.cv_from_gl(c2w), _SOURCE)


def _copy_buffer(buffer: Any, field: str, dtype: type, ndim: int) -> np.ndarray:
    """Checked copy of the library's buffer."""
    array = np.array(buffer, copy=True)
    shape_fits = array.ndim == ndim and (ndim == 2 or array.shape[2] == 3)
    refuse_if(
        array.dtype != dtype or not (shape_fits or (array.size == 0 and field == "confidence")),
        _SOURCE,
        field,
        f"{array.dtype} of shape {array.shape}",
        f"{np.dtype(dtype)}, {ndim} axes",
    )
    return array
