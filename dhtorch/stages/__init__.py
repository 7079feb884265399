"""The paper's stages, one file each, in the order of the method. No stage imports another."""
