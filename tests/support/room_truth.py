"""Exact distance of points from the surfaces of the synthetic room."""

import torch

from dhtorch.synthetic.room import furnished_room


def room_distance(xyz):
    """World points (P, 3) -> distance (P,) m from the nearest surface of the room, in closed form."""
    solids = furnished_room(2).solids
    best = torch.full((len(xyz),), torch.inf, dtype=torch.float64)
    for k in range(len(solids.each)):
        q = (xyz.double() - solids.centre[k].double()) @ solids.R[k].double()
        half = solids.half[k].double()
        out = q.abs() - half
        flat = (out.clamp_min(0).norm(dim=-1) + out.amax(-1).clamp_max(0)).abs()
        best = torch.minimum(best, (q.norm(dim=-1) - half[0]).abs() if solids.ball[k] else flat)
    return best
