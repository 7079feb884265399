"""How far points lie from the surfaces of the built-in room, in closed form."""

import torch

from dhtorch.synthetic.room import furnished_room


def room_distance(xyz):
    """Distance (P,) of points from the nearest surface of the built-in room, exact."""
    solids = furnished_room(2).solids
    best = torch.full((len(xyz),), torch.inf, dtype=torch.float64)
    for k in range(len(solids.each)):
        q = (xyz.double() - solids.centre[k].double()) @ solids.R[k].double()
        half = solids.half[k].double()
        out = q.abs() - half
        flat = (out.clamp_min(0).norm(dim=-1) + out.amax(-1).clamp_max(0)).abs()
        best = torch.minimum(best, (q.norm(dim=-1) - half[0]).abs() if solids.ball[k] else flat)
    return best
