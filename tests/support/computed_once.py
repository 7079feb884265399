"""Parsed settings and rendered pictures are computed once in a process, however many tests ask for the same ones.

Both are functions of their arguments alone: the second call has a copy of what the first returned.
"""

import copy
from collections import OrderedDict

import yaml

from dhtorch.synthetic import recording

#: Rooms that are kept, of 90 MB each.
MAX_ROOMS = 4

#: Memory that pictures may take, bytes: a hundred of 240 x 320 pixels.
PICTURE_BYTES = 100 * 3 * 240 * 320 * 4


def parse_settings_once():
    """Replace ``yaml.load`` by one that parses a text of settings once; a text with an error is parsed anew."""
    load, parsed = yaml.load, {}

    def load_once(stream, Loader):
        if Loader.__name__ != "OmegaConfLoader" or not hasattr(stream, "seek"):
            return load(stream, Loader)
        start = stream.tell()
        text = stream.read()
        if text not in parsed:
            stream.seek(start)
            parsed[text] = load(stream, Loader)
        return copy.deepcopy(parsed[text])

    yaml.load = load_once


class Pictures:
    """Pictures of built-in rooms by seed, camera, pose and size; the oldest go where there is no more memory."""

    def __init__(self):
        self.furnish, self.photograph = recording.furnished_room, recording._photograph
        self.rooms, self.pictures, self.size = {}, OrderedDict(), 0

    def room(self, seed=2):
        """The room of a seed."""
        if seed not in self.rooms:
            self.rooms[seed] = self.furnish(seed)
        self.rooms[seed] = room = self.rooms.pop(seed)  # the last used stands last
        if len(self.rooms) > MAX_ROOMS:
            del self.rooms[next(iter(self.rooms))]
        return room

    def picture(self, scene, camera, pose, hw, *, supersample, exposure=1.0):
        """The picture of a room of these; other scenes are rendered anew."""
        seeds = [seed for seed, room in self.rooms.items() if room is scene]
        numbers = (camera.f, camera.c, camera.distortion, camera.readout, pose.R, pose.t)
        key = (*seeds, *(None if x is None else x.numpy().tobytes() for x in numbers), hw, supersample, exposure)
        if key in self.pictures:
            return self.pictures[key].clone()
        picture = self.photograph(scene, camera, pose, hw, supersample=supersample, exposure=exposure)
        if seeds:
            self.pictures[key] = picture
            self.size += picture.nbytes
        while self.size > PICTURE_BYTES:
            self.size -= self.pictures.popitem(last=False)[1].nbytes
        return picture.clone()


_ONCE = Pictures()


def render_once():
    """Replace the renderer of the built-in rooms by one that furnishes a room and renders a picture once."""
    recording.furnished_room, recording._photograph = _ONCE.room, _ONCE.picture


def render_anew(monkeypatch):
    """For one test, the renderer itself."""
    monkeypatch.setattr(recording, "furnished_room", _ONCE.furnish)
    monkeypatch.setattr(recording, "_photograph", _ONCE.photograph)
