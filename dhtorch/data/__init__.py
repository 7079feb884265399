"""Files to frames: the only place with file decoding, unit changes and axis changes."""
