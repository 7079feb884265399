"""Built-in rooms that several tests look at: each is rendered once in a process. Nobody changes them."""

from functools import cache

from dhtorch.data.recording import Recording
from dhtorch.data.scene import Scene
from dhtorch.synthetic.recording import SyntheticRoom, room_to_scene


@cache
def room(**options) -> SyntheticRoom:
    """A room of these options; without antialiasing, which costs four times as much, where they do not ask for it."""
    return SyntheticRoom(**{"supersample": 1, **options})


def noted(recording, near=2.0, gap=6) -> Scene:
    """A recording with the notes of a benchmark; a scene keeps its own."""
    if isinstance(recording, SyntheticRoom):
        return room_to_scene(recording, near, gap)
    return recording if isinstance(recording, Scene) else Scene(recording, near=near, gap=gap)


class Changed(SyntheticRoom):
    """A room of which the frames or some fields are others."""

    def __init__(self, room, change=lambda frame: frame, **fields):
        self.__dict__.update(room.__dict__, **fields)
        self.whole, self.change = room, change

    def __getitem__(self, i):
        return self.change(self.whole[i])


def untold(room) -> Recording:
    """A room that does not know what is really there."""
    return Recording(name=room.name, format="made", load=room.__getitem__, number=room.number, poses=room.poses)
