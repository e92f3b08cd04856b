"""Choosing numbers of gate and camera: scenes, losses, descents by gradient, grids, proof on seeds held out."""
