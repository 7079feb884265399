"""Synthetic rooms that tests share, each rendered once in a process and never changed."""

from functools import cache

from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.synthetic.recording import SyntheticRoom, room_to_scene


@cache
def room(**options) -> SyntheticRoom:
    """The synthetic room with these options; without antialiasing (four times slower) unless ``supersample`` is given."""
    return SyntheticRoom(**{"supersample": 1, **options})


def room_scene(recording, near=2.0, gap=6) -> Scene:
    """The recording as a scene with a near limit (m) and a frame gap; a scene is returned as it is."""
    if isinstance(recording, SyntheticRoom):
        return room_to_scene(recording, near, gap)
    return recording if isinstance(recording, Scene) else Scene(recording, near=near, gap=gap)


class Changed(SyntheticRoom):
    """A room with its frames changed by a function and some fields replaced."""

    def __init__(self, room, change=lambda frame: frame, **fields):
        self.__dict__.update(room.__dict__, **fields)
        self.whole, self.change = room, change

    def __getitem__(self, i):
        return self.change(self.whole[i])


def untold(room) -> Recording:
    """The recording of a room without its truth."""
    return Recording(name=room.name, format="made", load=room.__getitem__, number=room.number, poses=room.poses)
