"""Options of the command for runs that take seconds."""

#: A synthetic room of three frames of 60 x 80 pixels, whose one pair is frames 0 and 2.
ROOM = ["data.hw=[60,80]", "data.n_frames=3", "data.supersample=1", "data.lidar=exact", "pairs.gap=2"]

#: A run of 256 samples in that room, without figures.
TINY = [*ROOM, "method.n=256", "figures=false"]
