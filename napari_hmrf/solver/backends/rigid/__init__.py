"""Rigid bodies: sites, poses, and the motion that they induce in the surrounding tissue."""
