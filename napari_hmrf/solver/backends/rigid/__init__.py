"""Rigid bodies: their sites, their poses, and the motion that they induce in the surrounding tissue."""
