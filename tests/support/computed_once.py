"""Parsed settings, rendered pictures, checks of captures and lists of modules are computed once in a process, however
many tests ask for the same ones.

All are functions of their arguments alone: the second call has a copy of what the first returned.
"""

import copy
import hashlib
from collections import OrderedDict
from dataclasses import replace

import torch
import yaml
from torch.utils import _pytree

from dhtorch.cli import capture_checks
from dhtorch.runtime import code_dependencies
from dhtorch.synthetic import recording
from dhtorch.validation import capture_check

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


def check_captures_once():
    """Replace the check before every command by one that examines the same frames, poses and unit once."""
    examine, checks = capture_checks.check_capture, {}

    def check_once(capture):
        window = capture_check._read_window(capture, {})
        parts = (list(window), window, capture.poses, capture.depth_unit, capture.sparse, len(capture))
        total = hashlib.sha256()
        for x in _pytree.tree_leaves(parts):
            is_tensor = isinstance(x, torch.Tensor)
            total.update(repr((x.shape, x.dtype) if is_tensor else x).encode())
            total.update(x.numpy().tobytes() if is_tensor else b"")
        key = total.digest()
        if key not in checks:
            checks[key] = examine(capture, window)
        found = checks[key]
        usable = replace(capture, poses=None) if found.poses_refuted else capture
        return replace(found, recording=usable)

    capture_checks.check_capture = check_once


def list_modules_once():
    """Replace the search for the modules that an installed one imports by one that reads their files once."""
    find, found = code_dependencies.find_reachable_modules, {}

    def find_once(names, folder=None):
        key = tuple(names)
        if folder is not None:
            return find(key, folder)
        if key not in found:
            found[key] = find(key)
        return dict(found[key])

    code_dependencies.find_reachable_modules = find_once
